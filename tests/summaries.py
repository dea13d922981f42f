"""A whole summary, made up, and metrics of two missions."""

import numpy as np

AGENT = {
    "return": 1.2345, "optimal": 1.25, "greedy": 1.24, "naive": 1.0, "random": -1.5,
    "fraction_of_optimal": 0.9876,
    "one_step": {"policy": 0.86, "optimal": 0.87, "random": -0.1}, "optimal_states": 1700,
    "num_states": 1728, "optimal_permutations": 380, "num_permutations": 384,
    "env_steps": 409600, "env_steps_per_s": 50000.4,
}  # fmt: skip
CASE = {
    "accuracy": 0.998, "observations_per_poi": 1.68, "time_s": 13.8, "mean_time_s": 14.5,
    "collisions": 0, "goals_reached_fraction": None, "information": 5.8, "episodes": 128,
    "calibration": {"confidence": 0.9975, "accuracy": 0.9985, "nll": 0.0125},
    "ended": {"finished": 127, "time limit": 1},
}  # fmt: skip
UNAMBIGUOUS = {"joint": [True] * 3, "camera": [True, False, False], "lidar": [False, True, True]}
DETECTOR = {"accuracy": 0.9995, "ece": 0.01, "nll": 0.02}
CURVES = "looks", "nll", "bayes_nll", "accuracy", "bayes_accuracy"
RESULTS = "detectors", "jmvae", "belief", "dqn", "mission"
RETURNS = {name: x for name, x in AGENT.items() if isinstance(x, float) and "env" not in name}
SUMMARY = {
    "preset": "smoke",
    "seed": 90210,
    "versions": {"jaxsense": "0.1.0", "jax": "<0.10>"},
    "devices": ["cpu", "cpu"],
    "cores": 2,
    "source": "0a1b2c3d4e5f6071",
    "date": "2026-11-26",
    "timing": {"total_s": 23.7, "stages": {"jmvae": {"compile_s": 1.5, "run_s": 4.5}}},
    "detectors": {"camera": DETECTOR, "lidar": DETECTOR},
    "jmvae": {
        "active_units": 2,
        "fusion": {"accuracy": 0.9996, "mean_error": 0.021, "std_error": 0.03},
        "moment_matching_error": 0.0067,
        "readout_error": 0.0001,
        "sigma_norm": {name: [0.5, 1.25, 1.5] for name in UNAMBIGUOUS},
        "unambiguous": UNAMBIGUOUS,
        "consistent": {name: [0.995, 1.0, 0.5] for name in UNAMBIGUOUS},
    },
    "belief": {"doubt_correlation": 0.9375, **{name: [1, 2] for name in CURVES}},
    "dqn": {"camera": AGENT, "lidar": AGENT},
    "mission": {"latent": CASE},
}
OF_SEEDS = {
    **SUMMARY,
    "seeds": {"90210": {name: SUMMARY[name] for name in RESULTS}},
    "failed": {"90211": "jmvae: loss at step 1 of 2 is not finite"},
}
OF_A_TEAM = {**SUMMARY, "dqn": {"camera": {**AGENT, "other_numbers": {"8": RETURNS}}}}
ORIGIN = {
    "versions": {"python": "3.12.3", "jax": "0.11.2", "mujoco": "3.17.0"},
    "devices": ["NVIDIA H200"],
    "cores": 16,
    "source": "8091a2b3c4d5e6f7",
    "date": "2026-11-30",
    "commit": "fedcba9876543210",
}
EVALUATION = {
    "num_pois": 16,
    "side": 6.0,
    "robots": ["camera", "camera", "lidar"],
    "origin": ORIGIN,
    "mission": {"latent": {**CASE, "seed": 7, "accuracy": 0.75}},
}
FOUND = {
    "classes": np.array([[0, 1, 2], [2, 2, 1]]),
    "is_right": np.array([[True, True, False], [True, True, True]]),
    "ambiguous": np.array([[False, True, False], [True, True, False]]),
    # The third PoI of the second mission was never detected: .9, .8, .4, .7 and 1 count.
    "seen": np.array([[True, True, True], [True, True, False]]),
    "confidence": np.array([[0.9, 0.8, 0.4], [0.7, 1.0, 0.2]]),
    "nll": np.array([[0.1, 0.2, 1.5], [0.3, 0.0, 9.0]]),
    "told": {"camera": np.array([2 / 3, 1.0]), "lidar": np.array([1 / 3, 2 / 3])},
    "observations_per_poi": np.array([1.0, 2.0]),
    "time_s": np.array([10.0, 20.0]),
    "collisions": np.array([0, 2]),
    "goals": np.array([4, 6]),
    "goals_reached": np.array([4, 5]),
    "information": np.array([5.0, 6.0]),
    "reason": np.array([1, 2]),
}
THIS = {name: x for name, x in ORIGIN.items() if name != "date"}
# By what differs from it.
OTHERS = {
    **{name: {**THIS, name: "cc"} for name in ("source", "commit")},
    **{name: {**THIS, "versions": {**THIS["versions"], name: "9"}} for name in ("python", "jax")},
    "devices": {**THIS, "devices": ["cpu"]},
}

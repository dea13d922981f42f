"""Makes the blocks of `summary.json` from arrays."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np

from jaxsense.config import Config
from jaxsense.mission.outcome import REASONS
from jaxsense.mission.state import Mission
from jaxsense.summary.blocks import (
    Agent,
    Beliefs,
    Calibration,
    Case,
    Jmvae,
    Missions,
    Returns,
    Traffic,
    cases,
)
from jaxsense.summary.compare import REFERENCE, Measured, compared, differences

_UNAMBIGUOUS = 0.9  # share of looks that leave only the class; above, the class is unambiguous
_AS_GOOD = 0.01  # tolerance of the reward below the optimum
_ERROR = 0.01  # of the optimum, as a share of it
_FLOAT_BYTES = 4


def jmvae(measured: Mapping[str, object]) -> Jmvae:
    """The block `jmvae`.

    Args:
      measured: arrays under its keys, with shares of looks under `unambiguous`.
    """
    block: Jmvae = jax.tree.map(lambda x: np.asarray(x).tolist(), dict(measured))
    for name, shares in block["unambiguous"].items():
        block["unambiguous"][name] = [share > _UNAMBIGUOUS for share in shares]
    return block


def beliefs(measured: Mapping[str, jax.Array]) -> Beliefs:
    """The block `belief` from arrays under its keys."""
    return jax.tree.map(lambda x: np.asarray(x).tolist(), dict(measured))


def agent(
    config: Config,
    rewards: Mapping[str, tuple[np.ndarray, np.ndarray]],
    is_permutation: np.ndarray,
    seconds: Sequence[float],
    others: Mapping[int, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    has_optimum: bool = True,
) -> Agent:
    """One modality's block of `dqn`.

    Args:
      config: all settings.
      rewards: by policy, `[S]` total reward of an episode and `[S]` reward of its first action,
        from every state of the map, then from `config.evaluation.num_starts` random starts.
      is_permutation: for each state of the map, whether all classes differ, as in the paper.
      seconds: of the training, chunk by chunk.
      others: `rewards` with other numbers of PoIs, whose last starts are the random ones.
      has_optimum: whether `optimal` is the optimum; what rests on it is None otherwise, and where
        another policy gets clearly more.
    """
    num_starts, env_steps = config.evaluation.num_starts, config.dqn.epochs * config.dqn.num_envs
    num_states = len(is_permutation)

    has_optimum &= not _is_exceeded(rewards, num_starts)

    def first(policy: str) -> float:
        return float(rewards[policy][1][num_states:].mean())

    missed = (rewards["optimal"][0] - rewards["latent"][0])[:num_states]
    is_optimal = missed <= _AS_GOOD
    block: Agent = {
        **_returns(rewards, num_starts, has_optimum),
        "one_step": {
            "policy": first("latent"),
            "optimal": first("optimal") if has_optimum else None,
            "random": first("random"),
        },
        "optimal_states": int(np.sum(is_optimal)) if has_optimum else None,
        "num_states": num_states,
        "optimal_permutations": int(np.sum(is_optimal & is_permutation)) if has_optimum else None,
        "num_permutations": int(np.sum(is_permutation)),
        "env_steps": env_steps,
        "env_steps_per_s": env_steps / sum(seconds),
    }
    if others:
        block["other_numbers"] = {
            str(number): _returns(each, num_starts, has_optimum) for number, each in others.items()
        }
    return block


def _returns(
    rewards: Mapping[str, tuple[np.ndarray, np.ndarray]], num_starts: int, has_optimum: bool
) -> Returns:
    """Mean total rewards from random starts, the last ones."""
    of = {name: float(total[-num_starts:].mean()) for name, (total, _) in rewards.items()}
    is_optimum = has_optimum and not _is_exceeded(rewards, num_starts)
    optimal = of["optimal"] if is_optimum else None
    return {
        "return": of["latent"],
        "optimal": optimal,
        "greedy": of["greedy"],
        "naive": of["naive"],
        "random": of["random"],
        # Where no look pays, the optimum is 0.
        "fraction_of_optimal": of["latent"] / optimal if optimal else None,
    }


def _is_exceeded(rewards: Mapping[str, tuple[np.ndarray, np.ndarray]], num_starts: int) -> bool:
    """Whether some policy gets more than `optimal` from random starts, by more than its error."""
    of = {name: total[-num_starts:] for name, (total, _) in rewards.items()}
    error = _ERROR * abs(of["optimal"].mean())
    return any(
        np.mean(more) > error + 2 * np.std(more) / np.sqrt(num_starts)
        for more in (each - of["optimal"] for each in of.values())
    )


def missions(mission: Mission, played: Mapping[str, Measured]) -> Missions:
    """The block `mission`.

    Args:
      mission: all robots and their arena.
      played: metrics of the missions of each case, in the same arenas.
    """
    found: Missions = {name: case(mission.config, name, each) for name, each in played.items()}
    for name, block in cases(found).items():
        if REFERENCE in played and name != REFERENCE:
            block["intervals"] = differences(played[name], played[REFERENCE])
    detections = sum(each["detections"].sum(axis=0) for each in played.values())
    return {**compared(found), "bytes_per_detection": traffic(mission, np.asarray(detections))}


def case(config: Config, name: str, found: Measured) -> Case:
    """One case of the block `mission`.

    Args:
      config: all settings.
      name: of the case.
      found: metrics of its missions.

    Returns:
      Means over the missions, except the median of `time_s` and the sum of `collisions`.
    """
    block: Case = {
        "accuracy": float(found["is_right"].mean()),
        "observations_per_poi": float(found["observations_per_poi"].mean()),
        "time_s": float(np.median(found["time_s"])),
        "mean_time_s": float(found["time_s"].mean()),
        "collisions": int(found["collisions"].sum()),
        "goals_reached_fraction": _share(found["goals_reached"].sum(), found["goals"].sum()),
        "information": float(found["information"].mean()),
        "calibration": calibration(found),
        "episodes": len(found["time_s"]),
        "ended": {
            reason: int(np.sum(found["reason"] == code))
            for code, reason in enumerate(REASONS)
            if np.any(found["reason"] == code)
        },
    }
    robot = name.removesuffix("_alone")
    if robot != name:
        modality = config.carried[config.robot_names.index(robot)]
        labels = np.array(config.label_of_class(modality))
        shares_label = np.array([np.sum(labels == label) > 1 for label in labels])
        reported = found["ambiguous"][shares_label[found["classes"]]]
        block["told"] = float(found["told"][modality].mean())
        block["ambiguous_reported"] = _share(reported.sum(), reported.size)
    return block


def calibration(found: Measured) -> Calibration:
    """Whether the confidence of maps matches their accuracy, at PoIs that were detected.

    Args:
      found: metrics of missions.
    """
    is_seen = np.asarray(found["seen"])

    def of_seen(name: str) -> float | None:
        values = np.asarray(found[name], float)[is_seen]
        return float(values.mean()) if values.size else None

    return {
        "confidence": of_seen("confidence"),
        "accuracy": of_seen("is_right"),
        "nll": of_seen("nll"),
    }


def _share(part: int, whole: int) -> float | None:
    """Share of a whole; None if that is 0."""
    return float(part / whole) if whole else None


def traffic(mission: Mission, detections: np.ndarray) -> Traffic:
    """Network traffic of a detection.

    Args:
      mission: all robots and their sensors.
      detections: `[R]` number of each robot's detections.

    Returns:
      Sizes in bytes: of a belief, and the means of the detections' features and scans; without
      detections the means over the robots.
    """
    detections = np.maximum(detections, 0 if np.any(detections) else 1)
    config = mission.config
    sensors = [mission.world.sensors[m] for m in config.modality_of_robot]
    scans = np.array([sensor.scan_bytes for sensor in sensors])
    features = np.array([_FLOAT_BYTES * len(config.labels(name)) for name in config.carried])
    return {
        "latent": float(2 * _FLOAT_BYTES * config.jmvae.latent_size),
        "features": float(np.average(features, weights=detections)),
        "raw": float(np.average(scans, weights=detections)),
    }

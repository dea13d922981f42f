"""Exported programs, against jaxsense, in processes that can import neither jaxsense nor JAX."""

import json
import zipfile

import comparing
import jax
import jax.numpy as jnp
import moments
import numpy as np
import onnx
import pytest
from exporting import CONFIG, played

from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.dqn import observation, team_mdp
from jaxsense.interfaces.onboard import functions
from jaxsense.models import make_jmvae
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.vae import detectors, jmvae, latent

BATCH = 12
SIZES = {"pois": 3, "robots": 2, "looks": 4}


@pytest.fixture(scope="module")
def results(file, tmp_path_factory):
    """`{NAME/KEY: array}` of what all programs were given, and what they gave."""
    rng, inputs = np.random.default_rng(0), {}
    for name, function in functions(CONFIG).items():
        for key, each in function.inputs.items():
            shape = tuple(SIZES.get(n, n) for n in each.shape)
            drawn = rng.uniform(0.1, 1.0, (BATCH, *shape)) * (0.3 if key == "bearing" else 1)
            drawn = drawn + 0.2 if key == "distance" else drawn  # as far as was learned
            drawn = drawn > 0.4 if each.dtype == "bool" else drawn
            # Features are probabilities.
            is_probability = key == "features" or name.startswith("encode")
            drawn = drawn / drawn.sum(axis=-1, keepdims=True) if is_probability else drawn
            drawn = rng.integers(0, 2, (BATCH, *shape)) if each.dtype == "int32" else drawn
            inputs[f"{name}/{key}"] = drawn.astype(each.dtype)
    folder = tmp_path_factory.mktemp("results")
    return inputs, played(file, inputs, folder)


def check(results, name, expected, *keys):
    """`expected(*inputs of one example) -> outputs`, for each of the batch."""
    inputs, outputs = results
    given = [value for key, value in inputs.items() if key.startswith(f"{name}/")]
    for row in range(BATCH):
        values = expected(*(x[row] for x in given))
        for key, value in zip(keys, values, strict=True):
            place = f"{name}/{key}"
            np.testing.assert_allclose(outputs[place][row], value, atol=1e-5, err_msg=place)


@pytest.mark.parametrize("m", [0, 1])
def test_programs_of_a_sensor_give_what_jaxsense_gives(models, results, m):
    name = CONFIG.modalities[m]
    sensor = sensors.make(CONFIG)[m]

    of_window = jax.jit(lambda window: detectors.detect(models.detectors[m], window))

    def detect(readings, bearing, distance):
        # The nearest window in the scan, ray by ray.
        centre = float(sensor.centre(bearing))
        first = round(centre - (sensor.window - 1) * sensor.stride / 2)
        rays = first + np.arange(sensor.window) * sensor.stride
        window = np.minimum(readings[rays], sensor.window_limit).reshape(-1)
        features = np.asarray(of_window(window))
        return True, True, features.max() >= CONFIG.mission.least_confidence, features

    @jax.jit
    def write(mean, std, seen, features, weight):
        belief = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return belief.mean, belief.std

    @jax.jit
    def weigh(apart):
        return models.novelty.weight(apart, m), models.novelty.to_go(apart, m)

    check(results, f"detect_{name}", detect, "is_known", "is_there", "detects", "features")
    check(results, f"weigh_{name}", weigh, "weight", "to_go")
    check(results, f"write_{name}", write, "new_mean", "new_std")


def test_decisions_are_those_of_the_policy_and_the_rules(models, results):
    network = MLP(CONFIG.dqn.hidden, CONFIG.arena.num_pois + 1)
    classes, settings = models.fusion.classes, CONFIG.mission
    assert settings.auctions

    apply = jax.jit(lambda params, belief: network.apply(params, observation(belief)))
    seconds = jax.jit(lambda pose, place: team_mdp.travel_seconds(CONFIG.team.travel, pose, place))
    means, stds = np.asarray(classes.mean), np.asarray(classes.std)

    def values_of(mean, std, present, m):
        # A mean over all classes that a PoI which is not present may have.
        of_each = [
            apply(
                models.q_networks[m],
                Belief(
                    np.where(present[:, None], mean, means[c]),
                    np.where(present[:, None], std, stds[c]),
                ),
            )
            for c in range(len(means))
        ]
        return np.where(np.append(present, True), np.mean(of_each, axis=0), -np.inf)

    def decide(mean, std, looked_from, robot, positions, present, poses, modality, works, target):
        values = values_of(mean, std, present, modality[robot])
        bids = {}
        for r, poi in np.ndindex(SIZES["robots"], SIZES["pois"]):
            only = present & (np.arange(SIZES["pois"]) == poi)
            alone = values_of(mean, std, only, modality[r])
            apart = np.linalg.norm(poses[r, :2] - looked_from[poi, modality[r]], axis=-1)
            way = models.novelty.to_go(apart, modality[r]) / CONFIG.team.travel.speed
            there = seconds(poses[r], positions[poi][None])
            if only.any() and alone[poi] > alone[-1]:
                bids[r, poi] = float(there[0] + way)
        of_robot = {poi: time for (r, poi), time in bids.items() if r == robot}
        bids, won = {(r, n): x for (r, n), x in bids.items() if works[r]}, {}
        while bids:
            r, n = min(bids, key=bids.get)
            won[r] = n
            bids = {(i, j): x for (i, j), x in bids.items() if i != r and j != n}
        taken = [target[r] for r in range(SIZES["robots"]) if works[r] and r != robot]
        cost = {n: time + 100 * (n in taken) for n, time in of_robot.items()}
        nearest = min(cost, key=cost.get) if cost else SIZES["pois"]
        return won.get(robot, nearest), values

    check(results, "decide", decide, "action", "values")
    assert len(set(results[1]["decide/action"].tolist())) > 1


@pytest.mark.parametrize(
    ("name", "given"), [("camera", [0]), ("lidar", [1]), ("camera+lidar", [0, 1])]
)
def test_encoders_give_what_jaxsense_gives(models, results, name, given):
    @jax.jit
    def encode(*features):
        of_each = [None, None]
        for m, x in zip(given, features, strict=True):
            of_each[m] = x
        mean, log_var = jmvae.encode(models.jmvae, make_jmvae(CONFIG), tuple(of_each))
        return mean, jnp.exp(log_var / 2)

    check(results, f"encode_{name}", encode, "mean", "std")


def test_the_map_is_read_as_jaxsense_reads_it(models, results):
    means = models.fusion.classes.mean

    @jax.jit
    @jax.vmap
    def classify(mean, std):
        belief, fusion = Belief(mean, std), models.fusion
        plausible = latent.plausible_classes(belief, means)
        return fusion.class_probabilities(belief), fusion.most_likely_class(belief), plausible

    check(results, "classify", classify, "probabilities", "most_likely", "plausible")


@pytest.mark.slow
def test_decisions_are_those_of_missions(models, file):
    found = moments.choices(CONFIG, models, 60)
    programs = comparing.compare(CONFIG, models, file.read_bytes(), found)
    assert programs["decide"].states == len(found)
    assert {"classify", "decide", "write_camera", "detect_lidar"} < {*programs}
    assert all(each.different == 0 for each in programs.values())
    assert all(each.error < 1e-5 for each in programs.values())


def test_contents_describe_what_is_there(results, file):
    with zipfile.ZipFile(file) as files:
        contents, names = json.loads(files.read("contents.json")), {*files.namelist()}
        graph = onnx.load_model_from_string(files.read("decide.onnx")).graph
    weights = {each.name: tuple(each.dims) for each in graph.initializer}
    # Data alone.
    assert {f"{name}.onnx" for name in contents["programs"]} | {"contents.json"} == names
    for end, given in zip(("inputs", "outputs"), results, strict=True):
        described = {
            f"{name}/{key}": ([BATCH, *(SIZES.get(n, n) for n in about["shape"])], about["dtype"])
            for name, program in contents["programs"].items()
            for key, about in program[end].items()
        }
        assert described == {key: (list(x.shape), x.dtype.name) for key, x in given.items()}
        assert all(x["about"] for p in contents["programs"].values() for x in p[end].values())
    # Three PoIs, two latent dimensions.
    assert weights["q_networks/0/params/Dense_0/kernel"][0] == 12
    assert contents["labels"] == {"camera": ["red", "green"], "lidar": ["cylinder", "cube"]}
    assert contents["classes"] == list(CONFIG.arena.classes)
    for sensor in sensors.make(CONFIG):
        angles = contents["sensors"][sensor.name]["angles"]
        np.testing.assert_allclose(angles, sensor.angles, atol=1e-6)
        assert contents["sensors"][sensor.name]["height"] == sensor.height
    limits = contents["viewpoint"]
    assert (limits["min_distance"], limits["max_distance"]) == (0.3, 1.2)
    assert limits["max_bearing"] == pytest.approx(np.radians(20), abs=1e-6)
    assert contents["versions"] == {"jaxsense": __version__}

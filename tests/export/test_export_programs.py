"""Exported programs, against jaxsense, in processes that can import neither jaxsense nor JAX."""

import dataclasses
import inspect
import io
import json
import runpy
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exporting import ABSENT, CONFIG, EXAMPLE, run_alone, with_classes
from smoke import save_models

from benchmarks import exported
from jaxsense import export
from jaxsense.config import PRESETS, LocalisationConfig, SearchConfig
from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.dqn import observation, team_mdp
from jaxsense.dqn.team_mdp import Team
from jaxsense.interfaces import robot_numpy, robot_onnx
from jaxsense.interfaces.onboard import functions
from jaxsense.models import init, make_jmvae, make_readout
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.sim import windows as windowing
from jaxsense.vae import detectors, jmvae, latent

BATCH = 12
SIZES = {"pois": 3, "robots": 2, "looks": 4}
RUN_ALL = """
import importlib
import numpy as np
sys.path.insert(0, sys.argv[1])
contents, programs = importlib.import_module(sys.argv[2]).load(sys.argv[1])
inputs, found = np.load(sys.argv[3]), {}
for name, about in contents["programs"].items():
    given = {key: inputs[f"{name}/{key}"] for key in about["inputs"] if f"{name}/{key}" in inputs}
    if not given:
        continue
    rows = [programs[name](**{key: x[row] for key, x in given.items()})
            for row in range(len(next(iter(given.values()))))]
    found |= {f"{name}/{key}": np.stack([row[key] for row in rows]) for key in rows[0]}
np.savez(sys.argv[4], **found)
"""


def played(path, player, inputs, folder):
    """What a player's programs give for `{NAME/KEY: array}`, alone."""
    given, found = folder / "in.npz", folder / f"{player}.npz"
    np.savez(given, **inputs)
    done = run_alone(RUN_ALL, player, path, player, given, found)
    assert done.returncode == 0, done.stderr
    return dict(np.load(found))


@pytest.fixture(scope="module")
def results(file, tmp_path_factory):
    """`{NAME/KEY: array}` of what all programs were given, and what each player's gave."""
    rng, inputs = np.random.default_rng(0), {}
    for name, function in functions(CONFIG).items():
        for key, each in function.inputs.items():
            shape = tuple(SIZES.get(n, n) for n in each.shape)
            drawn = rng.uniform(0.1, 1.0, (BATCH, *shape)) * (0.3 if key == "bearing" else 1)
            drawn = drawn > 0.4 if each.dtype == "bool" else drawn
            # Features are probabilities.
            is_probability = key == "features" or name.startswith("encode")
            drawn = drawn / drawn.sum(axis=-1, keepdims=True) if is_probability else drawn
            drawn = rng.integers(0, 2, (BATCH, *shape)) if each.dtype == "int32" else drawn
            inputs[f"{name}/{key}"] = drawn.astype(each.dtype)
    folder = tmp_path_factory.mktemp("results")
    return inputs, {player: played(file, player, inputs, folder) for player in ABSENT}


def check(results, name, expected, *keys):
    """`expected(*inputs of one example) -> outputs`, for each of the batch."""
    inputs, of_players = results
    given = [value for key, value in inputs.items() if key.startswith(f"{name}/")]
    for row in range(BATCH):
        values = expected(*(x[row] for x in given))
        for key, value in zip(keys, values, strict=True):
            for player, outputs in of_players.items():
                found, place = outputs[f"{name}/{key}"][row], f"{player}: {name}/{key}"
                np.testing.assert_allclose(found, value, atol=1e-5, err_msg=place)


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
        return True, features.max() >= CONFIG.mission.least_confidence, features

    @jax.jit
    def write(mean, std, seen, features, weight):
        belief = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return belief.mean, belief.std

    @jax.jit
    def weigh(apart):
        return models.novelty.weight(apart, m), models.novelty.to_go(apart, m)

    check(results, f"detect_{name}", detect, "is_there", "detects", "features")
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
    for outputs in results[1].values():
        assert len(set(outputs["decide/action"].tolist())) > 1


@pytest.mark.parametrize("player", [*ABSENT])
def test_an_exported_detector_answers_what_is_not_there(file, tmp_path, player):
    given, expected = {}, {}
    for sensor in sensors.make(CONFIG):
        name = f"detect_{sensor.name}"
        scan = np.full(functions(CONFIG)[name].inputs["readings"].shape, 0.5, np.float32)
        ahead = len(scan) // 2
        at = {"bearing": 0.0, "distance": 1.0}
        cases = [
            (scan, at, True),
            (np.where(scan > 0, np.nan, scan), at, False),
            (scan.copy(), at, False),
            (-scan, at, False),
            # A beam without a return; no pixel is infinitely bright.
            (np.where(scan > 0, np.inf, scan), at, sensor.measures_distance),
            (np.zeros_like(scan), at, True),
            *((scan, {**at, "bearing": b}, False) for b in (np.radians(121.0), -np.pi, np.nan)),
            *((scan, {**at, "distance": d}, False) for d in (0.0, -1.0, np.inf, np.nan)),
        ]
        cases[2][0][ahead : ahead + 4] = np.nan  # the camera reads every fourth pixel
        given[f"{name}/readings"] = np.stack([readings for readings, _, _ in cases])
        given |= {f"{name}/{key}": np.float32([x[key] for _, x, _ in cases]) for key in at}
        expected[name] = np.array([is_there for _, _, is_there in cases])
    found = played(file, player, given, tmp_path)
    for name, is_there in expected.items():
        np.testing.assert_array_equal(found[f"{name}/is_there"], is_there)
        features = found[f"{name}/features"]
        assert np.isfinite(features).all()
        np.testing.assert_allclose(features[~is_there], 0.5)


def test_encoders_of_scans_give_what_jaxsense_gives(tmp_path):
    networks = dataclasses.replace(PRESETS["raw"].jmvae, hidden=(8, 8))
    config = dataclasses.replace(CONFIG, jmvae=networks)
    learned = init(jax.random.key(0), config)
    means = jnp.array([[0.5, 0.5], [-0.5, 0.5], [0.5, -0.5]])
    classes = Belief(means, jnp.full((3, 2), 0.9))
    readout = make_readout(config, classes)
    encoders = tuple(dataclasses.replace(x, readout=readout) for x in learned.detectors)
    learned = dataclasses.replace(learned, detectors=encoders)
    with RunDirectory.create(tmp_path / "run", Settings("smoke", 0, config)) as created:
        save_models(created, learned)
    path = tmp_path / "exported.zip"
    export.main([str(tmp_path / "run"), "--out", str(path)])
    rng, given, expected = np.random.default_rng(0), {}, {}
    for sensor, encoder in zip(sensors.make(config), encoders, strict=True):
        name = f"detect_{sensor.name}"
        shape = functions(config)[name].inputs["readings"].shape
        scans = rng.uniform(0.3, 0.9, (BATCH, *shape)).astype(np.float32)
        bearings = rng.uniform(-0.3, 0.3, BATCH).astype(np.float32)
        given |= {
            f"{name}/readings": scans,
            f"{name}/bearing": bearings,
            f"{name}/distance": np.full(BATCH, 0.6, np.float32),
        }

        def features(scan, bearing):
            return encoder.features(windowing.cut_out(sensor, scan, bearing))  # noqa: B023

        expected[name] = np.asarray(jax.jit(jax.vmap(features))(scans, bearings))
        assert np.ptp(expected[name], axis=0).max() > 1e-3
    for player in ABSENT:
        found = played(path, player, given, tmp_path)
        for name, each in expected.items():
            np.testing.assert_allclose(found[f"{name}/features"], each, atol=1e-5)


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


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    """Settings, models and archive of a team with tours."""
    dqn = dataclasses.replace(PRESETS["team"].dqn, hidden=(8,))
    config = dataclasses.replace(CONFIG, dqn=dqn, robots=("camera", "lidar", "lidar"))
    trained = with_classes(init(jax.random.key(0), config), config)
    path = tmp_path_factory.mktemp("team") / "team.zip"
    path.write_bytes(export.archive(config, trained))
    return config, trained, path


@pytest.mark.slow
@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_a_team_may_have_any_number_of_points_and_robots(team, player):
    _, trained, path = team
    assert trained.agent.orders
    contents, programs = player.load(path)
    about = contents["programs"]["decide"]
    assert about["outputs"]["values"]["shape"] == ["pois + 1"]
    for num_pois, num_robots, num_looks in ((5, 3, 2), (2, 1, 1), (9, 4, 32)):
        rng = np.random.default_rng(num_pois)
        belief = Belief(*rng.uniform(0.1, 1, (2, num_pois, 2)).astype(np.float32))
        of_team = Team(
            positions=rng.normal(size=(num_pois, 2)).astype(np.float32),
            present=np.arange(num_pois) < 4,
            poses=rng.normal(size=(num_robots, 3)).astype(np.float32),
            modality=np.ones(num_robots, np.int32),
            works=np.ones(num_robots, bool),
            target=np.full(num_robots, num_pois, np.int32),
        )
        robot = np.int32(num_robots - 1)
        looked_from = np.full((num_pois, 2, num_looks, 2), np.inf, np.float32)
        given = {**vars(belief), **vars(of_team), "robot": robot, "looked_from": looked_from}
        found = programs["decide"](**given)
        expected = trained.agent.decide(
            trained.q_networks[1],
            trained.tours,
            trained.fusion.classes,
            belief,
            jax.tree.map(jnp.asarray, of_team),
            robot,
        )
        np.testing.assert_allclose(found["values"], expected, rtol=1e-4)
        # Values count travel time: the best is taken.
        assert found["action"] == np.argmax(expected)


@pytest.mark.slow
def test_a_value_that_is_not_a_number_is_answered_by_minus_one(team):
    _, _, path = team
    for player in (robot_numpy, robot_onnx):
        contents, programs = player.load(path)
        given = {
            name: np.ones([{"pois": 2}.get(n, n if isinstance(n, int) else 1) for n in x["shape"]])
            for name, x in contents["programs"]["decide"]["inputs"].items()
        }
        given["robot"] = 0
        assert programs["decide"](**given)["action"] >= 0
        given["mean"][1, 0] = np.nan
        assert programs["decide"](**given)["action"] == -1


@pytest.mark.slow
@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_the_example_plays_a_team(team, player):
    lines = runpy.run_path(str(EXAMPLE))["explore"](*player.load(team[2]), [0, 1, 2, 0])
    assert [line.split(" is a ")[0] for line in lines[-4:]] == [f"PoI {n}" for n in range(4)]
    assert any("looks at PoI" in line for line in lines)


@pytest.mark.slow
def test_decisions_are_those_of_missions(models, file):
    found = exported.choices(CONFIG, models, 60)
    compared = exported.compare(CONFIG, models, file.read_bytes(), found)
    assert {*compared} == {"NumPy", "onnxruntime"}
    for programs in compared.values():
        assert programs["decide"].states == len(found)
        assert {"classify", "decide", "write_camera", "detect_lidar"} < {*programs}
        assert all(each.different == 0 for each in programs.values())
        assert all(each.error < 1e-5 for each in programs.values())


def test_contents_describe_what_is_there(results, file):
    with zipfile.ZipFile(file) as files:
        contents, names = json.loads(files.read("contents.json")), {*files.namelist()}
        weights = np.load(io.BytesIO(files.read("weights.npz")))
        kernel = weights["q_networks/0/params/Dense_0/kernel"]
    others = {"contents.json", "programs.json", "weights.npz", *(x.name for x in export.FILES)}
    assert {"robot_numpy.py", "robot_onnx.py", "resampling.py"} < others
    assert {f"{name}.onnx" for name in contents["programs"]} | others == names
    inputs, of_players = results
    ends = [("inputs", inputs), *(("outputs", outputs) for outputs in of_players.values())]
    for end, given in ends:
        described = {
            f"{name}/{key}": ([BATCH, *(SIZES.get(n, n) for n in about["shape"])], about["dtype"])
            for name, program in contents["programs"].items()
            for key, about in program[end].items()
        }
        assert described == {key: (list(x.shape), x.dtype.name) for key, x in given.items()}
        assert all(x["about"] for p in contents["programs"].values() for x in p[end].values())
    assert kernel.shape[0] == 12  # three PoIs, two latent dimensions
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


@pytest.mark.parametrize("player", [robot_numpy, pytest.param(robot_onnx, marks=pytest.mark.slow)])
def test_an_exported_robot_searches_as_missions_do(models, player, tmp_path):
    errors = SearchConfig(position=0.06, heading=3.0)
    localisation = LocalisationConfig(search=errors)
    config = dataclasses.replace(
        CONFIG, mission=dataclasses.replace(CONFIG.mission, localisation=localisation)
    )
    # Untrained detectors have no scale, and are never unsure.
    unsure = tuple(
        dataclasses.replace(
            each,
            scale=jnp.float32(1.0),
            gate=dataclasses.replace(each.gate, scale=jnp.float32(1.0)),
        )
        for each in models.detectors
    )
    models = dataclasses.replace(models, detectors=unsure)
    path = tmp_path / "searching.zip"
    path.write_bytes(export.archive(config, models))
    _, programs = player.load(path)
    rng = np.random.default_rng(0)
    for m, sensor in enumerate(sensors.make(config)):

        @jax.jit
        def detect(*given):
            return [models.detect(m, sensor, *given, *search) for search in ((errors,), ())]  # noqa: B023

        channels = () if sensor.channels == 1 else (sensor.channels,)
        for bearing, distance in ((0.1, 0.7), (-0.2, 0.4), (3.0, 0.5)):
            scan = rng.uniform(0.1, 1.0, (len(sensor.angles), *channels)).astype(np.float32)
            given = scan, np.float32(bearing), np.float32(distance)
            searched, plain = detect(*given)
            about = dict(zip(("readings", "bearing", "distance"), given, strict=True))
            found = programs[f"detect_{sensor.name}"](**about)
            assert found["is_there"] == searched.is_there == (bearing < 1)
            np.testing.assert_allclose(found["features"], searched.features, atol=1e-5)
            assert bearing > 1 or np.abs(searched.features - plain.features).max() > 1e-4


@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_inputs_of_other_names_or_shapes_are_refused(file, player):
    _, programs = player.load(file)
    look = {"bearing": 0.0, "distance": 0.9}
    rays = len(sensors.make(CONFIG)[1].angles)
    other_scan = rf"detect_lidar: readings has the shape \({rays + 37},\): must be \({rays},\) .*; "
    with pytest.raises(ValueError, match=f"{other_scan}resample other scans first"):
        programs["detect_lidar"](readings=np.ones(rays + 37), **look)
    with pytest.raises(ValueError, match=r"bearing has the shape \(1,\): must be \(\) \(of the "):
        programs["detect_lidar"](readings=np.ones(rays), bearing=[0.0], distance=0.9)
    needs = "^detect_lidar needs readings, bearing, distance"
    with pytest.raises(TypeError, match=f"{needs}; scan is none of them; readings is missing$"):
        programs["detect_lidar"](scan=np.ones(rays), **look)
    with pytest.raises(TypeError, match=f"{needs}; more is none of them$"):
        programs["detect_lidar"](readings=np.ones(rays), more=1, **look)
    with pytest.raises(TypeError, match=f"{needs}, by name$"):
        programs["detect_lidar"](np.ones(rays), 0.0, 0.9)


@pytest.mark.parametrize("player", [robot_numpy, robot_onnx])
def test_axes_of_one_name_have_one_size(player):
    inputs = {
        "poses": {"shape": ["robots", 3], "dtype": "float32", "about": "of the robots"},
        "works": {"shape": ["robots"], "dtype": "bool", "about": "which are at work"},
    }
    for number in (1, 4):
        given = {"poses": np.zeros((number, 3)), "works": np.ones(number)}
        found = player.checked("decide", inputs, (), given)
        assert found["works"].dtype == bool
    with pytest.raises(ValueError, match=r"poses has the shape \(4,\): must be \(robots, 3\)"):
        player.checked("decide", inputs, (), {"poses": np.zeros(4), "works": np.ones(4)})
    with pytest.raises(ValueError, match=r"works has the shape \(3,\): must be \(4,\) \(which are"):
        player.checked("decide", inputs, (), {"poses": np.zeros((4, 3)), "works": np.ones(3)})


def test_both_players_check_alike():
    # Each file is copied to robots alone.
    assert inspect.getsource(robot_numpy.checked) == inspect.getsource(robot_onnx.checked)

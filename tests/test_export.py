"""The exported file, run in processes that can import neither jaxsense nor JAX."""

import dataclasses
import io
import json
import re
import runpy
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import pytest
from smoke import error_line, save_models

from benchmarks import exported
from jaxsense import export
from jaxsense.config import (
    PRESETS,
    DetectorConfig,
    JmvaeConfig,
    LocalisationConfig,
    SearchConfig,
)
from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.dqn import observation, team_mdp
from jaxsense.dqn.team_mdp import Team
from jaxsense.interfaces import robot_numpy, robot_onnx
from jaxsense.interfaces.onboard import functions
from jaxsense.models import init, make_in_place, make_jmvae, make_readout
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.sim import windows as windowing
from jaxsense.vae import detectors, jmvae, latent
from jaxsense.vae.novelty import Novelty

EXAMPLE = Path(__file__).parent.parent / "examples" / "run_exported.py"
CONFIG = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(hidden=(8,)),
    jmvae=JmvaeConfig(hidden=(8,)),
)
BATCH = 12
SIZES = {"pois": 3, "robots": 2, "looks": 4}
ALONE = f"""
import runpy, sys

class Only:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"{{name}} is not here")

sys.meta_path.insert(0, Only())
del sys.argv[1]
example = runpy.run_path({str(EXAMPLE)!r})
"""
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
ABSENT = {
    "robot_numpy": "jaxsense,jax,jaxlib,onnx,onnxruntime",
    "robot_onnx": "jaxsense,jax,jaxlib,onnx",
}


def run_alone(code, player, *arguments):
    """Runs code where nothing is there but what a player needs."""
    command = [sys.executable, "-I", "-c", ALONE + code, ABSENT[player], *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def models():
    return with_classes(init(jax.random.key(0), CONFIG), CONFIG)


def with_classes(models, config):
    """The models, with classes at random places in the latent space."""
    means = jax.random.normal(jax.random.key(1), models.fusion.classes.mean.shape)
    classes = Belief(means, jnp.ones_like(means))
    return dataclasses.replace(
        models,
        fusion=make_in_place(config, models.jmvae, classes),
        novelty=Novelty(jnp.array([5.0, 20.0]), jnp.array([0.3, 0.9])),
    )


@pytest.fixture(scope="module")
def run(models, tmp_path_factory):
    """The directory of a run that trained nothing."""
    path = tmp_path_factory.mktemp("runs") / "run"
    with RunDirectory.create(path, Settings("smoke", 0, CONFIG)) as created:
        save_models(created, models)
    return path


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "exported.zip"
    export.main([str(run), "--out", str(path)])
    return path


@pytest.fixture(scope="module", params=[*ABSENT])
def results(request, models, file, tmp_path_factory):
    """`{NAME/KEY: array}` of what all programs were given, and of what they gave elsewhere."""
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
    np.savez(folder / "in.npz", **inputs)
    player = request.param
    done = run_alone(RUN_ALL, player, file, player, folder / "in.npz", folder / "out.npz")
    assert done.returncode == 0, done.stderr
    return inputs, dict(np.load(folder / "out.npz"))


def check(results, name, expected, *keys):
    """`expected(*inputs of one example) -> outputs`, for each of the batch."""
    inputs, outputs = results
    given = [value for key, value in inputs.items() if key.startswith(f"{name}/")]
    for row in range(BATCH):
        for key, value in zip(keys, expected(*(x[row] for x in given)), strict=True):
            found = outputs[f"{name}/{key}"][row]
            np.testing.assert_allclose(found, value, atol=1e-5, err_msg=f"{name}/{key}")


@pytest.mark.parametrize("m", [0, 1])
def test_programs_of_a_sensor_give_what_jaxsense_gives(models, results, m):
    name = CONFIG.modalities[m]
    sensor = sensors.make(CONFIG)[m]

    def detect(readings, bearing, distance):
        # The nearest window in the scan, ray by ray.
        centre = float(sensor.centre(bearing))
        first = round(centre - (sensor.window - 1) * sensor.stride / 2)
        rays = first + np.arange(sensor.window) * sensor.stride
        window = np.minimum(readings[rays], sensor.window_limit).reshape(-1)
        features = detectors.detect(models.detectors[m], window)
        return True, features.max() >= CONFIG.mission.least_confidence, features

    def write(mean, std, seen, features, weight):
        belief = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return belief.mean, belief.std

    def weigh(apart):
        return models.novelty.weight(apart, m), models.novelty.to_go(apart, m)

    check(results, f"detect_{name}", detect, "is_there", "detects", "features")
    check(results, f"weigh_{name}", weigh, "weight", "to_go")
    check(results, f"write_{name}", write, "new_mean", "new_std")


def test_decisions_are_those_of_the_policy_and_the_rules(models, results):
    network = MLP(CONFIG.dqn.hidden, CONFIG.arena.num_pois + 1)
    classes, settings = models.fusion.classes, CONFIG.mission
    assert settings.auctions

    def values_of(mean, std, present, m):
        # A mean over all classes that a PoI which is not present may have.
        of_each = [
            network.apply(
                models.q_networks[m],
                observation(
                    Belief(
                        np.where(present[:, None], mean, classes.mean[c]),
                        np.where(present[:, None], std, classes.std[c]),
                    )
                ),
            )
            for c in range(len(classes.mean))
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
            there = team_mdp.travel_seconds(CONFIG.team.travel, poses[r], positions[poi][None])
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
    _, outputs = results
    assert len(set(outputs["decide/action"].tolist())) > 1


@pytest.mark.parametrize("player", [*ABSENT])
@pytest.mark.parametrize("m", [0, 1])
def test_an_exported_detector_answers_what_is_not_there(file, tmp_path, m, player):
    name = CONFIG.modalities[m]
    inputs = functions(CONFIG)[f"detect_{name}"].inputs
    scan = np.full(inputs["readings"].shape, 0.5, np.float32)
    ahead = len(scan) // 2
    at = {"bearing": 0.0, "distance": 1.0}
    cases = [
        (scan, at, True),
        (np.where(scan > 0, np.nan, scan), at, False),
        (scan.copy(), at, False),
        (-scan, at, False),
        # A beam without a return; no pixel is infinitely bright.
        (np.where(scan > 0, np.inf, scan), at, sensors.make(CONFIG)[m].measures_distance),
        *((scan, {**at, "bearing": b}, False) for b in (np.radians(121.0), -np.pi, np.nan)),
        *((scan, {**at, "distance": d}, False) for d in (0.0, -1.0, np.inf, np.nan)),
    ]
    cases[2][0][ahead : ahead + 4] = np.nan  # the camera reads every fourth pixel
    given = {
        f"detect_{name}/readings": np.stack([readings for readings, _, _ in cases]),
        **{f"detect_{name}/{key}": np.float32([x[key] for _, x, _ in cases]) for key in at},
    }
    np.savez(tmp_path / "in.npz", **given)
    done = run_alone(RUN_ALL, player, file, player, tmp_path / "in.npz", tmp_path / "out.npz")
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "out.npz")
    expected = [is_there for _, _, is_there in cases]
    np.testing.assert_array_equal(found[f"detect_{name}/is_there"], expected)
    features = found[f"detect_{name}/features"]
    assert np.isfinite(features).all()
    np.testing.assert_allclose(features[~np.array(expected)], 0.5)


@pytest.mark.parametrize("player", [*ABSENT])
def test_encoders_of_scans_give_what_jaxsense_gives(tmp_path, player):
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
    export.main([str(tmp_path / "run"), "--out", str(tmp_path / "exported.zip")])
    rng, given, expected = np.random.default_rng(0), {}, {}
    for m, sensor in enumerate(sensors.make(config)):
        shape = functions(config)[f"detect_{sensor.name}"].inputs["readings"].shape
        scans = rng.uniform(0.3, 0.9, (BATCH, *shape)).astype(np.float32)
        given |= {
            f"detect_{sensor.name}/readings": scans,
            f"detect_{sensor.name}/bearing": rng.uniform(-0.3, 0.3, BATCH).astype(np.float32),
            f"detect_{sensor.name}/distance": np.full(BATCH, 0.6, np.float32),
        }
        windows = [
            windowing.cut_out(sensor, scan, bearing)
            for scan, bearing in zip(scans, given[f"detect_{sensor.name}/bearing"], strict=True)
        ]
        expected[sensor.name] = jax.vmap(learned.detectors[m].features)(jnp.stack(windows))
        assert np.ptp(np.asarray(expected[sensor.name]), axis=0).max() > 1e-3
    np.savez(tmp_path / "in.npz", **given)
    files = tmp_path / "in.npz", tmp_path / "out.npz"
    done = run_alone(RUN_ALL, player, tmp_path / "exported.zip", player, *files)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "out.npz")
    for name, features in expected.items():
        np.testing.assert_allclose(found[f"detect_{name}/features"], features, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "given"), [("camera", [0]), ("lidar", [1]), ("camera+lidar", [0, 1])]
)
def test_encoders_give_what_jaxsense_gives(models, results, name, given):
    def encode(*features):
        of_each = [None, None]
        for m, x in zip(given, features, strict=True):
            of_each[m] = x
        mean, log_var = jmvae.encode(models.jmvae, make_jmvae(CONFIG), tuple(of_each))
        return mean, jnp.exp(log_var / 2)

    check(results, f"encode_{name}", encode, "mean", "std")


def test_the_map_is_read_as_jaxsense_reads_it(models, results):
    means = models.fusion.classes.mean

    def classify(mean, std):
        beliefs = [Belief(*each) for each in zip(mean, std, strict=True)]
        probabilities = [models.fusion.class_probabilities(belief) for belief in beliefs]
        most_likely = [models.fusion.most_likely_class(belief) for belief in beliefs]
        told = [latent.plausible_classes(belief, means) for belief in beliefs]
        return np.stack(probabilities), np.stack(most_likely), np.stack(told)

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
    others = {"contents.json", "programs.json", "weights.npz", "robot_numpy.py", "robot_onnx.py"}
    assert {f"{name}.onnx" for name in contents["programs"]} | others == names
    for given, end in zip(results, ("inputs", "outputs"), strict=True):
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
    assert contents["versions"] == {"jaxsense": __version__}


def test_onnx_files_name_what_they_take_and_give(file):
    with zipfile.ZipFile(file) as files:
        contents = json.loads(files.read("contents.json"))
        for name, about in contents["programs"].items():
            graph = onnx.load_model_from_string(files.read(f"{name}.onnx")).graph
            for ends, key in ((graph.input, "inputs"), (graph.output, "outputs")):
                shapes = {
                    each.name: [n.dim_param or n.dim_value for n in each.type.tensor_type.shape.dim]
                    for each in ends
                }
                assert shapes == {n: x["shape"] for n, x in about[key].items()}


@pytest.mark.parametrize("variance", [20.0, 5.0])
def test_contents_hold_the_belief_before_any_look(variance):
    config = dataclasses.replace(
        CONFIG, mdp=dataclasses.replace(CONFIG.mdp, unseen_variance=variance)
    )
    contents = export._description(config, init(jax.random.key(0), config))
    assert contents["unseen"] == {"mean": [0.0, 0.0], "std": pytest.approx([variance**0.5] * 2)}


@pytest.mark.parametrize("player", [*ABSENT])
def test_the_example_plays_a_map_and_refuses_other_files(file, tmp_path, player):
    options = ["--onnx"] if player == "robot_onnx" else []
    done = run_alone("example['main']()", player, file, *options)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("PoI 2 is a red cube; the map says: ")]
    (tmp_path / "text").write_text("no archive")
    done = run_alone("example['main']()", player, tmp_path / "text", *options)
    assert done.returncode == 1
    assert "must be a file of `python -m jaxsense.export`" in done.stderr


def test_a_missing_package_is_one_line_with_its_extra(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    line = error_line([str(run), "--out", str(tmp_path / "x.zip")], capsys, export)
    assert line == "jaxsense.export: onnx is not installed: pip install 'jaxsense[export]'"
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("problem", ["run", "out", "folder"])
def test_bad_input_is_one_line_and_overwrites_nothing(run, tmp_path, capsys, problem):
    existing = tmp_path / "precious.zip"
    existing.write_text("precious")
    argv, expected = {
        "run": ([str(tmp_path / "no_run")], "no_run is not a run directory: it has no config.json"),
        "out": ([str(run), "--out", str(existing)], "out = .*already exists; must be a new file"),
        "folder": ([str(run), "--out", str(tmp_path / "no" / "x.zip")], "out = .*cannot be writ"),
    }[problem]
    with pytest.raises(SystemExit) as stop:
        export.main(argv)
    message = capsys.readouterr().err
    assert stop.value.code == 2
    assert message.count("\n") == 1
    assert message.startswith("jaxsense.export: ")
    assert re.search(expected, message)
    assert existing.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [existing]


def test_a_file_that_appears_meanwhile_is_not_replaced(run, tmp_path, monkeypatch, capsys):
    path = tmp_path / "x.zip"

    def meanwhile(*_):
        path.write_text("of another process", encoding="utf-8")
        return b"ours"

    monkeypatch.setattr(export, "archive", meanwhile)
    line = error_line([str(run), "--out", str(path)], capsys, export)
    assert "x.zip': already exists; must be a new file" in line
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_text(encoding="utf-8") == "of another process"


def test_an_export_that_is_stopped_leaves_nothing(run, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "archive", stop)
    with pytest.raises(KeyboardInterrupt):
        export.main([str(run), "--out", str(tmp_path / "x.zip")])
    assert not [*tmp_path.iterdir()]


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
        channels = () if sensor.channels == 1 else (sensor.channels,)
        for bearing, distance in ((0.1, 0.7), (-0.2, 0.4), (3.0, 0.5)):
            scan = rng.uniform(0.1, 1.0, (len(sensor.angles), *channels)).astype(np.float32)
            given = scan, np.float32(bearing), np.float32(distance)
            searched = models.detect(m, sensor, *given, errors)
            plain = models.detect(m, sensor, *given)
            about = dict(zip(("readings", "bearing", "distance"), given, strict=True))
            found = programs[f"detect_{sensor.name}"](**about)
            assert found["is_there"] == searched.is_there == (bearing < 1)
            np.testing.assert_allclose(found["features"], searched.features, atol=1e-5)
            assert bearing > 1 or np.abs(searched.features - plain.features).max() > 1e-4

"""The exported file, run by the example in a process that cannot import jaxsense."""

import dataclasses
import importlib.metadata
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
import pytest
from smoke import error_line, save_models

from jaxsense import export
from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig
from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.dqn import observation
from jaxsense.dqn.team_mdp import Team
from jaxsense.interfaces.onboard import functions
from jaxsense.models import init, make_in_place, make_jmvae
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.vae import detectors, jmvae, latent
from jaxsense.vae.novelty import Novelty

EXAMPLE = Path(__file__).parent.parent / "examples" / "run_exported.py"
CONFIG = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(hidden=(8,)),
    jmvae=JmvaeConfig(hidden=(8,)),
)
BATCH = 5
ALONE = f"""
import runpy, sys

class NoJaxsense:
    def find_spec(self, name, *_):
        if name.partition(".")[0] == "jaxsense":
            raise ModuleNotFoundError("jaxsense is not here")

sys.meta_path.insert(0, NoJaxsense())
example = runpy.run_path({str(EXAMPLE)!r})
"""
RUN_ALL = """
import numpy as np
contents, programs = example["load"](sys.argv[1])
inputs, found = np.load(sys.argv[2]), {}
for name, about in contents["programs"].items():
    given = [inputs[f"{name}/{key}"] for key in about["inputs"] if f"{name}/{key}" in inputs]
    if not given:
        continue
    found |= {f"{name}/{key}": value for key, value in programs[name](*given).items()}
np.savez(sys.argv[3], **found)
"""


def run_alone(code, *arguments):
    command = [sys.executable, "-I", "-c", ALONE + code, *map(str, arguments)]
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
        novelty=Novelty(jnp.array([0.5, 2.0]), jnp.array([0.3, 0.6])),
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


@pytest.fixture(scope="module")
def results(models, file, tmp_path_factory):
    """`{NAME/KEY: array}` of what all programs were given, and of what they gave elsewhere."""
    rng, inputs = np.random.default_rng(0), {}
    for name, function in functions(CONFIG, models).items():
        for key, aval in function.inputs.items():
            drawn = rng.uniform(0.1, 1.0, (BATCH, *aval.shape)) * (0.3 if key == "bearing" else 1)
            drawn = drawn > 0.55 if aval.dtype == bool else drawn
            # Features are probabilities.
            drawn = drawn / drawn.sum(axis=-1, keepdims=True) if key == "features" else drawn
            inputs[f"{name}/{key}"] = drawn.astype(aval.dtype)
    folder = tmp_path_factory.mktemp("results")
    np.savez(folder / "in.npz", **inputs)
    done = run_alone(RUN_ALL, file, folder / "in.npz", folder / "out.npz")
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
        return True, detectors.detect(models.detectors[m], window)

    def write(mean, std, seen, features, weight):
        belief = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return belief.mean, belief.std

    network = MLP(CONFIG.dqn.hidden, CONFIG.arena.num_pois + 1)

    def decide(mean, std, present):
        # A mean over all classes that a PoI which is not present may have.
        classes = models.fusion.classes
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
        values = np.mean(of_each, axis=0)
        values = np.where(np.append(present, True), values, -np.inf)
        return np.argmax(values), values

    check(results, f"detect_{name}", detect, "is_there", "features")
    check(results, f"weigh_{name}", lambda apart: [models.novelty.weight(apart, m)], "weight")
    check(results, f"write_{name}", write, "mean", "std")
    check(results, f"decide_{name}", decide, "action", "values")


@pytest.mark.parametrize("m", [0, 1])
def test_an_exported_detector_answers_what_is_not_there(models, file, tmp_path, m):
    name = CONFIG.modalities[m]
    inputs = functions(CONFIG, models)[f"detect_{name}"].inputs
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
    done = run_alone(RUN_ALL, file, tmp_path / "in.npz", tmp_path / "out.npz")
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "out.npz")
    expected = [is_there for _, _, is_there in cases]
    np.testing.assert_array_equal(found[f"detect_{name}/is_there"], expected)
    features = found[f"detect_{name}/features"]
    assert np.isfinite(features).all()
    np.testing.assert_allclose(features[~np.array(expected)], 0.5)


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
        belief = Belief(mean, std)
        shown = models.fusion.most_likely_class(belief)
        return shown, latent.plausible_classes(belief, means)

    check(results, "classify", classify, "most_likely", "plausible")


def test_the_policy_of_a_team_serves_any_number_of_points_and_robots():
    dqn = dataclasses.replace(PRESETS["team"].dqn, hidden=(8,))
    config = dataclasses.replace(CONFIG, dqn=dqn, robots=("camera", "lidar", "lidar"))
    trained = with_classes(init(jax.random.key(0), config), config)
    of_run = functions(config, trained)
    decide = export.exported(of_run["decide_lidar"])

    @jax.jit
    def values(belief, team, robot):
        q_network, classes = trained.q_networks[1], trained.fusion.classes
        return trained.agent.decide(q_network, trained.tours, classes, belief, team, robot)

    assert [str(n) for n in decide.out_avals[1].shape] == ["batch", "points + 1"]
    for num_pois, num_robots in ((5, 3), (2, 1)):
        rng = np.random.default_rng(num_pois)
        belief = Belief(*rng.uniform(0.1, 1, (2, num_pois, 2)).astype(np.float32))
        team = Team(
            positions=rng.normal(size=(num_pois, 2)).astype(np.float32),
            present=np.arange(num_pois) < 4,
            poses=rng.normal(size=(num_robots, 3)).astype(np.float32),
            modality=np.ones(num_robots, np.int32),
            works=np.ones(num_robots, bool),
            target=np.full(num_robots, num_pois, np.int32),
        )
        given = {**vars(belief), **vars(team), "robot": np.int32(num_robots - 1)}
        inputs = (np.asarray(given[name])[None] for name in of_run["decide_lidar"].inputs)
        found = decide.call(*inputs)
        expected = values(belief, team, given["robot"])
        np.testing.assert_allclose(found["values"][0], expected, rtol=1e-4)
        assert found["action"][0] == np.argmax(expected)

    # The example plays a team with the same functions.
    programs = {name: jax.jit(jax.vmap(f.apply)) for name, f in of_run.items()}
    contents = export._description(config, trained)
    contents["programs"] = {name: {"inputs": list(f.inputs)} for name, f in of_run.items()}
    lines = runpy.run_path(str(EXAMPLE))["explore"](contents, programs, [0, 1, 2, 0])
    assert [line.split(" is a ")[0] for line in lines[-4:]] == [f"PoI {n}" for n in range(4)]
    assert any("looks at PoI" in line for line in lines)


def test_contents_describe_what_is_there(results, file):
    with zipfile.ZipFile(file) as files:
        contents = json.loads(files.read("contents.json"))
        names = {name.removesuffix(".bin") for name in files.namelist()} - {"contents.json"}
    assert set(contents["programs"]) == names
    sizes = {"looks": 4}
    for given, end in zip(results, ("inputs", "outputs"), strict=True):
        described = {
            f"{name}/{key}": (
                [BATCH, *(sizes.get(n, n) for n in about["shape"][1:])],
                about["dtype"],
            )
            for name, program in contents["programs"].items()
            for key, about in program[end].items()
        }
        assert described == {key: (list(x.shape), x.dtype.name) for key, x in given.items()}
    assert contents["labels"] == {"camera": ["red", "green"], "lidar": ["cylinder", "cube"]}
    assert contents["classes"] == list(CONFIG.arena.classes)
    assert contents["versions"]["jax"] == jax.__version__


@pytest.mark.parametrize("variance", [20.0, 5.0])
def test_contents_hold_the_belief_before_any_look(variance):
    config = dataclasses.replace(
        CONFIG, mdp=dataclasses.replace(CONFIG.mdp, unseen_variance=variance)
    )
    contents = export._description(config, init(jax.random.key(0), config))
    assert contents["unseen"] == {"mean": [0.0, 0.0], "std": pytest.approx([variance**0.5] * 2)}


def test_programs_are_lowered_for_accelerators_too(models):
    program = export.exported(functions(CONFIG, models)["classify"])
    assert program.platforms == ("cpu", "cuda", "tpu")


def test_the_example_plays_a_map_and_refuses_other_files(file, tmp_path):
    done = run_alone("sys.argv[0] = 'run_exported.py'; example['main']()", file)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith("PoI 2 is a red cube; the map says: ")]
    (tmp_path / "text").write_text("no archive")
    done = run_alone("example['main']()", tmp_path / "text")
    assert done.returncode == 1
    assert "must be a file of `python -m jaxsense.export`" in done.stderr


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


def test_a_package_that_is_not_installed_can_export(models, monkeypatch):
    version = importlib.metadata.version

    def of_others(name):
        if name == "jaxsense":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", of_others)
    monkeypatch.setattr(export, "functions", lambda config, models: {})
    with zipfile.ZipFile(io.BytesIO(export.archive(CONFIG, models))) as files:
        contents = json.loads(files.read("contents.json"))
    assert contents["versions"]["jaxsense"] == __version__

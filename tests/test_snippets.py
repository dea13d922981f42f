"""Examples of pages and notebooks run, and do and print what the text around them says."""

import dataclasses
import importlib.util
import json
import re
import zipfile
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from jaxsense import PRESETS, export, train, vae

ROOT = Path(__file__).parent.parent


def snippets(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


PROGRAM, CLASSES, ATTRIBUTE, SENSOR, SETTINGS, *_ = snippets("docs/extending.md")
PLAYED, RESAMPLED, LOOKS, RETRAINED, ARCHIVED = snippets("docs/robot.md")
INTERFACES = snippets("docs/interfaces.md")


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module


def run(*parts, **names):
    """The names that snippets of one program define, without any other names."""
    for part in parts:
        exec(part, names)
    return names


def test_example_of_the_readme_runs(capsys):
    names = run(snippets("README.md")[-1])
    assert capsys.readouterr().out == f"(12,) {names['seen'].reward!s}\n"
    # A look costs 0.1 nats, and tells at most which of three classes it is: log 3 = 1.10.
    assert -0.1 <= float(names["seen"].reward) < 1.0


DECIMAL = r"-?\d+\.\d+"
PAGES = [
    ("getting-started.md", -1, r"\(64, 2\) \(64, 2\)\n"),
    ("getting-started.md", 0, r"\[.*\]\n"),  # trains as far as the latent space
    *(("functions.md", i, ".*") for i in range(5)),
    ("jmvae.md", -1, rf"\(200, 2\) \(200, 2\)\n.* (1\.0|0\.99)\d*\n.* {DECIMAL}\n"),
    ("tasks.md", 0, ".*"),
    ("tasks.md", 1, ".*"),
    ("tasks.md", 2, r"(.*False.*\n)\1"),  # of the observation, and of the state
    *(("tasks.md", i, ".*noisy-v0, camera, 10 seeds: return.*") for i in (3, 5)),
    ("tasks.md", 4, r".*\(10,\)\n"),
    ("tasks.md", 6, ".*mine.*"),
    ("tasks.md", 7, rf".*map-v0, camera, \d+ seeds?: return {DECIMAL}.*random.*"),
    ("tasks.md", 8, r".*--preset team --seed \d+.*"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "which", "printed"), PAGES)
def test_examples_of_the_pages_run(page, which, printed, capsys):
    run(snippets(f"docs/{page}")[which])
    assert re.fullmatch(printed, capsys.readouterr().out, re.DOTALL)


# Of each example of the interfaces' page; those without only make what later ones use.
NEEDS = (
    "gymnasium", "gymnax", "rejax", "stable_baselines3", "jaxmarl", "pettingzoo", "", "gymnax",
    "gymnasium", "", "jaxmarl", "onnx",
)  # fmt: skip


@pytest.fixture(scope="module")
def names():
    return run(*(part for part, package in zip(INTERFACES, NEEDS, strict=True) if not package))


@pytest.mark.slow  # the tests of each interface take the same steps
@pytest.mark.parametrize(("number", "package"), [(i, n) for i, n in enumerate(NEEDS) if n], ids=str)
def test_examples_of_interfaces_print_what_they_say(
    names, number, package, tmp_path, monkeypatch, capsys
):
    if importlib.util.find_spec(package) is None:  # jaxmarl's import takes `sys.stdout`
        pytest.skip(f"{package}: needs the extra that the page names")
    if package == "stable_baselines3":
        importlib.import_module("torch").set_num_threads(1)  # more get into each other's way
    monkeypatch.chdir(tmp_path)
    if package == "onnx":
        Path("robot.zip").write_bytes(export.archive(names["config"], names["models"]))
    run(INTERFACES[number], **names)
    (printed,) = re.findall(r"^print\(.*\)  # ([^;\n]*)", INTERFACES[number], re.MULTILINE)
    assert capsys.readouterr().out == f"{printed}\n"


NOTEBOOKS = {
    "tasks": [r"noisy-v0, lidar, 10 seeds: return"],
    # Both of the uncertain sensors spoke for a red cylinder.
    "jmvae_and_fusion": [
        "possible: red cylinder, red cube",
        "possible: green cylinder, red cylinder",
        "possible: red cylinder\n",
    ],
    "single_functions": [r"0\.50 certain", r"0\.99 certain", "look", r"stop\s*$"],
    "your_robot": [
        "is there: True",
        r"distance 0\.8: True",
        r"bearing 0\.0, distance 1\.1: False",
        r"bearing 0\.6, distance 0\.8: False",
        r"bearing 0\.0, distance 1\.3: False, not known",
        r"\['green cylinder', 'red cylinder'\]",
    ],
}


def test_every_example_is_run():
    assert len(NEEDS) == len(INTERFACES)
    there = {path.stem for path in (ROOT / "examples" / "notebooks").glob("*.ipynb")}
    assert there == NOTEBOOKS.keys()


@pytest.mark.slow  # the same functions run in the examples of pages
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_prints_what_its_text_says(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    path = ROOT / "examples" / "notebooks" / f"{name}.ipynb"
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    run(*code, __name__="__main__")
    printed = capsys.readouterr().out
    assert not [line for line in NOTEBOOKS[name] if not re.search(line, printed)]


def test_a_program_trains_with_its_own_change(monkeypatch):
    given = []
    options = ["--preset", "smoke"]
    monkeypatch.setattr(train, "main", lambda change: given.append(train.parse(options, change)))
    run(PROGRAM, __name__="imported")
    assert given == []
    run(PROGRAM, __name__="__main__")
    assert [each.settings.config.carried for each in given] == [("camera", "camera", "lidar")]


def test_classes_are_those_of_the_example(example):
    config = PRESETS["smoke"]
    assert run(CLASSES)["change"](config) == example("new_classes").change(config)


def test_a_modality_is_that_of_the_example(example):
    config, found = PRESETS["smoke"], run(ATTRIBUTE, SENSOR, SETTINGS)
    module = example("new_modality")
    expected = module.change(config)
    assert found["change"](config) == expected
    ours, theirs = found["thermal"](config), module.thermal(expected)
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    # The class is written out on the page; its readings are those of the example's.
    hits = SimpleNamespace(geom=np.array([0, 1, 2, 1]))
    readings = [
        sensor.read(jax.random.key(0), hits, {"temperature": np.array([20.0, 30.0, 60.0])}, None)
        for sensor in (ours, theirs)
    ]
    np.testing.assert_array_equal(*readings)


@pytest.fixture
def recording(example):
    """Simulated looks at a PoI of each class."""
    return example("recorded_scans").simulate(PRESETS["default"])


@pytest.mark.slow
def test_looks_fill_the_map(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.savez("recorded.npz", **recording)
    found = run(LOOKS)
    assert found["seen"].all()
    assert capsys.readouterr().out == f"{PRESETS['default'].arena.classes[0]}\n"
    # Each look adds to the ones before it: the LiDAR alone says less.
    both, alone = map(found["models"].fusion.class_probabilities, (found["belief"], found["alone"]))
    assert both[0] > max(0.9, alone[0])


def test_an_archive_reads_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    export.main(["pretrained:noisy", "--out", "robot.zip"])
    capsys.readouterr()
    assert run(PLAYED, RESAMPLED)["scan"].shape == (683,)
    printed = "False {'cylinder': 0.5, 'cube': 0.5}\n(683,) True\nFalse\n"
    assert capsys.readouterr().out == printed


@pytest.mark.slow
def test_a_detector_is_retrained_with_labelled_looks(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    looks = {name: np.concatenate([x] * 4) for name, x in recording.items()}
    labels = np.tile(PRESETS["default"].arena.label_of_class("shape"), 4)
    np.savez("known.npz", **looks)
    np.save("labels.npy", labels)
    found = run(RETRAINED, ARCHIVED)
    features = jax.vmap(vae.features, (None, 0, 0))(
        found["detector"], np.stack(found["windows"]), found["distances"]
    )
    np.testing.assert_array_equal(np.argmax(features, axis=1), labels)
    # The archive holds the retrained detector.
    with zipfile.ZipFile("robot.zip") as archive:
        graph = onnx.load_model_from_string(archive.read("detect_lidar.onnx")).graph
    own = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    kept = own["detectors/1/params/params/Dense_0/kernel"]
    np.testing.assert_array_equal(kept, found["detector"].params["params"]["Dense_0"]["kernel"])

"""What cannot be used is refused: one line that names it and says what would be right."""

import ast
import contextlib
import dataclasses
import json
import math
import re
import subprocess
import sys
import time
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsense
from benchmarks import __main__ as benchmarks
from jaxsense import (
    PRESETS,
    Attribute,
    Belief,
    Config,
    ConfigError,
    SensorConfig,
    Shape,
    dqn,
    evaluate,
    export,
    interfaces,
    mission,
    pipeline,
    sim,
    train,
    vae,
)
from jaxsense.config import COLOURS, SHAPES, ArenaConfig, as_plain, from_plain
from jaxsense.files import WriteError
from jaxsense.monitor import StageError
from jaxsense.rundir import RunDirectory, Settings, read_settings

SMOKE = PRESETS["smoke"]
NAN, INF = math.nan, math.inf
HUGE = 10**5000
SECTIONS = {
    field.name: getattr(SMOKE, field.name)
    for field in dataclasses.fields(SMOKE)
    if dataclasses.is_dataclass(getattr(SMOKE, field.name))
}
FIELDS = [(name, f) for name, section in SECTIONS.items() for f in dataclasses.fields(section)]
NUMBERS = [(name, f.name) for name, f in FIELDS if f.type in (int, float)]
SECONDS = 10.0


def check_message(text: str) -> None:
    """One line of the form `field = value: what would be right`, or `value of what is wrong`."""
    assert "\n" not in text
    assert len(text) < 900
    assert re.search(r"\S+ .+: \S+", text), text


# Settings -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value", [NAN, INF, -INF, -1, 1e300, -1e300, 1e-300, 2**63, HUGE], ids=count()
)
def test_no_number_may_be_such(value):
    """2**63 metres or steps and the like; where only real numbers are meant, 2**63 is one."""
    for section, name in NUMBERS:
        if value == 2**63 and isinstance(getattr(SECTIONS[section], name), float):
            continue
        with pytest.raises(ConfigError) as error:
            dataclasses.replace(SECTIONS[section], **{name: value})
        check_message(str(error.value))
        assert str(error.value).startswith(f"{section}.{name} = "), error.value


@pytest.mark.parametrize(
    "value", ["x", "", "1", None, True, [], {}, (1,), b"1", np.arange(2), int], ids=count()
)
def test_no_number_may_be_something_else(value):
    for section, name in NUMBERS:
        with pytest.raises(ConfigError) as error:
            dataclasses.replace(SECTIONS[section], **{name: value})
        check_message(str(error.value))
        assert str(error.value).startswith(f"{section}.{name} = ")


ZERO = {
    "lidar.range_noise", "camera.pixel_noise", "viewpoint.max_bearing", "viewpoint.bearing_error",
    "viewpoint.clearance", "jmvae.alpha", "jmvae.annealing", "mdp.min_increase", "dqn.discount",
    "dqn.final_learning_rate", "dqn.epsilon_min", "navigation.inflation", "mission.equal_values",
    "mission.least_confidence",
}  # fmt: skip


def test_only_these_numbers_may_be_zero():
    for section, name in NUMBERS:
        if f"{section}.{name}" in ZERO:
            dataclasses.replace(SECTIONS[section], **{name: 0})
        else:
            with pytest.raises(ConfigError, match=f"^{section}."):
                dataclasses.replace(SECTIONS[section], **{name: 0})


ANYTHING = st.one_of(
    st.floats(), st.integers(), st.text(max_size=5), st.none(), st.booleans(),
    st.lists(st.integers(-2, 2), max_size=3), st.lists(st.floats(), max_size=3).map(tuple),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)  # fmt: skip


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.sampled_from(FIELDS), ANYTHING), min_size=1, max_size=3))
def test_settings_are_refused_or_survive_json(changes):
    try:
        config = SMOKE
        for (section, field), value in changes:
            part = dataclasses.replace(getattr(config, section), **{field.name: value})
            config = dataclasses.replace(config, **{section: part})
    except ConfigError as error:
        check_message(str(error))
    else:
        assert from_plain(json.loads(json.dumps(as_plain(config), allow_nan=False))) == config


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(
    st.dictionaries(
        st.sampled_from([*SECTIONS, "modalities", "sensors", "x"]),
        st.recursive(
            ANYTHING, lambda inner: st.dictionaries(st.sampled_from(["hidden", "a"]), inner)
        ),
        min_size=1,
    )
)
def test_plain_settings_are_refused_or_used(stored):
    try:
        assert isinstance(from_plain(stored), Config)
    except ConfigError as error:
        check_message(str(error))


TWINS = {**COLOURS, "crimson": COLOURS["red"]}
TURNED = {**SHAPES, "slab": Shape("box", (1.0, 0.5)), "board": Shape("box", (0.5, 1.0))}
CHANGES = [
    ({"modalities": ["lidar"]}, "modalities = ['lidar']: must be a tuple of texts"),
    ({"modalities": ("lidar", "lidar")}, "must name no modality twice"),
    (
        {
            "arena.attributes": {"heat": Attribute({"hot": 1.0, "cold": 0.0})},
            "arena.classes": ("red cube hot", "red cube cold"),
        },
        "must not have both 'red cube hot' and 'red cube cold', which no sensor can tell apart",
    ),
    ({"modalities": ("lidar", "")}, "must be some of"),
    ({"modalities": ("lidar\n",)}, "must be some of"),
    ({"arena": 3}, "arena = 3: must be of type ArenaConfig"),
    ({"arena": None}, "arena = None: must be of type"),
    ({"sensors": {1: SensorConfig("a:b", "shape")}}, "must be a dictionary from names"),
    ({"sensors": {"": SensorConfig("a:b", "shape")}}, "sensors = '': must be a word of 1 to 64"),
    ({"sensors": {"a b": SensorConfig("a:b", "shape")}}, "must be a word"),
    ({"sensors": {"../x": SensorConfig("a:b", "shape")}}, "must be a word"),
    ({"sensors": {"x" * 65: SensorConfig("a:b", "shape")}}, "must be a word of 1 to 64"),
    ({"sensors": {"x": SensorConfig("a:b", "shape")}, "modalities": ("x",) * 9}, "1 to 8"),
    ({"sensors": {"x": "a:b"}}, "values of type SensorConfig"),
    ({"arena.classes": ()}, "must name a class"),
    ({"arena.classes": "red cube"}, "must be a tuple of texts"),
    ({"arena.classes": ("red  cube",)}, "'red  cube' must be"),
    ({"arena.classes": ("red cube", "red cube")}, "must name no class twice"),
    ({"arena.classes": ("röd cube",)}, "'röd cube' must be"),
    ({"arena.colours": TWINS, "arena.classes": ("red cube", "crimson cube")}, "no sensor can tell"),
    ({"arena.shapes": TURNED, "arena.classes": ("red slab", "red board")}, "no sensor can tell"),
    ({"arena.colours": {}}, "must name one or more"),
    ({"arena.colours": {"red": (1.0, 0.0)}}, "tuples of 3 finite numbers"),
    ({"arena.colours": {"red": (NAN, 0.0, 0.0)}}, "tuples of 3 finite numbers"),
    ({"arena.colours": {"red": (1.1, 0.0, 0.0)}}, "each within 0 and 1"),
    ({"arena.colours": {"red": "red"}}, "tuples of 3 finite numbers"),
    ({"arena.num_pois": 10**9}, "arena.num_pois = 1000000000: must be at most 64"),
    ({"arena.side": 1e6}, "arena.side = 1000000.0: must be at most 100"),
    (
        {"camera.field_of_view": 30.0},
        "viewpoint.max_bearing = 20.0: must be at most half of cam",
    ),
    ({"lidar.field_of_view": 1.0}, "viewpoint.max_bearing = 20.0: must be at most half of lidar"),
    ({"lidar.stride": 10**8, "lidar.window": 1}, "lidar.stride = 100000000: must be at most 683"),
    ({"camera.pixel_noise": 2.0}, "camera.pixel_noise = 2.0: must be at most 1"),
    ({"detector.hidden": ()}, "one or more layer sizes"),
    ({"detector.hidden": (1.5,)}, "must be a tuple of whole numbers"),
    ({"detector.hidden": (10**7, 10**7)}, "detector.hidden = (10000000, 10000000): takes 372,"),
    ({"jmvae.hidden": (2**63,)}, "jmvae.hidden = "),
    ({"dqn.hidden": (4096,) * 400}, "dqn.hidden = (4096, 4096"),
    ({"detector.num_scans": 2**31 - 1}, "detector.num_scans = 2147483647: takes"),
    ({"detector.num_held_out": 2**31 - 1}, "detector.num_held_out = 2147483647: takes"),
    ({"detector.batch": 10**9}, "detector.batch = 1000000000: takes"),
    ({"detector.learning_rate": 1.1}, "detector.learning_rate = 1.1: must be at most 1"),
    ({"jmvae.latent_size": 10**9}, "jmvae.latent_size = 1000000000: must be at most 256"),
    ({"jmvae.restarts": 10**6}, "jmvae.restarts = 1000000: must be at most 1,000"),
    ({"jmvae.samples_per_class": 10**9}, "jmvae.samples_per_class = 1000000000: takes"),
    ({"jmvae.steps": 10**9}, "jmvae.steps = 1000000000: takes"),
    ({"jmvae.batch": 10**9}, "jmvae.batch = 1000000000: takes"),
    ({"jmvae.reconstruction_weights": ()}, "must hold one weight for each of modalities"),
    ({"jmvae.reconstruction_weights": (1.0,) * 9}, "must hold one weight for each of modalities"),
    ({"jmvae.reconstruction_weights": (NAN, 1.0)}, "must be a tuple of finite numbers"),
    ({"jmvae.reconstruction_weights": (-1.0, 1.0)}, "must be numbers within 0 and 1,000,000"),
    ({"jmvae.annealing": 1.1}, "jmvae.annealing = 1.1: must be within 0 and 1"),
    ({"mdp.unseen_variance": 1e7}, "mdp.unseen_variance = 10000000.0: must be at most"),
    ({"mdp.max_steps": 10**6}, "mdp.max_steps = 1000000: must be at most"),
    ({"mdp.partly_seen_starts": 1}, "mdp.partly_seen_starts = 1: must be True or False"),
    ({"dqn.observe": "Live"}, "dqn.observe = 'Live': must be one of live, bank"),
    ({"dqn.observe": ("live",)}, "must be one of live, bank"),
    ({"dqn.replay_capacity": 32 * 10**8}, "dqn.replay_capacity = 3200000000: must be below 2^31"),
    ({"dqn.replay_capacity": 32 * 10**7}, "dqn.replay_capacity = 320000000: takes"),
    ({"dqn.num_starts": 32 * 5 * 10**7}, "dqn.num_starts = 1600000000: takes"),
    ({"dqn.updates": 10**8}, "dqn.updates = 100000000: takes"),
    ({"dqn.discount": 1.5}, "dqn.discount = 1.5: must be within 0 and 1"),
    ({"dqn.epsilon_start": 0.5, "dqn.epsilon_min": 0.6}, "must be at most epsilon_start = 0.5"),
    ({"evaluation.num_repeats": 10**8}, "evaluation.num_repeats = 100000000: takes"),
    ({"evaluation.num_starts": 2**31 - 1}, "evaluation.num_starts = 2147483647: takes"),
    ({"navigation.horizon": 61.0}, "navigation.horizon = 61.0: must be at most 60"),
    ({"navigation.view_distances": ()}, "must be 1 to 20 distances"),
    ({"navigation.view_distances": (0.6,) * 21}, "must be 1 to 20 distances"),
    ({"navigation.view_distances": (0.0, 0.6)}, "must be 1 to 20 distances"),
    ({"navigation.view_distances": (0.6, NAN)}, "must be a tuple of finite numbers"),
    ({"navigation.turn_samples": 4}, "must be odd"),
    ({"navigation.view_sides": 10**9}, "must be at most 360"),
    ({"mission.episodes": 10**9}, "mission.episodes = 1000000000: must be at most 100,000"),
    ({"mission.time_limit": 1e9}, "mission.time_limit = 1000000000.0: must be at most 3,600"),
    ({"mission.control_period": 0.033}, "must be a multiple of 0.01 s"),
]


def changed(changes: dict, base: Config = SMOKE) -> Config:
    """The settings with some changed, by `section.name`."""
    parts: dict = {}
    for name, value in changes.items():
        section, _, field = name.partition(".")
        if field:
            parts.setdefault(section, {})[field] = value
        else:
            parts[section] = value
    made = {
        name: dataclasses.replace(getattr(base, name), **part)
        if name in SECTIONS and isinstance(part, dict)
        else part
        for name, part in parts.items()
    }
    return dataclasses.replace(base, **made)


@pytest.mark.parametrize(("changes", "expected"), CHANGES, ids=count())
def test_settings_that_cannot_be_used_are_named(changes, expected):
    with pytest.raises(ConfigError) as error:
        changed(changes)
    check_message(str(error.value))
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Shape("box", (0.5,)), "shape.half_sides = (0.5,): must be a tuple of 2 finite"),  # pyright: ignore
        (lambda: Shape("box", (0.1, 0.5)), "must be two shares"),
        (lambda: Shape("Box"), "shape.primitive = 'Box': must be one of cylinder, box"),  # pyright: ignore
        (lambda: Attribute({"hot": "x"}), "attribute.values = {'hot': 'x'}: must be a dictionary"),  # pyright: ignore
        (lambda: Attribute({}), "must name one or more"),
        (lambda: Attribute({"hot": 1.0}, NAN), "attribute.elsewhere = nan: must be a finite"),
        (lambda: SensorConfig("a.b", "shape"), "must be package.module:function"),
        (lambda: SensorConfig(":", "shape"), "must be package.module:function"),
        (lambda: SensorConfig(3, "shape"), "sensor.make = 3: must be text"),  # pyright: ignore
        (lambda: ArenaConfig(num_pois=np.int64(3)), "arena.num_pois = np.int64(3): must be a whol"),  # pyright: ignore
        (lambda: Config(5), "modalities = 5: must be a tuple of texts"),  # pyright: ignore
    ],
)  # fmt: skip
def test_parts_that_cannot_be_used_are_named(make, expected):
    with pytest.raises(ConfigError) as error:
        make()
    check_message(str(error.value))
    assert expected in str(error.value)


def test_a_whole_number_becomes_real_where_one_is_declared():
    assert isinstance(ArenaConfig(side=3).side, float)


# Commands -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The directory of a run that trained nothing, without a summary."""
    path = tmp_path_factory.mktemp("runs") / "run"
    models = jaxsense.untrained(jax.random.key(0), SMOKE)
    with RunDirectory.create(path, Settings("smoke", 0, SMOKE)) as created:
        created.save_models(models)
    return path


def contents(path):
    """Every file below a directory, with what is in it."""
    return {p: p.read_bytes() if p.is_file() else None for p in path.rglob("*")}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The working directory, with things in it that are not to be touched."""
    (tmp_path / "file").write_text("precious")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept").write_text("precious")
    texts = {
        "utf16": '{"seed": 1}'.encode("utf-16"),
        "binary": bytes(range(256)),
        "deep": b"[" * 100_000,
        "deep_object": b'{"config":' * 100_000,
        "twice": b'{"seed": 1, "seed": 2}',
        "digits": b'{"seed": 1' + b"0" * 10_000 + b"}",
        "empty": b"",
        "null": b"null",
        "list": b"[]",
        "nan": b'{"config": {"jmvae": {"beta": NaN}}}',
        "inf": b'{"config": {"jmvae": {"beta": 1e999}}}',
        "float": b'{"seed": 1.0}',
        "bool": b'{"seed": true}',
        "negative": b'{"seed": -1}',
        "large": b'{"seed": 4294967296}',
        "seeds": b'{"num_seeds": 0}',
        "preset": b'{"preset": ["smoke"]}',
        "section": b'{"config": {"dqn": [1]}}',
        "sections": b'{"config": [1]}',
        "field": b'{"config": {"dqn": {"epoch": 3}}}',
        "unknown": b'{"colour": 3}',
        "text": b'{"config": {"dqn": {"epochs": "3"}}}',
        "whole": b'{"config": {"dqn": {"epochs": 60.0}}}',
        "sensor": b'{"config": {"sensors": {"x": {"make": "a:b"}}}}',
        "shape": b'{"config": {"arena": {"shapes": {"cube": {"half_sides": [1, 1, 1]}}}}}',
        "memory": b'{"config": {"detector": {"hidden": [10000000, 10000000]}}}',
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.json").write_bytes(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(main, argv, place, capsys) -> str:
    """What a command says that refuses its options: status 2, one line, and nothing changed."""
    before, begin = contents(place), time.perf_counter()
    with pytest.raises(SystemExit) as stop:
        main(argv)
    assert time.perf_counter() - begin < SECONDS
    assert stop.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert "Traceback" not in told.err
    assert contents(place) == before
    check_message(told.err.strip())
    return told.err


TRAIN = [
    (["--seed", "1.5"], "seed = '1.5': must be a whole number"),
    (["--seed", ""], "seed = '': must be a whole number"),
    (["--seed"], "seed = '': must have a value"),
    (["--seed", "nan"], "seed = 'nan': must be a whole number"),
    (["--seed", "-1"], "seed = -1: must be within 0 and 2^32 - 1"),
    (["--seed", "4294967296"], "seed = 4294967296: must be within"),
    (["--seed", "9" * 5000], "seed = '999"),
    (["--cache", 300 * "x"], "cache = 'xxx"),
    (["--num-seeds", "1000000000"], "num_seeds = 1000000000: must be within 1 and 10,000"),
    (["--num-seeds", "0"], "num_seeds = 0: must be within 1 and 10,000"),
    (["--num-seeds", "2", "--seed", "4294967295"], "leads beyond seed"),
    (["--devices", "0"], "devices = 0: must be within 1 and"),
    (["--devices", "-1"], "devices = -1: must be within 1 and"),
    (["--devices", "1000000000"], "devices = 1000000000: must be within 1 and"),
    (["--devices", "1e9"], "devices = '1e9': must be a whole number or None"),
    (["--preset", ""], "preset = '': must be one of default, paper, smoke"),
    (["--preset", "Smoke"], "preset = 'Smoke': must be one of"),
    (["--preset"], "preset = '': must have a value"),
    (["--out", ""], "out = '': must be a path"),
    (["--out", "a\nb"], "out = 'a\\nb': must be a path of printable characters"),
    (["--out", "a\0b"], "out = 'a\\x00b': must be a path of printable characters"),
    (["--out", "\udc80"], "must be a path of printable characters"),
    (["--out", "file"], "out = 'file': cannot be written"),
    (["--out", "file/run"], "out = 'file/run': cannot be written"),
    (["--out", "full"], "out = 'full': is not empty; must be a new directory"),
    (["--out", "x" * 300], "cannot be written (File name too long)"),
    (["--out", "/proc/run"], "out = '/proc/run': cannot be written"),
    (["--cache", "file"], "cache = 'file': must be a directory"),
    (["--cache", ""], "cache = '': must be a path"),
    (["--config", ""], "config = '': must be a path"),
    (["--config", "full"], "config = 'full': must hold a run's settings"),
    (["--config", "none"], "config = 'none': must hold a run's settings (none: No such file"),
    (["--config", "binary.json"], "binary.json is no JSON"),
    (["--config", "utf16.json"], "utf16.json is no JSON"),
    (["--config", "deep.json"], "deep.json is no JSON: nested too deeply"),
    (["--config", "deep_object.json"], "deep_object.json is no JSON: nested too deeply"),
    (["--config", "twice.json"], "twice.json is no JSON: 'seed' is given twice"),
    (["--config", "digits.json"], "digits.json is no JSON"),
    (["--config", "empty.json"], "empty.json is no JSON"),
    (["--config", "null.json"], "null.json must hold an object"),
    (["--config", "list.json"], "list.json must hold an object"),
    (["--config", "nan.json"], "jmvae.beta = nan: must be a finite number"),
    (["--config", "inf.json"], "jmvae.beta = inf: must be a finite number"),
    (["--config", "float.json"], "seed = 1.0: must be a whole number"),
    (["--config", "bool.json"], "seed = True: must be a whole number"),
    (["--config", "negative.json"], "seed = -1: must be within 0 and 2^32 - 1"),
    (["--config", "large.json"], "seed = 4294967296: must be within 0 and 2^32 - 1"),
    (["--config", "seeds.json"], "num_seeds = 0: must be within 1 and 10,000"),
    (["--config", "preset.json"], "preset = ['smoke']: must be one of"),
    (["--config", "section.json"], "dqn = (1,): must be of type DqnConfig"),
    (["--config", "sections.json"], "config = [1]: must be an object with a section"),
    (["--config", "field.json"], "epoch = 3: is no setting; perhaps dqn.epochs"),
    (["--config", "unknown.json"], "colour = 3: is no field of a run's config.json"),
    (["--config", "text.json"], "dqn.epochs = '3': must be a whole number"),
    (["--config", "whole.json"], "dqn.epochs = 60.0: must be a whole number"),
    (["--config", "sensor.json"], "sensors.attribute = None: must be given"),
    (["--config", "shape.json"], "must be"),
    (["--config", "memory.json"], "detector.hidden = (10000000, 10000000): takes"),
    (["--config", "twice.json", "--preset", "smoke"], "is no JSON"),
    (["--resume", ""], "resume = '': must be a path"),
    (["--resume", "file"], "resume = 'file': must hold a run's settings"),
    (["--resume", "full"], "resume = 'full': must hold a run's settings"),
    (["--resume", "none"], "resume = 'none': must hold a run's settings"),
    (["--dqn.epochs", "1e3"], "dqn.epochs = '1e3': must be a whole number"),
    (["--dqn.epochs", "déux"], "dqn.epochs = 'déux': must be a whole number"),
    (["--dqn.hidden"], "dqn.hidden = (): must be one or more layer sizes"),
    (["--dqn.hidden", "a"], "dqn.hidden = ('a',): must be a tuple of whole numbers"),
    (["--dqn.observe", "LIVE"], "dqn.observe = 'LIVE': must be one of live, bank"),
    (["--arena.side", "3m"], "arena.side = '3m': must be a finite number"),
    (["--arena.side", "1_000_000"], "arena.side = 1000000.0: must be at most 100"),
    (["--arena.colours.red", "1"], "arena.colours = "),
    (["--arena.colours.red", "1", "2", "x"], "arena.colours = "),
    (["--arena.shapes.cube.half-sides", "1"], "must have as many values as each option takes"),
    (["--mdp.partly-seen-starts", "maybe"], "option = 'maybe': must be one of the program"),
    (["--quiet=3"], "option = '3': must be one of the program"),
    (["--taste", "sweet"], "option = '--taste': must be one of the program"),
    (["--dqn.epoch", "3"], "option = '--dqn.epoch': must be one of the program; perhaps --dqn.epo"),
    (["smoke"], "option = 'smoke': must be one of the program"),
    (["--jmvae.hidden", "10000000", "10000000"], "jmvae.hidden = (10000000, 10000000): takes"),
]


@pytest.mark.parametrize(("argv", "expected"), TRAIN, ids=count())
def test_train_refuses(argv, expected, place, capsys):
    base = [] if {"--config", "--resume", "--preset"} & set(argv) else ["--preset", "smoke"]
    out = [] if {"--out", "--resume"} & set(argv) else ["--out", "run"]
    assert expected in refusal(train.main, [*base, *out, *argv], place, capsys)


@pytest.mark.parametrize(("section", "name"), NUMBERS[::5])
@pytest.mark.parametrize("text", ["nan", "-1", "x"])
def test_train_refuses_numbers(section, name, text, place, capsys):
    option = f"--{section}.{name.replace('_', '-')}"
    line = refusal(train.main, ["--preset", "smoke", "--out", "run", option, text], place, capsys)
    assert line.startswith(f"jaxsense.train: {section}.{name} = ")


@settings(max_examples=12, deadline=None, derandomize=True, database=None)
@given(st.lists(st.one_of(st.sampled_from(["--seed", "--out", "--dqn.epochs", "--config", "--"]),
                          st.text(max_size=4)), min_size=1, max_size=4))  # fmt: skip
def test_train_reads_or_refuses_any_words(argv):
    with contextlib.suppress(SystemExit):
        train.parse(argv)


OTHERS = [
    (evaluate, [], "run = '': must be given"),
    (evaluate, [""], "run = '': must be a path"),
    (evaluate, ["none"], "run = 'none': must hold a run's settings"),
    (evaluate, ["file"], "run = 'file': must hold a run's settings"),
    (evaluate, ["full"], "run = 'full': must hold a run's settings"),
    (evaluate, ["none", "more"], "option = 'more': must be one of the program"),
    (evaluate, ["RUN"], "must hold the summary.json of a finished run"),
    (evaluate, ["RUN", "--episodes", "0"], "episodes = 0: must be within 1 and 100,000"),
    (evaluate, ["RUN", "--episodes", "-1"], "episodes = -1: must be within"),
    (evaluate, ["RUN", "--episodes", "1e9"], "episodes = '1e9': must be a whole number"),
    (evaluate, ["RUN", "--episodes", "1000000000"], "episodes = 1000000000: must be within"),
    (evaluate, ["RUN", "--seed", "-1"], "seed = -1: must be within 0 and 2^32 - 1"),
    (evaluate, ["RUN", "--seed", "x"], "seed = 'x': must be a whole number"),
    (evaluate, ["RUN", "--policy", ""], "policy = '': must be one of all, policies, latent"),
    (evaluate, ["RUN", "--policy", "sonar_alone"], "policy = 'sonar_alone': must be one of"),
    (evaluate, ["RUN", "--policy"], "policy = '': must have a value"),
    (evaluate, ["RUN", "--devices", "0"], "devices = 0: must be within 1 and"),
    (evaluate, ["RUN", "--cache", "file"], "cache = 'file': must be a directory"),
    (export, [], "run = '': must be given"),
    (export, ["none"], "run = 'none': must hold a run's settings"),
    (export, ["a\nb"], "run = 'a\\nb': must be a path of printable characters"),
    (export, ["RUN", "--out", "full"], "out = 'full': exists already; must be a new file"),
    (export, ["RUN", "--out", "file"], "out = 'file': exists already; must be a new file"),
    (export, ["RUN", "--out", "file/x"], "out = 'file/x': cannot be written"),
    (export, ["RUN", "--out", ""], "out = '': must be a path"),
    (export, ["RUN", "--out"], "out = '': must have a value"),
    (benchmarks, ["x"], "name = 'x': must be one of physics"),
    (benchmarks, [""], "name = '': must be one of physics"),
    (benchmarks, ["--json", ""], "json = '': must be a path"),
    (benchmarks, ["--json", "file"], "json = 'file': exists already; must be new"),
    (benchmarks, ["--json", "full"], "json = 'full': exists already; must be new"),
    (benchmarks, ["--json", "none/x"], "json = 'none/x': cannot be written"),
    (benchmarks, ["--json"], "json = '': must have a value"),
    (benchmarks, ["--peer"], "option = '--peer': must be one of the program; perhaps --peers"),
]


@pytest.mark.parametrize(("program", "argv", "expected"), OTHERS, ids=count())
def test_other_commands_refuse(program, argv, expected, run, place, capsys):
    argv = [str(run) if word == "RUN" else word for word in argv]
    before = contents(run)
    assert expected in refusal(program.main, argv, place, capsys)
    assert contents(run) == before


PARTS = {part: {} for part in ("timing", "detectors", "jmvae", "dqn", "mission")}
SUMMARIES = [
    (b"{}", "must be an object with detectors"),
    (b"[]", "must be an object with detectors"),
    (b"\xff", "must hold the summary.json of a finished run"),
    (b"[" * 100_000, "nested too deeply"),
    (json.dumps(PARTS).encode(), "must hold the summary.json of a finished run"),
    (json.dumps({**PARTS, "dqn": 3}).encode(), "must hold the summary.json of a finished run"),
    (json.dumps({**PARTS, "jmvae": {"unambiguous": []}}).encode(), "must hold the summary.json"),
]


@pytest.mark.parametrize(("summary", "expected"), SUMMARIES, ids=count())
def test_evaluate_refuses_a_broken_summary(summary, expected, run, capsys):
    (run / "summary.json").write_bytes(summary)
    try:
        assert expected in refusal(evaluate.main, [str(run)], run, capsys)
    finally:
        (run / "summary.json").unlink()


@pytest.mark.parametrize(
    ("module", "argv"),
    [
        ("jaxsense.train", ["--dqn.epochs", "x"]),
        ("jaxsense.evaluate", ["--seed", "x"]),
        ("benchmarks", ["--json"]),
    ],
)
def test_a_process_ends_with_one_line(module, argv, tmp_path):
    begin = time.perf_counter()
    command = [sys.executable, "-m", module, *argv]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert time.perf_counter() - begin < 3 * SECONDS  # another process may have most of the cores
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    check_message(line)
    assert line.startswith(f"{module}: ")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (StageError("jmvae: the loss of step 3 is not finite"), "jmvae: the loss of step 3 is not"),
        (WriteError(28, "No space left on device", "x"), "cannot write x: No space left on device"),
        (PermissionError(13, "Permission denied", "x"), "train: x: Permission denied; what was"),
        (OSError("Orbax, in\ntwo lines"), "train: Orbax, in two lines; what was saved"),
        (ConfigError("checkpoint", "x", "is damaged"), "train: checkpoint = 'x': is damaged\n"),
    ],
)
def test_what_ends_a_run_is_told_without_advice(error, expected, tmp_path, capsys, monkeypatch):
    def fails(*_):
        raise error

    monkeypatch.setattr(pipeline, "compiled", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(pipeline, "run", fails)
    argv = ["--preset", "smoke", "--quiet", "--cache", "None", "--out", str(tmp_path / "run")]
    with pytest.raises(SystemExit) as stop:
        train.main(argv)
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert expected in line
    assert "--help" not in line


def test_text_is_read_and_written_as_utf_8():
    """What a file holds must not depend on the locale."""
    for file in sorted(Path(jaxsense.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            if node.func.attr in ("read_text", "write_text", "open"):
                named = {keyword.arg for keyword in node.keywords}
                is_binary = any("b" in str(getattr(arg, "value", "")) for arg in node.args)
                assert "encoding" in named or is_binary, f"{file}:{node.lineno}"


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.dictionaries(st.sampled_from(["preset", "seed", "config", "x"]), ANYTHING))
def test_any_config_file_is_read_or_refused(tmp_path_factory, content):
    file = tmp_path_factory.getbasetemp() / "any.json"
    file.write_text(json.dumps(content))
    try:
        assert isinstance(read_settings(file), Settings)
    except ConfigError as error:
        check_message(str(error))


# Public functions ---------------------------------------------------------------------------------


class World:
    """What the functions are called with, made once."""

    def __init__(self):
        self.key = jax.random.key(0)
        self.models = jaxsense.untrained(self.key, SMOKE)
        self.params, self.model = self.models.jmvae, jaxsense.jmvae_shape(SMOKE)
        self.world = sim.make_world(SMOKE)
        self.camera, self.lidar = self.world.sensors
        self.classes = jnp.array([0, 1, 2])
        layout = sim.random_layout(self.key, SMOKE.arena, self.classes)
        light = sim.random_light(self.key)
        self.scene = sim.Scene(layout, light, jnp.zeros((2, 3)))
        self.bank = tuple(jnp.full((3, 4, 2), 0.5) for _ in range(2))
        self.mdp = jaxsense.bank_mdp(SMOKE, self.bank, self.params, self.model)
        beliefs = Belief(jnp.zeros((3, 2)), jnp.ones((3, 2)))
        seen = jnp.zeros((3, 2), bool)
        self.state = dqn.MapState(beliefs, seen, self.classes, self.classes, jnp.int32(0))
        self.belief, self.means = Belief(jnp.zeros(2), jnp.ones(2)), jnp.zeros((3, 2))
        self.seen, self.x = jnp.zeros(2, bool), jnp.zeros(2)

    def belief_of(self, **parts):
        return dataclasses.replace(self.belief, **parts)


@pytest.fixture(scope="module")
def given_world():
    return World()


BAD = jnp.array([0, 1, 7])
FUNCTIONS = {
    "load": (lambda w: jaxsense.load(""), "run = '.': must hold"),
    "load nul": (lambda w: jaxsense.load("\0"), "run = "),
    "bank_mdp few": (
        lambda w: jaxsense.bank_mdp(SMOKE, w.bank[:1], w.params, w.model),
        "bank has 1 entries: must be 2",
    ),
    "bank_mdp rank": (
        lambda w: jaxsense.bank_mdp(SMOKE, (w.bank[0][0],) * 2, w.params, w.model),
        "bank",
    ),
    "bank_mdp empty": (
        lambda w: jaxsense.bank_mdp(SMOKE, (w.bank[0][:, :0],) * 2, w.params, w.model),
        "bank = 0: must be",
    ),
    "bank_mdp nan": (
        lambda w: jaxsense.bank_mdp(SMOKE, (w.bank[0] * NAN,) * 2, w.params, w.model),
        "bank = nan: must be finite",
    ),
    "live_mdp few": (
        lambda w: jaxsense.live_mdp(SMOKE, w.world, w.models.detectors[:1], w.params, w.model),
        "trained has 1 entries",
    ),
    "make_layout classes": (
        lambda w: sim.make_layout(SMOKE.arena, jnp.zeros((3, 2)), jnp.zeros(3), BAD),
        "classes = 7: must be a whole number from 0 to 2",
    ),
    "make_layout dtype": (
        lambda w: sim.make_layout(SMOKE.arena, jnp.zeros((3, 2)), jnp.zeros(3), BAD * 1.0),
        "classes of dtype float32: must be a whole number",
    ),
    "make_layout position": (
        lambda w: sim.make_layout(SMOKE.arena, jnp.full((3, 2), NAN), jnp.zeros(3), w.classes),
        "position = nan",
    ),
    "make_layout yaw": (
        lambda w: sim.make_layout(SMOKE.arena, jnp.zeros((3, 2)), jnp.full(3, INF), w.classes),
        "yaw = inf",
    ),
    "random_layout": (
        lambda w: sim.random_layout(w.key, SMOKE.arena, w.classes - 1),
        "classes = -1",
    ),
    "random_scene": (lambda w: sim.random_scene(w.key, w.world, BAD), "classes = 7"),
    "survey": (lambda w: sim.survey(w.key, w.world, BAD), "classes = 7"),
    "look robot": (
        lambda w: sim.look(w.key, w.world, w.scene, 2, jnp.int32(0)),
        "robot = 2: must be one of",
    ),
    "look poi": (
        lambda w: sim.look(w.key, w.world, w.scene, 0, jnp.int32(3)),
        "poi = 3: must be a whole number from 0 to 2",
    ),
    "place": (lambda w: sim.place(w.world.arena, w.scene.layout, jnp.zeros(3)), "poses"),
    "drive": (
        lambda w: sim.drive(w.world.arena, w.world.arena.data, jnp.zeros((3, 2))),
        "wheel_speeds",
    ),
    "cross_section robot": (
        lambda w: sim.cross_section(w.world.arena, w.world.arena.data, 0.1, 5),
        "robot = 5",
    ),
    "cross_section height": (
        lambda w: sim.cross_section(w.world.arena, w.world.arena.data, NAN, 0),
        "height = nan",
    ),
    "cast": (
        lambda w: sim.cast(
            sim.cross_section(w.world.arena, w.world.arena.data, 0.1, 0), w.x * NAN, w.x
        ),
        "origin = nan: must be finite",
    ),
    "cast_along": (
        lambda w: sim.cast_along(
            sim.cross_section(w.world.arena, w.world.arena.data, 0.1, 0), w.x, (w.x, w.x * NAN)
        ),
        "direction = nan: must be finite",
    ),
    "fan": (lambda w: sim.fan(0, 90.0), "num_rays = 0: must be a whole number greater than 0"),
    "fan real": (lambda w: sim.fan(1.5, 90.0), "num_rays = 1.5"),
    "fan bool": (lambda w: sim.fan(True, 90.0), "num_rays = True"),
    "fan angle": (lambda w: sim.fan(3, 400.0), "field_of_view = 400.0: must be above 0"),
    "fan nan": (lambda w: sim.fan(3, NAN), "field_of_view = nan"),
    "fan negative": (lambda w: sim.fan(3, -90.0), "field_of_view = -90.0"),
    "cut_out nan": (lambda w: sim.cut_out(w.lidar, np.full(683, NAN), 0.0), "readings of lidar ="),
    "cut_out negative": (lambda w: sim.cut_out(w.lidar, np.full(683, -1.0), 0.0), "= -1.0: must"),
    "cut_out length": (lambda w: sim.cut_out(w.lidar, np.zeros(5), 0.0), "readings of lidar"),
    "cut_out dtype": (
        lambda w: sim.cut_out(w.camera, np.full((640, 3), 255, np.uint8), 0.0),
        "readings of dtype uint8: must be real numbers",
    ),
    "cut_out degrees": (lambda w: sim.cut_out(w.lidar, np.zeros(683), 90.0), "bearing = 90.0"),
    "cut_out bearing": (lambda w: sim.cut_out(w.lidar, np.zeros(683), NAN), "bearing = nan"),
    "bearing pose": (lambda w: sim.bearing(w.x, w.x), "pose"),
    "bearing place": (lambda w: sim.bearing(jnp.zeros(3), jnp.zeros(3)), "place"),
    "Sensor stride": (lambda w: dataclasses.replace(w.lidar, stride=0), "stride = 0"),
    "Sensor window": (lambda w: dataclasses.replace(w.lidar, window=1.5), "window = 1.5"),
    "Sensor channels": (lambda w: dataclasses.replace(w.lidar, channels=-1), "channels = -1"),
    "Sensor height": (lambda w: dataclasses.replace(w.lidar, height=NAN), "height = nan"),
    "Jmvae names": (lambda w: vae.Jmvae((), (), 2, (8,)), "modalities = ()"),
    "Jmvae twice": (lambda w: vae.Jmvae(("a", "a"), (2, 2), 2, (8,)), "must name none twice"),
    "Jmvae sizes": (lambda w: vae.Jmvae(("a",), (0,), 2, (8,)), "feature_sizes = 0"),
    "Jmvae latent": (lambda w: vae.Jmvae(("a",), (2,), 0.5, (8,)), "latent_size = 0.5"),
    "Jmvae hidden": (lambda w: vae.Jmvae(("a",), (2,), 2, (-8,)), "hidden = -8"),
    "encode none": (lambda w: vae.encode(w.params, w.model, (None, None)), "must hold one mod"),
    "encode shape": (
        lambda w: vae.encode(w.params, w.model, (jnp.zeros(3), None)),
        "features of camera",
    ),
    "decode": (lambda w: vae.decode(w.params, w.model, jnp.zeros(3)), "z"),
    "posterior": (lambda w: vae.posterior(w.params, w.model, (w.x,)), "features has 1 entries"),
    "detect": (lambda w: vae.detect(w.models.detectors[0], jnp.zeros(3)), "window"),
    "fuse std": (
        lambda w: vae.fuse(w.params, w.model, w.belief_of(std=-w.belief.std), w.seen, (w.x, None)),
        "belief.std = -1.0: must be greater than 0",
    ),
    "fuse seen": (
        lambda w: vae.fuse(w.params, w.model, w.belief, jnp.zeros(3, bool), (w.x, None)),
        "seen",
    ),
    "write": (
        lambda w: vae.write(w.params, w.model, w.belief, w.seen, w.x, 2),
        "modality = 2: must be an index",
    ),
    "unseen": (lambda w: vae.unseen(w.model, -1.0), "variance = -1.0: must be greater than 0"),
    "unseen nan": (lambda w: vae.unseen(w.model, NAN), "variance = nan"),
    "unseen text": (lambda w: vae.unseen(w.model, "x"), "variance = 'x'"),
    "kl": (lambda w: vae.kl_divergence(w.x[None], w.x, w.x, w.x), "mean_p"),
    "moment_match": (lambda w: vae.moment_match(w.means, w.means - 1), "std = -1.0"),
    "moment_match none": (
        lambda w: vae.moment_match(w.means[:0], w.means[:0]),
        "number of components = 0",
    ),
    "sigma_norm": (lambda w: vae.sigma_norm(-w.belief.std), "std = -1.0: must be greater than 0"),
    "nearest_class": (
        lambda w: vae.nearest_class(w.belief_of(mean=w.x * NAN), w.means),
        "belief.mean = nan: must be finite",
    ),
    "nearest_class means": (
        lambda w: vae.nearest_class(w.belief, w.means * NAN),
        "class_means = nan",
    ),
    "plausible_classes": (
        lambda w: vae.plausible_classes(w.belief_of(std=w.x), w.means),
        "belief.std = 0.0: must be greater than 0",
    ),
    "loss": (
        lambda w: vae.loss(
            w.key, w.params, w.model, (w.x,), alpha=1, beta=1, reconstruction_weights=(1, 1)
        ),
        "features has 1 entries",
    ),
    "loss weights": (
        lambda w: vae.loss(
            w.key, w.params, w.model, (w.x, w.x), alpha=1, beta=1, reconstruction_weights=(1,)
        ),
        "reconstruction_weights = (1,)",
    ),
    "train steps": (
        lambda w: vae.train(w.key, None, w.model, w.bank, SMOKE.jmvae, 0),
        "steps = 0",
    ),
    "train bank": (
        lambda w: vae.train(w.key, None, w.model, w.bank[:1], SMOKE.jmvae, 1),
        "bank has 1 entries",
    ),
    "information": (lambda w: dqn.information(-w.belief.std), "std = -1.0: must be greater"),
    "information zero": (lambda w: dqn.information(w.x), "std = 0.0: must be greater than 0"),
    "information nan": (lambda w: dqn.information(w.x * NAN), "std = nan"),
    "information rank": (lambda w: dqn.information(jnp.float32(1)), "std"),
    "as_state rank": (lambda w: dqn.as_state(w.belief), "belief.mean"),
    "as_state std": (lambda w: dqn.as_state(Belief(w.means, w.means)), "belief.std = 0.0"),
    "reset classes": (lambda w: dqn.reset(w.key, w.mdp, BAD), "classes = 7"),
    "reset number": (lambda w: dqn.reset(w.key, w.mdp, w.classes[:2]), "classes"),
    "reset seen": (
        lambda w: dqn.reset(w.key, w.mdp, w.classes, jnp.zeros((2, 3), bool)),
        "seen",
    ),
    "reset seen dtype": (lambda w: dqn.reset(w.key, w.mdp, w.classes, jnp.zeros((3, 2))), "seen"),
    "step action": (
        lambda w: dqn.step(w.key, w.mdp, w.state, jnp.int32(4), 0),
        "action = 4: must be a whole number from 0 to 3",
    ),
    "step negative": (lambda w: dqn.step(w.key, w.mdp, w.state, jnp.int32(-1), 0), "action = -1"),
    "step dtype": (
        lambda w: dqn.step(w.key, w.mdp, w.state, jnp.float32(1), 0),
        "action of dtype float32",
    ),
    "step rank": (lambda w: dqn.step(w.key, w.mdp, w.state, jnp.zeros(2, int), 0), "action"),
    "step modality": (
        lambda w: dqn.step(w.key, w.mdp, w.state, jnp.int32(0), 2),
        "modality = 2: must be a whole number from 0 to 1",
    ),
    "naive": (lambda w: dqn.naive(w.mdp, -1), "modality = -1"),
    "optimal": (
        lambda w: dqn.optimal(w.mdp, jnp.full((4, 3), NAN), jnp.zeros((2, 3), int)),
        "rewards = nan",
    ),
    "optimal shape": (
        lambda w: dqn.optimal(w.mdp, jnp.zeros((4, 3)), jnp.zeros((3, 3), int)),
        "label_of_class",
    ),
    "dqn.train": (
        lambda w: jax.eval_shape(lambda: dqn.train(w.key, w.mdp, 5, SMOKE.dqn)),
        "modality = 5",
    ),
    "mission.batch_of": (lambda w: mission.batch_of(0), "total = 0"),
    "mission.rollout": (lambda w: mission.rollout(w.key, None, None, None, 0), "steps = 0"),
    "map_mdp": (lambda w: interfaces.map_mdp(SMOKE, w.models, w.bank[:1]), "bank has 1 entries"),
    "prepared_starts": (lambda w: interfaces.prepared_starts(w.key, w.mdp, 0), "number = 0"),
    "prepared_starts real": (lambda w: interfaces.prepared_starts(w.key, w.mdp, 1.5), "number ="),
    "detections": (lambda w: interfaces.detections(w.key, SMOKE, w.models, 0), "samples = 0"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_refuse(given_world, name):
    call, expected = FUNCTIONS[name]
    with pytest.raises((ValueError, AssertionError)) as error:
        call(given_world)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        ({"policy": 5}, "policy = 5: must be a whole number from 0 to 2"),
        ({"policy": -1}, "policy = -1"),
        ({"classes": BAD}, "classes = 7"),
        ({"faults": mission.Faults(jnp.full(2, NAN), jnp.zeros(2))}, "faults.stops_at = nan"),
        ({"faults": mission.Faults(jnp.zeros(2), -jnp.ones(2))}, "faults.blind_at = -1.0"),
    ],
)
def test_a_mission_refuses(given_world, inputs, expected):
    team = mission.Mission(given_world.world, given_world.world.arena)
    base = {"classes": given_world.classes, "policy": 0, "faults": mission.no_faults(SMOKE)}
    with pytest.raises(ValueError, match=re.escape(expected)):
        mission.start(team, given_world.scene, **{**base, **inputs})


def test_environments_refuse(given_world):
    from jaxsense.interfaces import gymnasium, gymnax

    mdp = given_world.mdp
    for number in (0, -1, 1.5, True, "2"):
        with pytest.raises(ValueError, match=r"num_envs = .*: must be a whole number greater"):
            gymnasium.MapVectorEnv(mdp, 0, number)
    for modality in (2, -1):
        with pytest.raises(ValueError, match=r"modality = .*: must be a whole number from 0 to 1"):
            gymnasium.MapVectorEnv(mdp, modality, 2)
        with pytest.raises(ValueError, match=r"modality = .*: must be a whole number from 0 to 1"):
            gymnax.MapEnv(mdp, modality)
    with pytest.raises(ValueError, match="Later"):
        gymnasium.MapVectorEnv(mdp, 0, 2, autoreset_mode="Later")
    env = gymnasium.MapVectorEnv(mdp, 0, 2)
    for mask in ([True], [1, 0], "x", np.ones(3, bool)):
        with pytest.raises(ValueError, match=r"reset_mask = .*: must be an array of 2 booleans"):
            env.reset(options={"reset_mask": mask})
    env._states = given_world.state  # as after a reset, which takes long to compile
    for actions in ([0, 4], [-1, 0], [0.5, 1.0], [0], [[0, 1]], "x"):
        with pytest.raises(ValueError, match=r"actions = .*: must be in"):
            env.step(actions)
    start = gymnax.MapEnvState(time=0, map=given_world.state, is_over=jnp.bool_(False))
    with pytest.raises(ValueError, match="action = 4: must be a whole number from 0 to 3"):
        gymnax.MapEnv(mdp, 0).step_env(given_world.key, start, 4, gymnax.MapEnvParams())

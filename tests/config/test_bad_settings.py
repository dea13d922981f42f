"""Invalid settings: one line that names the field, its value and what would be right."""

import dataclasses
import json
import math
import pickle
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import ANYTHING, FIELDS, NAN, NUMBERS, PARTS, SECTIONS, SMOKE, check_message
from smoke import error_line

from jaxsense import Attribute, Config, ConfigError, SensorConfig, Shape
from jaxsense.config import as_plain, from_plain
from jaxsense.config.mission import CommunicationConfig, LocalisationConfig
from jaxsense.config.scene import COLOURS, SHAPES, ArenaConfig
from jaxsense.config.section import Limits, described, fields_of


def message(change, *args, **kwargs) -> str:
    """What a change of settings that cannot be used says."""
    with pytest.raises(ConfigError) as error:
        change(*args, **kwargs)
    check_message(str(error.value))
    return str(error.value)


NO_NUMBERS = [NAN, 1e300, 1e-300, 2**63, 10**5000, "1", "", None, True, [], {}, (1,), b"1", int]


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_what_is_no_number_is_refused(section, name):
    for value in NO_NUMBERS:
        is_real = isinstance(getattr(PARTS[section], name), float)
        if not (value == 2**63 and is_real):
            told = message(dataclasses.replace, PARTS[section], **{name: value})
            assert told.startswith(f"{section}.{name} = ")


def outside(limits, default):
    """Values just outside of limits, in the form of a field's default."""
    whole = type(default) is int or (isinstance(default, tuple) and type(default[0]) is int)
    for limit, sign in ((limits.at_least, -1), (limits.at_most, 1)):
        if math.isfinite(limit):
            yield limit + sign * (1 if whole else 1e-6 * max(1.0, limit))
    yield from filter(math.isfinite, (limits.above, limits.below))


OF_FIELDS = {
    (place, name): (kind, limits)
    for place, part in {**PARTS, "": SMOKE, "shape": Shape("box")}.items()
    for name, kind, limits, _ in fields_of(type(part))
    if limits != Limits()
}


@pytest.mark.parametrize(("place", "name"), OF_FIELDS, ids="{}".format)
def test_a_value_just_outside_the_limits_is_refused(place, name):
    part = {**PARTS, "": SMOKE, "shape": Shape("box")}[place]
    (kind, limits), default = OF_FIELDS[place, name], getattr(part, name)
    default = {"robots": ("camera",), "num_pois": default or (3,)}.get(name, default)
    numbers = default["red"] if name == "colours" else default
    is_tuple = isinstance(numbers, tuple)
    values = [(*numbers[:-1], x) if is_tuple else x for x in outside(limits, numbers)]
    if limits.min_items:
        values.append(default[: limits.min_items - 1])
    if limits.max_items < math.inf:
        values.append(default[:1] * (limits.max_items + 1))
    assert values
    for value in values:
        wrong = value if numbers is default else {"red": value}
        told = message(dataclasses.replace, part, **{name: wrong})
        assert told.startswith(f"{place}.{name}".lstrip("."))
        assert told.endswith(f": must be {described(kind, limits)}")


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
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


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
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
REDS = "red cylinder", "red cube"
PRICES = {"dqn.task": "team", "mdp.reward": "nats", "mdp.look_cost": 0.1}
FROM_SCANS = {"jmvae.learns_from": "scans", "jmvae.fusion": "filter"}
POSTS = {**SHAPES, "slab": Shape("box", (1.0, 0.5)), "post": Shape("box", (0.5, 0.5))}
SIXTEEN = tuple(f"{colour} {shape}" for colour in COLOURS for shape in POSTS)
OF_SIXTEEN = {"jmvae.latent_size": 4, "arena.shapes": POSTS, "arena.classes": SIXTEEN}
CHANGES = [
    # 240 degrees / 76 = 3.16, of which three are 9.47; a PoI of 0.2 m at 1.2 m is 9.56 wide.
    (FROM_SCANS | {"lidar.num_beams": 76, "lidar.window": 20}, "lidar.num_beams = 76: must be at"),
    # 240 / 682 x 511 = 179.8 degrees.
    (FROM_SCANS | {"lidar.window": 513}, "lidar.window = 513: must be from 3 to 512 to learn"),
    (FROM_SCANS | {"lidar.window_range": 1.1}, "lidar.window_range = 1.1: must be at least"),
    # Groups of looks at the same PoIs: 16 scenes of three, of which two groups show six PoIs.
    (FROM_SCANS | OF_SIXTEEN | {"detector.num_held_out": 16}, "detector.num_held_out = 16"),
    ({"jmvae.learns_from": "scans"}, "jmvae.fusion = 'in_place': must be filter, because"),
    ({"modalities": ("lidar", "lidar")}, "must name no modality twice"),
    ({"modalities": ("camera", "sonar")}, "must be among camera, lidar"),
    (
        {
            "arena.attributes": {"heat": Attribute({"hot": 1.0, "cold": 0.0})},
            "arena.classes": ("red cube hot", "red cube cold"),
        },
        "arena.attributes = 'heat': no sensor reads it; add one to sensors",
    ),
    (
        {"modalities": ("camera",), "jmvae.reconstruction_weights": (1.0,), "arena.classes": REDS},
        "robots = ('camera',): must distinguish some of red cylinder, red",
    ),
    ({"sensors": {1: SensorConfig("a:b", "shape")}}, "must be a dictionary from names"),
    ({"sensors": {"": SensorConfig("a:b", "shape")}}, "sensors = '': must be a word of 1 to 64"),
    ({"sensors": {"x" * 65: SensorConfig("a:b", "shape")}}, "must be a word of 1 to 64"),
    ({"arena.classes": ("red cube",)}, "must be a list of 2 or more values, each text"),
    ({"arena.classes": ("red  cube", "red cylinder")}, "'red  cube' must be"),
    ({"arena.classes": ("red cube", "red cube")}, "must name no class twice"),
    (
        {"arena.colours": TWINS, "arena.classes": ("red cube", "crimson cube")},
        "no sensor can distinguish",
    ),
    ({"arena.colours": {"red": (1.0, 0.0)}}, "each a list of 3 values, each a number, from 0 to 1"),
    (
        {"arena.num_pois": 26},
        "arena.num_pois = 26: must be at most 25: no more PoIs of radius 0.1 m with gaps of 0.3 m "
        "fit into an arena of side 3.0 m",
    ),
    ({"camera.field_of_view": 30.0}, "camera.field_of_view = 30.0: must be at least 42 degrees"),
    ({"lidar.window": 684}, "lidar.window = 684: must be at most 683: it has 683 rays, with a"),
    ({"camera.window": 161}, "camera.window = 161: must be at most 160: it has 640 rays, with a"),
    ({"lidar.max_range": 0.08}, "lidar.max_range = 0.08: must be above min_range = 0.08"),
    ({"lidar.window_range": 0.08}, "lidar.window_range = 0.08: must be above min_range = 0.08"),
    ({"lidar.range_noise": 5.1}, "lidar.range_noise = 5.1: must be at most max_range = 5.0"),
    # The corner of a PoI, a robot and .03 m: .1414 + .0495 + .03.
    ({"viewpoint.min_distance": 0.22}, "viewpoint.min_distance = 0.22: must be at least 0.221 m"),
    ({"viewpoint.min_distance": 1.2}, "max_distance = 1.2: must be above min_distance = 1.2"),
    ({"viewpoint.max_distance": 1.6}, "must be at most half the arena's side, 1.5 m"),
    ({"navigation.view_range": 1.3}, "= 1.3: must be at most viewpoint.max_distance = 1.2 m"),
    ({"mdp.reward": "nats", "mdp.look_cost": 1.1}, "look_cost = 1.1: must be below 1.1, all the"),
    # ln 3 less .1 nats of a look of .45 s.
    (PRICES | {"team.second_cost": 2.22}, "team.second_cost = 2.22: must be below 2.21914: a"),
    ({"navigation.view_range": 0.29}, "navigation.view_range = 0.29: must be at least 0.300 m"),
    (
        {"mdp.partly_seen_starts": True, "arena.num_pois": 16, "arena.side": 6.0},
        "must be off: it needs 2 to 30 pairs of PoI and modality, and there are 32",
    ),
    (
        {"detector.calibration": 0.5, "detector.num_scans": 1, "arena.num_pois": 1},
        "detector.calibration = 0.5: leaves none of 1 scans to train on; lower it",
    ),
    (
        {"jmvae.latent_size": 3, "arena.shapes": POSTS, "arena.classes": SIXTEEN},
        "jmvae.latent_size = 3: must be at least 4, so that beliefs can hold 16 classes",
    ),
    ({"jmvae.reconstruction_weights": (1.0,) * 9}, "must have one value for each of modalities ="),
    ({"mdp.reward": "bits"}, "mdp.reward = 'bits': must be paper, nats or package.module:function"),
    ({"dqn.task": "team", "dqn.observe": "live"}, "dqn.observe = 'live': must be 'bank' with dqn"),
    ({"evaluation.num_pois": (3,)}, "evaluation.num_pois = (3,): must be empty unless"),
    ({"team.num_pois": (4, 3)}, "team.num_pois = (4, 3): must be a minimum and a maximum, in this"),
    (
        {
            "dqn.task": "team",
            "dqn.observe": "bank",
            "team.num_pois": (3, 8),
            "team.sides": (2.0, 3.0),
        },
        "team.sides = (2.0, 3.0): must be at least 2.33 m, so that 8 PoIs fit",
    ),
    ({"robots": ("camera", "sonar")}, "must each be one of modalities: camera, lidar"),
    ({"dqn.replay_capacity": 65}, "dqn.replay_capacity = 65: must be a multiple of num_envs = 32"),
    ({"jmvae.reconstruction_weights": (1e-40, 1.0)}, "0 or of magnitude 1e-30 to 1e+30"),
    ({"dqn.task": np.ones(2)}, "must be one of map, team"),
    ({"dqn.replay_capacity": 32 * 10**8}, "must be a whole number, at least 1, below 2^31"),
    ({"mission.policies": ("naive", "latent", "naive")}, "must name no policy twice"),
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
    assert expected in message(changed, changes)


AT_LIMITS = [
    {"navigation.view_range": 1.2},
    {"navigation.view_range": 0.3},
    {"viewpoint.max_distance": 1.5},
    {"lidar.range_noise": 5.0},
    {"lidar.window": 683},
    {"camera.window": 160},
    {"camera.field_of_view": 42.0},
    {"arena.num_pois": 25},
    {"mdp.partly_seen_starts": True, "arena.num_pois": 15, "arena.side": 6.0},
    {"arena.attributes": {"heat": Attribute({"hot": 60.0})},
     "arena.classes": ("red cube hot", "green cube hot"),
     "sensors": {"thermal": SensorConfig("own:thermal", "heat")}},
    {"arena.colours": {"red": COLOURS["red"]}, "arena.classes": REDS},
    {"arena.shapes": {"cube": SHAPES["cube"]}, "arena.classes": ("red cube", "green cube")},
    {"jmvae.latent_size": 4, "arena.shapes": POSTS, "arena.classes": SIXTEEN},
    {"mission.localisation": LocalisationConfig(search=(0.3, 30.0), error=(1.0, 180.0))},
    {"dqn.epochs": 970, "dqn.replay_capacity": 32},  # in chunks of 10
    {"team.num_pois": (3, 3), "team.sides": (4.0, 4.0), "mdp.reward": "nats", "mdp.look_cost": 1.0},
    PRICES | {"team.second_cost": 2.21},
    FROM_SCANS | {"lidar.num_beams": 77, "lidar.window": 20},
    FROM_SCANS | {"lidar.window": 512},
    FROM_SCANS | {"lidar.window": 3, "lidar.window_range": 1.2},
]  # fmt: skip


@pytest.mark.parametrize("changes", AT_LIMITS, ids=count())
def test_settings_just_at_their_limits_are_used(changes):
    assert changed(changes) != SMOKE


@pytest.mark.parametrize(
    ("limits", "inside", "outside"),
    [
        ({}, [0, 2**31 - 1, 1 - 2**31], [2**31, -(2**31)]),
        ({}, [0.0, 1e-30, -1e30], [1e-31, 2e30, NAN]),
        ({"above": 0}, [1], [0]),
        ({"at_least": 0}, [0], [-1]),
        ({"below": 3}, [2], [3]),
        ({"at_most": 3}, [3], [4]),
        ({"at_most": 2**32 - 1}, [2**32 - 1], [2**32]),  # seeds
    ],
)
def test_limits_allow_the_numbers_within(limits, inside, outside):
    found = Limits(**limits)
    for numbers, is_allowed in ((inside, True), (outside, False)):
        for x in numbers:
            assert found.allow(x, is_whole=isinstance(x, int)) == is_allowed


HEAT = Attribute({"hot": 60.0, "cold": 5.0})


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Shape("box", (0.5,)), "shape.half_sides = (0.5,): must be a list of 2 values"),  # pyright: ignore
        (lambda: Shape("cylinder", (1.0, 0.5)), "must be the same number twice for a cylinder"),
        (lambda: Attribute({"hot": "x"}), "attribute.values = {'hot': 'x'}: must be a dictionary"),  # pyright: ignore
        (lambda: Attribute({}), "must name one or more"),
        (lambda: Attribute({"very hot": 1.0}), "attribute.values = 'very hot': must be a word"),
        (lambda: ArenaConfig(attributes={"a b": HEAT}), "arena.attributes = 'a b': must be a word"),
        (lambda: ArenaConfig(colours={"": (1, 0, 0)}), "arena.colours = '': must be a word"),
        (lambda: ArenaConfig(shapes={}), "arena.shapes = {}: must name one or more"),
        (lambda: SMOKE.attribute("sonar"), "modality = 'sonar': must be one of camera, lidar"),
        (lambda: SensorConfig("a.b", "shape"), "must be package.module:function"),
        (lambda: SensorConfig(3, "shape"), "sensor.make = 3: must be text"),  # pyright: ignore
        (lambda: ArenaConfig(num_pois=np.int64(3)), "arena.num_pois = np.int64(3): must be a whol"),  # pyright: ignore
        (lambda: ArenaConfig(num_pois=jnp.int32(3)), "arena.num_pois = Array(3"),  # not traced
        (lambda: Config(5), "modalities = 5: must be a list of 1 to 8"),  # pyright: ignore
        (lambda: ArenaConfig(attributes={"shape": HEAT}), "arena.attributes = 'shape': already e"),
        (
            lambda: ArenaConfig(attributes={"heat": HEAT}, classes=("red cube", "red cube hot")),
            "'red cube' must be \"COLOUR SHAPE HEAT\" with a colour of red",
        ),
        (
            lambda: Config(sensors={"thermal": SensorConfig("a:b", "weight")}),
            "sensors.thermal.attribute = 'weight': must be one of colour, shape",
        ),
        (lambda: Config(sensors={"joint": SensorConfig("a:b", "shape")}), "sensors = 'joint': al"),
        (lambda: CommunicationConfig(loss=0.5), "mission.communication.loss = 0.5: must be 0"),
        (
            lambda: changed({"mission.communication": CommunicationConfig(own_maps=True)}),
            "mission.communication.own_maps = True: must be off unless jmvae.fusion is 'filter'",
        ),
        (
            lambda: dataclasses.replace(SMOKE.mission.localisation, search=(0.4, 0.0)),
            "mission.localisation.search = (0.4, 0.0): must be at most 0.3 m and degrees",
        ),
    ],
)
def test_parts_that_cannot_be_used_are_named(make, expected):
    assert expected in message(make)


def test_whole_numbers_become_real_and_lists_tuples_as_in_json():
    assert isinstance(ArenaConfig(side=3).side, float)
    assert Config(robots=["camera"]).robots == ("camera",)  # pyright: ignore
    assert from_plain({"robots": ["camera"]}) == Config(robots=("camera",))


def test_an_error_survives_pickling_and_shows_control_characters():
    with pytest.raises(ConfigError) as error:
        ArenaConfig(side=-1.0)
    found = pickle.loads(pickle.dumps(error.value))
    assert type(found) is ConfigError
    expected = "arena.side = -1.0: must be a number, greater than 0 and at most 100"
    assert str(found) == str(error.value) == expected
    told = str(ConfigError("run", "a", "holds \x1b[2J\n of mission-2"))
    assert told == "run = 'a': holds \\x1b[2J\\n of mission-2"


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        ({"dqn": {"epoch": 3}}, "dqn.epoch = 3: unknown setting; did you mean dqn.epochs?"),
        (
            {"num_poi": 4},
            "num_poi = 4: unknown setting; did you mean arena.num_pois or team.num_pois or "
            "evaluation.num_pois?",
        ),
        ({"zzz": 4}, "zzz = 4: unknown setting"),
        ({"arena": 4}, "arena = 4: must be an object with names and values"),
        ({"sensors": {"x": {"make": "a:b"}}}, "sensors.x = {'make': 'a:b'}: missing setting att"),
        ({"mission": {"attempts": 5}}, "mission.attempts = 5: unknown setting"),
        ({"dqn": {"epochs": 997}}, "dqn.epochs = 997: must have a divisor from 10 to 100"),
    ],
)
def test_plain_settings_that_are_unknown_are_named(stored, expected):
    assert message(from_plain, stored).startswith(expected)


def test_settings_of_trained_models_load_without_what_are_constants_now():
    stored = {
        "mission": {"attempts": 3, "localisation": {"search": {"position": 0.0, "heading": 0.0}}},
        "filter": {"hidden": (32,), "steps": 5},
        "tours": {"tries": 4},
    }
    assert from_plain(stored, skips=True) == from_plain({"filter": {"steps": 5}})


def test_a_command_refuses_64_bits(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with jax.enable_x64(True):
        assert "JAX_ENABLE_X64 = True: must be off" in error_line([], capsys)
    assert not list(tmp_path.iterdir())

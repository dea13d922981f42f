"""Invalid settings: one line that names the field, its value and what would be right."""

import dataclasses
import json
import os
import pickle
import subprocess
import sys
from itertools import count

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import (
    ANYTHING,
    FIELDS,
    HUGE,
    INF,
    NAN,
    NUMBERS,
    PARTS,
    SECTIONS,
    SMOKE,
    TRACED,
    check_message,
)

from jaxsense import Attribute, Config, ConfigError, SensorConfig, Shape, learn
from jaxsense.config import COLOURS, SHAPES, ArenaConfig, CommunicationConfig, as_plain, from_plain
from jaxsense.config.checks import Limits


@pytest.mark.parametrize(
    "value", [NAN, INF, -INF, -1, 1e300, -1e300, 1e-300, 2**63, HUGE], ids=count()
)
def test_no_number_may_be_such(value):
    """2**63 metres or steps and the like; where only real numbers are meant, 2**63 is one."""
    for section, name in NUMBERS:
        if value == 2**63 and isinstance(getattr(PARTS[section], name), float):
            continue
        with pytest.raises(ConfigError) as error:
            dataclasses.replace(PARTS[section], **{name: value})
        check_message(str(error.value))
        assert str(error.value).startswith(f"{section}.{name} = "), error.value


@pytest.mark.parametrize(
    "value", ["x", "", "1", None, True, [], {}, (1,), b"1", np.arange(2), int], ids=count()
)
def test_no_number_may_be_something_else(value):
    for section, name in NUMBERS:
        if isinstance(value, np.ndarray) and (section, name) in TRACED:
            continue
        with pytest.raises(ConfigError) as error:
            dataclasses.replace(PARTS[section], **{name: value})
        check_message(str(error.value))
        assert str(error.value).startswith(f"{section}.{name} = ")


# Every limit of the settings; a field that is not here has none.
LIMITS = {
    Limits(above=0): "arena.poi_radius arena.poi_gap lidar.min_range lidar.window_range "
    "viewpoint.min_distance viewpoint.max_distance team.travel.speed team.travel.turn_rate "
    "team.travel.look_seconds navigation.view_range camera.light_distance camera.light_time",
    Limits(above=0, at_most=1): "detector.learning_rate jmvae.learning_rate filter.learning_rate "
    "team.tours.learning_rate dqn.learning_rate dqn.epsilon_decay",
    Limits(above=0, at_most=100): "arena.side team.sides",
    Limits(above=0, at_most=1000): "lidar.max_range",
    Limits(above=0, at_most=1_000_000): "jmvae.beta jmvae.initial_beta mdp.unseen_variance",
    Limits(above=0, at_most=360): "lidar.field_of_view",
    Limits(above=0, at_most=3600): "mission.time_limit mission.communication.period",
    Limits(above=0, below=180): "camera.field_of_view",
    Limits(above=0, min_items=1, max_items=20): "navigation.view_distances",
    Limits(above=0.0495): "navigation.robot_radius",
    Limits(above=0.152, at_most=10): "arena.poi_height",
    Limits(at_least=0): "lidar.range_noise viewpoint.clearance mdp.min_increase dqn.epsilon_min "
    "team.travel.view_distance team.tours.steps team.second_cost navigation.inflation "
    "mission.equal_values",
    Limits(at_least=0, at_most=0.5): "detector.calibration",
    Limits(at_least=0, at_most=1): "arena.colours lidar.range_noise_growth lidar.mixed_pixels "
    "lidar.dropout camera.pixel_noise camera.low_light camera.shadow jmvae.annealing team.alone "
    "jmvae.alpha_start "
    "team.partly_seen dqn.discount dqn.final_learning_rate dqn.epsilon_start "
    "mission.localisation.position_error mission.localisation.position_drift",
    Limits(at_least=0, at_most=180): "mission.localisation.heading_error "
    "mission.localisation.heading_drift",
    Limits(at_least=0, at_most=0.3): "mission.localisation.search.position",
    Limits(at_least=0, at_most=0.95): "mission.communication.loss",
    Limits(at_least=0, at_most=3600): "mission.communication.delay",
    Limits(at_least=0, at_most=10): "camera.exposure_error camera.colour_cast "
    "viewpoint.bearing_error",
    Limits(at_least=0, at_most=10_000): "team.tours.walk",
    Limits(at_least=0, at_most=1_000_000): "jmvae.alpha mdp.look_cost detector.num_repeats",
    Limits(at_least=0, at_most=1_000_000, min_items=1): "jmvae.reconstruction_weights",
    Limits(at_least=0, at_most=30): "viewpoint.max_bearing mission.localisation.search.heading",
    Limits(at_least=0, below=1): "mission.least_confidence",
    Limits(at_least=0.5, at_most=1): "shape.half_sides",
    Limits(at_least=1): "lidar.window lidar.stride camera.window camera.stride detector.num_scans "
    "detector.num_held_out detector.steps detector.batch jmvae.samples_per_class jmvae.steps "
    "jmvae.batch filter.steps filter.batch team.tours.states team.tours.batch "
    "dqn.num_envs dqn.epochs dqn.updates dqn.batch dqn.replay_capacity dqn.target_period "
    "dqn.num_starts dqn.chunk evaluation.num_starts evaluation.num_repeats mission.attempts",
    Limits(at_least=1, at_most=100): "filter.looks",
    Limits(at_least=2, at_most=100): "jmvae.looks",
    Limits(at_least=1, at_most=100_000): "lidar.num_beams camera.num_pixels team.max_steps "
    "evaluation.num_states evaluation.value_points mission.episodes",
    Limits(at_least=1, at_most=10_000): "mdp.max_steps evaluation.value_looks",
    Limits(at_least=1, at_most=10_000_000): "evaluation.num_histories",
    Limits(at_least=1, at_most=1000): "jmvae.restarts",
    Limits(at_least=1, at_most=256): "jmvae.latent_size",
    Limits(at_least=1, at_most=60): "navigation.horizon",
    Limits(at_least=1, at_most=64): "arena.num_pois team.num_pois evaluation.num_pois",
    Limits(at_least=1, at_most=8): "team.robots_each",
    Limits(at_least=1, at_most=65_536, min_items=1): (
        "detector.hidden jmvae.hidden filter.hidden dqn.hidden"
    ),
    Limits(at_least=2): "team.tours.tries",
    Limits(min_items=1): "mission.policies",
    Limits(min_items=1, max_items=64): "robots",
    Limits(min_items=1, max_items=8): "modalities",
    Limits(min_items=2): "arena.classes",
}  # fmt: skip
OF_FIELDS = {field: limits for limits, fields in LIMITS.items() for field in fields.split()}
ALL_PARTS = {**PARTS, "": SMOKE, "shape": Shape("box")}


def test_the_table_has_the_limits_of_all_fields():
    declared = {
        f"{place}.{field.name}".lstrip("."): field.metadata["limits"]
        for place, part in ALL_PARTS.items()
        for field in dataclasses.fields(part)
        if "limits" in field.metadata
    }
    assert declared == OF_FIELDS


def outside(limits, default):
    """Values just outside of some limits, in the form of a field's default."""
    whole = type(default) is int or (isinstance(default, tuple) and type(default[0]) is int)
    for limit, sign in ((limits.at_least, -1), (limits.at_most, 1)):
        if limit is not None:
            yield limit + sign * (1 if whole else 1e-6 * max(1.0, limit))
    for limit in (limits.above, limits.below):
        if limit is not None:
            yield limit


@pytest.mark.parametrize("field", OF_FIELDS)
def test_a_value_just_outside_the_limits_is_refused(field):
    limits, (place, _, name) = OF_FIELDS[field], field.rpartition(".")
    part = ALL_PARTS[place]
    default = {"robots": ("camera",), "evaluation.num_pois": (3,)}.get(field, getattr(part, name))
    numbers = default["red"] if field == "arena.colours" else default
    values = [
        (*numbers[:-1], number) if isinstance(numbers, tuple) else number
        for number in outside(limits, numbers)
    ]
    if limits.min_items is not None:
        values.append(default[: limits.min_items - 1])
    if limits.max_items is not None:
        values.append(default[:1] * (limits.max_items + 1))
    assert values
    for value in values:
        given, at = ({"red": value}, f"{field}.red") if numbers is not default else (value, field)
        with pytest.raises(ConfigError) as error:
            dataclasses.replace(part, **{name: given})
        text = str(error.value)
        check_message(text)
        assert text.startswith(f"{at} = ")
        assert text.endswith(f": {limits.expected(value)}")


@pytest.mark.parametrize(
    ("limits", "value", "expected"),
    [
        (Limits(above=0), 0, "must be greater than 0"),
        (Limits(at_least=0), -1, "must be at least 0"),
        (Limits(above=0.5, at_most=1000), 1001, "must be greater than 0.5 and at most 1,000"),
        (Limits(at_least=0, below=1), 1, "must be at least 0 and below 1"),
        (Limits(at_least=1, at_most=64), 65, "must be from 1 to 64"),
        (Limits(at_least=1, at_most=64), (3, 65), "must each be from 1 to 64"),
        (Limits(at_least=1, min_items=1), (), "must have 1 or more values, each at least 1"),
        (Limits(min_items=1, max_items=8), (), "must have 1 to 8 values"),
    ],
)
def test_limits_are_told_in_words(limits, value, expected):
    assert not limits.allow(value)
    assert limits.expected(value) == expected


ZERO = {
    "lidar.range_noise", "camera.pixel_noise", "viewpoint.max_bearing", "viewpoint.bearing_error",
    "viewpoint.clearance", "jmvae.alpha", "jmvae.alpha_start", "jmvae.annealing",
    "mdp.min_increase", "dqn.discount",
    "dqn.final_learning_rate", "dqn.epsilon_min", "navigation.inflation", "mission.equal_values",
    "mission.least_confidence", "lidar.range_noise_growth", "lidar.mixed_pixels", "lidar.dropout",
    "camera.exposure_error", "camera.colour_cast", "camera.low_light", "camera.shadow",
    "detector.calibration", "mdp.look_cost", "team.alone", "team.partly_seen", "team.second_cost",
    "detector.num_repeats",
    "team.tours.steps",
    "team.tours.walk",
    "team.travel.view_distance",
    "mission.localisation.position_error",
    "mission.localisation.heading_error",
    "mission.localisation.position_drift",
    "mission.localisation.heading_drift",
    "mission.localisation.search.position",
    "mission.localisation.search.heading",
    "mission.communication.loss",
    "mission.communication.delay",
}  # fmt: skip


def test_only_these_numbers_may_be_zero():
    for section, name in NUMBERS:
        if f"{section}.{name}" in ZERO:
            dataclasses.replace(PARTS[section], **{name: 0})
        else:
            with pytest.raises(ConfigError, match=f"^{section}."):
                dataclasses.replace(PARTS[section], **{name: 0})


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
SIX = tuple(f"{colour} {shape}" for colour in ("red", "green", "blue") for shape in SHAPES)
REDS = "red cylinder", "red cube"
FROM_SCANS = {"jmvae.learns_from": "scans", "jmvae.fusion": "filter", "jmvae.looks": 4}
POSTS = {**SHAPES, "slab": Shape("box", (1.0, 0.5)), "post": Shape("box", (0.5, 0.5))}
SIXTEEN = tuple(f"{colour} {shape}" for colour in COLOURS for shape in POSTS)
OF_SIXTEEN = {"jmvae.latent_size": 4, "arena.shapes": POSTS, "arena.classes": SIXTEEN}
EIGHT = tuple(
    f"{colour} {shape} {heat}"
    for colour in ("red", "green")
    for shape in SHAPES
    for heat in ("hot", "cold")
)
CHANGES = [
    # 240 degrees / 76 = 3.16, of which three are 9.47; a PoI of 0.2 m at 1.2 m is 9.56 wide.
    (
        FROM_SCANS | {"lidar.num_beams": 76, "lidar.window": 20},
        "lidar.num_beams = 76: must be at least 77 to learn from scans: so that three of the beams",
    ),
    (
        FROM_SCANS | {"lidar.num_beams": 151, "lidar.stride": 2, "lidar.window": 20},
        "lidar.num_beams = 151: must be at least 152 to learn from scans",
    ),
    # 240 / 682 x 511 = 179.8 degrees.
    (
        FROM_SCANS | {"lidar.window": 513},
        "lidar.window = 513: must be from 3 to 512 to learn from scans: at most 180 degrees",
    ),
    (FROM_SCANS | {"lidar.window": 2}, "lidar.window = 2: must be from 3 to 512 to learn"),
    (
        FROM_SCANS | {"lidar.window_range": 1.1},
        "lidar.window_range = 1.1: must be at least viewpoint.max_distance = 1.2 m to learn from",
    ),
    # Groups of looks at the same PoIs: 16 scenes of three, of which two groups show six PoIs.
    (
        FROM_SCANS | OF_SIXTEEN | {"detector.num_held_out": 16},
        "detector.num_held_out = 16: leaves some of 16 classes without a look; raise it",
    ),
    ({"modalities": 5}, "modalities = 5: must be a list of texts"),
    ({"modalities": ("lidar", "lidar")}, "must name no modality twice"),
    (
        {
            "arena.attributes": {"heat": Attribute({"hot": 1.0, "cold": 0.0})},
            "arena.classes": ("red cube hot", "red cube cold"),
        },
        "arena.attributes = 'heat': no sensor reads it; add one to sensors",
    ),
    (
        {"modalities": ("camera",), "jmvae.reconstruction_weights": (1.0,), "arena.classes": REDS},
        "robots = ('camera',): must distinguish some of red cylinder, red cube",
    ),
    ({"modalities": ("lidar", "")}, "must be among camera, lidar"),
    ({"modalities": ("lidar\n",)}, "must be among camera, lidar"),
    ({"arena": 3}, "arena = 3: must be of type ArenaConfig"),
    ({"arena": None}, "arena = None: must be of type"),
    ({"sensors": {1: SensorConfig("a:b", "shape")}}, "must be a dictionary from names"),
    ({"sensors": {"": SensorConfig("a:b", "shape")}}, "sensors = '': must be a word of 1 to 64"),
    ({"sensors": {"a b": SensorConfig("a:b", "shape")}}, "must be a word"),
    ({"sensors": {"../x": SensorConfig("a:b", "shape")}}, "must be a word"),
    ({"sensors": {"x" * 65: SensorConfig("a:b", "shape")}}, "must be a word of 1 to 64"),
    ({"sensors": {"x": "a:b"}}, "values of type SensorConfig"),
    ({"arena.classes": "red cube"}, "must be a list of texts"),
    ({"arena.classes": ("red cube",)}, "arena.classes = ('red cube',): must have 2 or more values"),
    ({"arena.classes": ("red  cube", "red cylinder")}, "'red  cube' must be"),
    ({"arena.classes": ("red cube", "red cube")}, "must name no class twice"),
    ({"arena.classes": ("röd cube", "red cube")}, "'röd cube' must be"),
    (
        {"arena.colours": TWINS, "arena.classes": ("red cube", "crimson cube")},
        "no sensor can distinguish",
    ),
    (
        {"arena.shapes": TURNED, "arena.classes": ("red slab", "red board")},
        "no sensor can distinguish",
    ),
    ({"arena.colours": {}}, "must name one or more"),
    ({"arena.colours": {"red": (1.0, 0.0)}}, "lists of 3 numbers, each 0 or of"),
    ({"arena.colours": {"red": (NAN, 0.0, 0.0)}}, "lists of 3 numbers, each 0 or of"),
    ({"arena.colours": {"red": "red"}}, "lists of 3 numbers, each 0 or of"),
    (
        {"arena.num_pois": 26},
        "arena.num_pois = 26: must be at most 25: no more PoIs of radius 0.1 m with gaps of 0.3 m "
        "fit into an arena of side 3.0 m",
    ),
    (
        {"arena.side": 0.5},
        "arena.num_pois = 3: no PoI fits; lower arena.poi_gap or arena.poi_radius",
    ),
    (
        {"camera.field_of_view": 30.0},
        "viewpoint.max_bearing = 20.0: must be at most half of cam",
    ),
    ({"lidar.field_of_view": 1.0}, "viewpoint.max_bearing = 20.0: must be at most half of lidar"),
    ({"lidar.stride": 10**8, "lidar.window": 1}, "lidar.stride = 100000000: must be at most 683"),
    ({"lidar.window": 684}, "lidar.window = 684: must be at most 683: it has 683 rays, with a"),
    ({"lidar.max_range": 0.08}, "lidar.max_range = 0.08: must be above min_range = 0.08"),
    ({"lidar.window_range": 0.08}, "lidar.window_range = 0.08: must be above min_range = 0.08"),
    ({"lidar.range_noise": 5.1}, "lidar.range_noise = 5.1: must be at most max_range = 5.0"),
    ({"viewpoint.min_distance": 1.2}, "max_distance = 1.2: must be above min_distance = 1.2"),
    ({"viewpoint.min_distance": 0.22}, "must be at least 0.221 m, where the robot is clear of"),
    ({"viewpoint.max_distance": 1.6}, "must be at most half the arena's side, 1.5 m"),
    ({"navigation.view_range": 1.3}, "= 1.3: must be at most viewpoint.max_distance = 1.2 m"),
    ({"navigation.view_distances": (0.2,)}, "must be from 0.300 m, where the robot is clear"),
    ({"navigation.view_distances": (1.1,)}, "of the PoI, to navigation.view_range = 1.0 m"),
    ({"detector.hidden": (1.5,)}, "must be a list of whole numbers"),
    ({"jmvae.hidden": (2**63,)}, "jmvae.hidden = "),
    (
        {"detector.calibration": 0.5, "detector.num_scans": 1, "arena.num_pois": 1},
        "detector.calibration = 0.5: leaves none of 1 scans to train on; lower it",
    ),
    (
        {"jmvae.latent_size": 1, "arena.classes": SIX[:5]},
        "jmvae.latent_size = 1: must be at least 2, so that beliefs can hold 5 classes",
    ),
    (
        {"jmvae.fusion": "filter", "jmvae.latent_size": 1, "arena.classes": SIX},
        "jmvae.latent_size = 1: must be at least 2, so that beliefs can hold 6 classes",
    ),
    (
        {"jmvae.latent_size": 1, "arena.classes": [name for name in SIX if "blue" not in name]},
        "jmvae.latent_size = 1: must be at least 2, so that beliefs can hold 4 classes",
    ),
    (
        {"jmvae.latent_size": 3, "arena.shapes": POSTS, "arena.classes": SIXTEEN},
        "jmvae.latent_size = 3: must be at least 4, so that beliefs can hold 16 classes",
    ),
    (
        {
            "modalities": ("camera", "lidar", "thermal"),
            "sensors": {"thermal": SensorConfig("a:b", "heat")},
            "arena.attributes": {"heat": Attribute({"hot": 1.0, "cold": 0.0})},
            "arena.classes": EIGHT,
            "jmvae.reconstruction_weights": (1.0, 1.0, 1.0),
        },
        "jmvae.latent_size = 2: must be at least 3, so that beliefs can hold 8 classes",
    ),
    ({"jmvae.reconstruction_weights": (1.0,) * 9}, "must have one value for each of modalities ="),
    ({"jmvae.reconstruction_weights": (NAN, 1.0)}, "must be a list of numbers, each 0 or"),
    ({"mdp.reward": "bits"}, "mdp.reward = 'bits': must be paper, nats or package.module:function"),
    (
        {
            "dqn.task": "team",
            "team.num_pois": (3, 16),
            "team.sides": (4.0, 6.0),
            "mdp.partly_seen_starts": True,
        },
        "mdp.partly_seen_starts = True: must be off: it needs 2 to 30 pairs of PoI and",
    ),
    (
        {
            "dqn.task": "team",
            "evaluation.num_pois": (3, 20),
            "mdp.partly_seen_starts": True,
        },
        "mdp.partly_seen_starts = True: must be off: it needs 2 to 30 pairs of PoI and",
    ),
    ({"dqn.task": "robots"}, "dqn.task = 'robots': must be one of map, team"),
    ({"dqn.task": "team", "dqn.observe": "live"}, "dqn.observe = 'live': must be 'bank' with dqn"),
    ({"evaluation.num_pois": (3,)}, "evaluation.num_pois = (3,): must be empty unless"),
    ({"team.num_pois": (4, 3)}, "team.num_pois = (4, 3): must be a minimum and a maximum, in this"),
    ({"team.num_pois": (3,)}, "team.num_pois = (3,): must be a list of 2 whole numbers"),
    ({"team.sides": (4.0, 3.0)}, "team.sides = (4.0, 3.0): must be a minimum and a maximum, in"),
    (
        {"dqn.task": "team", "dqn.observe": "bank", "team.sides": (2.0, 3.0)},
        "team.sides = (2.0, 3.0): must be at least 2.33 m, so that 8 PoIs fit",
    ),
    ({"team.travel": None}, "team.travel = None: must be of type TravelConfig"),
    ({"robots": {"camera"}}, "robots = {'camera'}: must be a list of texts or None"),
    ({"robots": ("camera", "sonar")}, "must each be one of modalities: camera, lidar"),
    (
        {"robots": ("camera", "camera"), "arena.classes": REDS},
        "robots = ('camera', 'camera'): must distinguish some of red cylinder, red cube",
    ),
    ({"mdp.partly_seen_starts": 1}, "mdp.partly_seen_starts = 1: must be True or False"),
    ({"dqn.observe": "Live"}, "dqn.observe = 'Live': must be one of live, bank"),
    ({"dqn.observe": ("live",)}, "must be one of live, bank"),
    ({"dqn.epochs": 61}, "dqn.epochs = 61: must be a multiple of chunk = 20"),
    ({"dqn.num_starts": 65}, "dqn.num_starts = 65: must be a multiple of num_envs = 32"),
    ({"dqn.replay_capacity": 65}, "dqn.replay_capacity = 65: must be a multiple of num_envs = 32"),
    ({"dqn.replay_capacity": 32 * 10**8}, "dqn.replay_capacity = 3200000000: must be below 2^31"),
    ({"dqn.epsilon_start": 0.5, "dqn.epsilon_min": 0.6}, "must be at most epsilon_start = 0.5"),
    ({"navigation.view_distances": (0.6, NAN)}, "must be a list of numbers, each 0 or"),
    ({"mission.policies": ("naive", "latent", "naive")}, "must name no policy twice"),
    ({"mission.policies": "naive"}, "mission.policies = 'naive': must be a list of texts"),
    ({"mission.control_period": 0.033}, "must be a multiple of 0.01 s"),
    ({"mission.time_limit": 0.05}, "mission.time_limit = 0.05: must be at least control_period"),
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


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"own_maps": True}, "own_maps = True: must be off unless jmvae.fusion is 'filter'"),
        ({"loss": 0.5}, "loss = 0.5: must be 0 without mission.communication.own_maps"),
        ({"delay": 2.0}, "delay = 2.0: must be 0 without mission.communication.own_maps"),
    ],
)
def test_messages_that_no_map_reads_are_named(changes, expected):
    with pytest.raises(ConfigError) as error:
        changed({"mission.communication": CommunicationConfig(**changes)})
    assert str(error.value).startswith(f"mission.communication.{expected}")


@pytest.mark.parametrize(("changes", "expected"), CHANGES, ids=count())
def test_settings_that_cannot_be_used_are_named(changes, expected):
    with pytest.raises(ConfigError) as error:
        changed(changes)
    check_message(str(error.value))
    assert expected in str(error.value)


def test_a_lidar_that_is_not_trained_may_be_too_coarse_for_scans():
    camera = {"modalities": ("camera",), "jmvae.reconstruction_weights": (1.0,)}
    classes = {"arena.classes": ("red cube", "green cube")}
    changed(FROM_SCANS | camera | classes | {"lidar.num_beams": 10, "lidar.window": 2})


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Shape("box", (0.5,)), "shape.half_sides = (0.5,): must be a list of 2 numbers"),  # pyright: ignore
        (lambda: Shape("cylinder", (1.0, 0.5)), "must be the same number twice for a cylinder"),
        (lambda: Shape("Box"), "shape.primitive = 'Box': must be one of cylinder, box"),  # pyright: ignore
        (lambda: Attribute({"hot": "x"}), "attribute.values = {'hot': 'x'}: must be a dictionary"),  # pyright: ignore
        (lambda: Attribute({}), "must name one or more"),
        (lambda: Attribute({"hot": 1.0}, NAN), "attribute.elsewhere = nan: must be a number"),
        (lambda: SensorConfig("a.b", "shape"), "must be package.module:function"),
        (lambda: SensorConfig(":", "shape"), "must be package.module:function"),
        (lambda: SensorConfig(3, "shape"), "sensor.make = 3: must be text"),  # pyright: ignore
        (lambda: ArenaConfig(num_pois=np.int64(3)), "arena.num_pois = np.int64(3): must be a whol"),  # pyright: ignore
        (lambda: Config(5), "modalities = 5: must be a list of texts"),  # pyright: ignore
    ],
)  # fmt: skip
def test_parts_that_cannot_be_used_are_named(make, expected):
    with pytest.raises(ConfigError) as error:
        make()
    check_message(str(error.value))
    assert expected in str(error.value)


def test_a_whole_number_becomes_real_where_one_is_declared():
    assert isinstance(ArenaConfig(side=3).side, float)


def test_lists_become_tuples_as_in_json():
    assert Config(robots=["camera"]).robots == ("camera",)  # pyright: ignore
    assert from_plain({"robots": ["camera"]}) == Config(robots=("camera",))


def test_an_error_survives_pickling():
    with pytest.raises(ConfigError) as error:
        ArenaConfig(side=-1.0)
    found = pickle.loads(pickle.dumps(error.value))
    assert type(found) is ConfigError
    assert (
        str(found)
        == str(error.value)
        == "arena.side = -1.0: must be greater than 0 and at most 100"
    )
    assert found.expected == "must be greater than 0 and at most 100"


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        ({"dqn": {"epoch": 3}}, "dqn.epoch = 3: unknown setting; did you mean dqn.epochs?"),
        (
            {"num_poi": 4},
            "num_poi = 4: unknown setting; did you mean arena.num_pois or team.num_pois or "
            "evaluation.num_pois?",
        ),
        ({"team": {"side": 4}}, "team.side = 4: unknown setting; did you mean team.sides?"),
        ({"zzz": 4}, "zzz = 4: unknown setting"),
        ({"arena": 4}, "arena = 4: must be an object with names and values"),
        (
            {"sensors": {"x": {"make": "a:b"}}},
            "sensors.x = {'make': 'a:b'}: missing setting attribute",
        ),
    ],
)
def test_plain_settings_that_are_unknown_are_named(stored, expected):
    with pytest.raises(ConfigError) as error:
        from_plain(stored)
    assert str(error.value) == expected


NO_64_BITS = "JAX_ENABLE_X64 = True: must be off, as jaxsense computes in 32 bits"


def test_64_bits_are_refused():
    key = jax.random.key(0)
    with jax.enable_x64(True), pytest.raises(ConfigError, match=f"^{NO_64_BITS}"):
        learn(key, Config())


def test_64_bits_are_refused_in_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxsense.train"],
        env={**os.environ, "JAX_ENABLE_X64": "1"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    (line,) = (done.stdout + done.stderr).splitlines()
    assert NO_64_BITS in line
    assert not list(tmp_path.iterdir())


def test_an_error_shows_control_characters_and_leaves_text_as_it_is():
    found = str(ConfigError("run", "a", "holds \x1b[2J\n of mission-2"))
    assert found == "run = 'a': holds \\x1b[2J\\n of mission-2"


@pytest.mark.parametrize("value", [[0.1, -0.1], [-0.1, 0.1], [[np.nan, 0.0]]])
def test_every_number_of_an_array_is_checked(value):
    with pytest.raises(ConfigError, match=r"lidar\.range_noise = (-0\.1|nan)"):
        dataclasses.replace(SMOKE.lidar, range_noise=jax.numpy.array(value))
    of_seeds = dataclasses.replace(SMOKE.lidar, range_noise=jax.numpy.array([0.1, 0.2]))
    assert of_seeds.range_noise.shape == (2,)

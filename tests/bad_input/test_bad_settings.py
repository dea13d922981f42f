"""Settings that cannot be used: one line that names each and says what would be right."""

import dataclasses
import json
from itertools import count

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

from jaxsense import Attribute, Config, ConfigError, SensorConfig, Shape
from jaxsense.config import COLOURS, SHAPES, ArenaConfig, as_plain, from_plain


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


ZERO = {
    "lidar.range_noise", "camera.pixel_noise", "viewpoint.max_bearing", "viewpoint.bearing_error",
    "viewpoint.clearance", "jmvae.alpha", "jmvae.annealing", "mdp.min_increase", "dqn.discount",
    "dqn.final_learning_rate", "dqn.epsilon_min", "navigation.inflation", "mission.equal_values",
    "mission.least_confidence", "lidar.range_noise_growth", "lidar.mixed_pixels", "lidar.dropout",
    "camera.exposure_error", "camera.colour_cast", "camera.low_light", "camera.shadow",
    "detector.calibration", "mdp.look_cost", "team.alone", "team.partly_seen", "team.second_cost",
    "team.tours.walk",
    "team.travel.view_distance",
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
CHANGES = [
    ({"modalities": ["lidar"]}, "modalities = ['lidar']: must be a tuple of texts"),
    ({"modalities": ("lidar", "lidar")}, "must name no modality twice"),
    (
        {
            "arena.attributes": {"heat": Attribute({"hot": 1.0, "cold": 0.0})},
            "arena.classes": ("red cube hot", "red cube cold"),
        },
        "must not have both 'red cube hot' and 'red cube cold', which no sensor can distinguish",
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
    (
        {"arena.colours": TWINS, "arena.classes": ("red cube", "crimson cube")},
        "no sensor can distinguish",
    ),
    (
        {"arena.shapes": TURNED, "arena.classes": ("red slab", "red board")},
        "no sensor can distinguish",
    ),
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
    ({"detector.calibration": -0.1}, "detector.calibration = -0.1: must be at least 0, at most"),
    (
        {"detector.calibration": 0.51},
        "detector.calibration = 0.51: must be at least 0, at most",
    ),
    (
        {"detector.calibration": 0.5, "detector.num_scans": 1, "arena.num_pois": 1},
        "detector.calibration = 0.5: leaves no scan to train on, of 1; must be less",
    ),
    (
        {"jmvae.fusion": "filter", "jmvae.latent_size": 1, "arena.classes": SIX[:5]},
        "jmvae.latent_size = 1: must be at least 2, so that a filter can hold 5 classes",
    ),
    (
        {"jmvae.fusion": "filter", "jmvae.latent_size": 2, "arena.classes": SIX},
        "jmvae.latent_size = 2: must be at least 3, so that a filter can hold 6 classes",
    ),
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
    ({"mdp.reward": "bits"}, "mdp.reward = 'bits': must be one of paper, nats"),
    ({"mdp.reward": "nats"}, "mdp.reward = 'nats': needs jmvae.fusion = 'filter', not 'in_place'"),
    ({"mdp.look_cost": -0.1}, "mdp.look_cost = -0.1: must be a number that is not negative"),
    ({"mdp.look_cost": 1e7}, "mdp.look_cost = 10000000.0: must be at most 1,000,000"),
    (
        {
            "dqn.task": "team",
            "team.num_pois": (3, 16),
            "team.sides": (4.0, 6.0),
            "mdp.partly_seen_starts": True,
        },
        "mdp.partly_seen_starts = True: needs 2 to 30 pairs of PoI and modality, not 32; must be",
    ),
    (
        {
            "dqn.task": "team",
            "evaluation.num_pois": (3, 20),
            "mdp.partly_seen_starts": True,
        },
        "mdp.partly_seen_starts = True: needs 2 to 30 pairs of PoI and modality, not 40; must be",
    ),
    ({"dqn.task": "robots"}, "dqn.task = 'robots': must be one of map, team"),
    ({"dqn.task": "team", "dqn.observe": "live"}, "dqn.observe = 'live': must be 'bank' with dqn"),
    ({"evaluation.num_pois": (3,)}, "evaluation.num_pois = (3,): needs dqn.task = 'team'"),
    ({"evaluation.num_pois": (0,)}, "evaluation.num_pois = (0,): must be numbers from 1 to 64"),
    ({"evaluation.num_pois": (65,)}, "evaluation.num_pois = (65,): must be numbers from 1 to 64"),
    ({"team.num_pois": (0, 3)}, "team.num_pois = (0, 3): must be a number greater than 0 and"),
    ({"team.num_pois": (4, 3)}, "team.num_pois = (4, 3): must be a number greater than 0 and"),
    ({"team.num_pois": (3, 65)}, "team.num_pois = (3, 65): must be numbers from 1 to 64"),
    ({"team.num_pois": (3,)}, "team.num_pois = (3,): must be a tuple of 2 whole numbers"),
    ({"team.robots_each": 9}, "team.robots_each = 9: must be at most 8"),
    ({"team.sides": (0.0, 3.0)}, "team.sides = (0.0, 3.0): must be two lengths"),
    ({"team.sides": (4.0, 3.0)}, "team.sides = (4.0, 3.0): must be two lengths"),
    (
        {"dqn.task": "team", "dqn.observe": "bank", "team.sides": (2.0, 3.0)},
        "team.sides = (2.0, 3.0): must be at least 2.33 m, where 8 PoIs fit",
    ),
    ({"team.sides": (4.0, 101.0)}, "team.sides = (4.0, 101.0): must be two lengths"),
    ({"team.alone": 1.1}, "team.alone = 1.1: must be within 0 and 1"),
    ({"team.partly_seen": 1.1}, "team.partly_seen = 1.1: must be within 0 and 1"),
    ({"team.travel": None}, "team.travel = None: must be of type TravelConfig"),
    ({"robots": ()}, "robots = (): must name 1 to 64 robots, each one of camera, lidar"),
    ({"robots": ("camera",) * 65}, "must name 1 to 64 robots"),
    ({"robots": ["camera"]}, "robots = ['camera']: must be a tuple of texts or None"),
    ({"robots": ("camera", "sonar")}, "must each be one of modalities: camera, lidar"),
    (
        {"robots": ("camera", "camera"), "arena.classes": ("red cylinder", "red cube")},
        "cannot distinguish any of red cylinder, red cube; must be robots that do",
    ),
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
    ({"mission.policies": ()}, "mission.policies = (): must name some of latent, greedy, bayes,"),
    ({"mission.policies": ("naive", "latent", "naive")}, "must name no policy twice"),
    ({"mission.policies": ("naive", "best")}, "('naive', 'best'): must name some of latent, gr"),
    ({"mission.policies": ["naive"]}, "mission.policies = ['naive']: must be a tuple of texts"),
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


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"states": 2 * 10**9}, "team.tours.states = 2000000000: takes"),
        ({"steps": 10**8}, "team.tours.steps = 100000000: takes"),
        ({"tries": 1}, "team.tours.tries = 1: must be at least 2, to compare choices"),
        ({"walk": 2**31 - 1}, "team.tours.walk = 2147483647: must be at most 10,000"),
        ({"batch": 10**9}, "team.tours.batch = 1000000000: takes"),
        ({"walk": -1}, "team.tours.walk = -1: must be a number that is not negative"),
    ],
)
def test_tours_that_cannot_be_learned_are_named(changes, expected):
    def make():
        return changed({"team": {"tours": dataclasses.replace(SMOKE.team.tours, **changes)}})

    with pytest.raises(ConfigError) as error:
        make()
    assert expected in str(error.value)


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

"""Custom colours, shapes, attributes and sensors in the settings: checks, copies and JSON."""

import dataclasses
import json
import sys
import types

import jax
import pytest

from jaxsense import sim
from jaxsense.config import (
    PRESETS,
    Attribute,
    Config,
    ConfigError,
    MdpConfig,
    SensorConfig,
    Shape,
    as_plain,
    from_plain,
)
from jaxsense.config.learning import TeamConfig
from jaxsense.config.scene import COLOURS, MODALITIES, SHAPES, ArenaConfig
from jaxsense.dqn import rewards
from jaxsense.sim.sensors import on_top

TEMPERATURE = {"temperature": Attribute({"cold": 5.0, "hot": 60.0})}
WARM = ArenaConfig(attributes=TEMPERATURE, classes=("red cube hot", "green cylinder cold"))
OWN = Config(
    modalities=("lidar", "thermal"),
    arena=dataclasses.replace(
        WARM,
        colours={**COLOURS, "pink": (0.9, 0.5, 0.6)},
        shapes={**SHAPES, "slab": Shape("box", (1.0, 0.5))},
    ),
    sensors={"thermal": SensorConfig("own_sensors:thermal", "temperature")},
)


@pytest.fixture
def own_sensors(monkeypatch):
    """A module of the user's."""
    module = types.ModuleType("own_sensors")
    monkeypatch.setitem(sys.modules, "own_sensors", module)
    return module


class Thermal(sim.Sensor):
    def read(self, key, hits, surfaces, light):
        return hits.distance


def test_a_sensor_above_the_body_makes_its_robot_as_tall(own_sensors):
    names = ("lidar", "thermal", "thermal")
    for height, expected in ((0.09, (True, False, False)), (0.12, (True, True, True))):
        own_sensors.thermal = lambda config, height=height: thermal(config, height=height)
        assert on_top(OWN, names) == expected
    world = sim.world.make_world(OWN, ("thermal",))
    assert world.arena.mj_model.geom("robot0_lidar").pos[2] > 0.09


def thermal(config, **changed):
    return Thermal(**{"height": 0.1, "rays": sim.Fan(32, 60.0), "window": 8, **changed})


def test_a_team_of_robots_survives_json():
    team = TeamConfig(num_pois=(2, 5))
    for robots in (None, ("camera", "lidar", "camera")):
        config = Config(robots=robots, team=team)
        assert from_plain(json.loads(json.dumps(as_plain(config)))) == config
    # What is not stored comes from the settings to start from, also within a section.
    base = Config(team=team)
    found = from_plain({"team": {"num_pois": [3, 4]}}, base)
    assert found == Config(team=dataclasses.replace(team, num_pois=(3, 4)))


def test_robots_carry_the_sensors_of_the_settings():
    config = Config(robots=("camera", "lidar", "camera"))
    assert config.carried == ("camera", "lidar", "camera")
    assert config.robot_names == ("camera_1", "lidar", "camera_2")
    assert config.modality_of_robot == (0, 1, 0)
    alone = Config(robots=("lidar",))
    assert (alone.robot_names, alone.modality_of_robot) == (("lidar",), (1,))
    # By default one for each modality.
    assert Config().carried == Config().robot_names == ("camera", "lidar")
    assert Config().modality_of_robot == (0, 1)


DICTIONARIES = {
    "COLOURS": COLOURS,
    "SHAPES": SHAPES,
    "MODALITIES": MODALITIES,
    "PRESETS": PRESETS,
    "colours": OWN.arena.colours,
    "shapes": OWN.arena.shapes,
    "attributes": OWN.arena.attributes,
    "values": OWN.arena.attributes["temperature"].values,
    "sensors": OWN.sensors,
}
CHANGES = {
    "set": lambda found: found.__setitem__("pink", (0.9, 0.5, 0.6)),
    "delete": lambda found: found.__delitem__(next(iter(found))),
    "or": lambda found: found.__ior__({"pink": 1}),
    "clear": lambda found: found.clear(),
    "pop": lambda found: found.pop(next(iter(found))),
    "popitem": lambda found: found.popitem(),
    "setdefault": lambda found: found.setdefault("pink", 1),
    "update": lambda found: found.update(pink=1),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("found", DICTIONARIES.values(), ids=DICTIONARIES)
def test_dictionaries_of_settings_cannot_be_changed(found, change):
    before = dict(found)
    with pytest.raises(TypeError, match="settings are immutable"):
        change(found)
    assert dict(found) == before


def test_the_order_of_colours_is_part_of_the_settings():
    # It orders the labels, so that programs compiled for one order are wrong for another.
    turned = dataclasses.replace(OWN.arena, colours=dict(reversed(OWN.arena.colours.items())))
    assert turned.labels("colour") == OWN.arena.labels("colour")[::-1]
    assert turned != OWN.arena
    assert turned.colours != OWN.arena.colours
    assert jax.tree.structure(turned) != jax.tree.structure(OWN.arena)
    assert dataclasses.replace(turned, colours=OWN.arena.colours) == OWN.arena


def test_labels_follow_the_declaration():
    arena = dataclasses.replace(WARM, classes=("red cube hot", "green cube cold", "red cube cold"))
    config = Config(modalities=("camera", "thermal"), sensors=OWN.sensors, arena=arena)
    assert config.labels("camera") == ("red", "green")
    assert config.labels("thermal") == ("cold", "hot")
    assert config.label_of_class("thermal") == (1, 0, 0)
    assert config.label_of_class("camera") == (0, 1, 0)
    assert arena.values("temperature") == (60.0, 5.0, 5.0)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (None, "sensors.thermal.make = 'own_sensors:thermal': must be a function that can be impo"),
        (lambda config: 3, "must return a jaxsense.sim.Sensor, not int"),
        (lambda config: thermal(config, height=0.3), "sensors.thermal: height = 0.3: must be abo"),
        (lambda config: thermal(config, window=40), "window = 40: must be 1 to 32: it has 32 rays"),
        (lambda config: thermal(config, stride=5), "window = 8: must be 1 to 7: it has 32 rays"),
    ],
)
def test_a_sensor_that_does_not_fit_is_named(own_sensors, function, expected):
    if function is not None:
        own_sensors.thermal = function
    with pytest.raises(ConfigError) as error:
        sim.make_world(OWN)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (None, "mdp.reward = 'own_sensors:reward': must be a function that can be imported"),
        (3, "mdp.reward = int: must be a Reward; it lacks is_of_labels, information, of_gain"),
        (rewards.Nats, "mdp.reward = Nats: must be a Reward, not its class"),
    ],
)
def test_a_reward_that_is_none_is_named(own_sensors, made, expected):
    if made is not None:
        own_sensors.reward = lambda config: made
    with pytest.raises(ValueError, match=expected):
        rewards.make(MdpConfig(reward="own_sensors:reward"))

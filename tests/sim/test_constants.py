"""What settings and simulation both need is said in one place."""

import pytest

from jaxsense.config import LIDAR_HEIGHT, TIMESTEP, ArenaConfig, ConfigError, MissionConfig
from jaxsense.config import mission as mission_settings


def test_settings_and_simulation_agree(arena):
    assert arena.mj_model.opt.timestep == TIMESTEP
    lidar = arena.mj_model.geom("robot1_lidar")
    low, high = lidar.pos[2] - lidar.size[2], lidar.pos[2] + lidar.size[2]
    assert low < LIDAR_HEIGHT < high


def test_a_poi_must_be_higher_than_the_beams():
    ArenaConfig(poi_height=LIDAR_HEIGHT + 0.001)
    with pytest.raises(ConfigError, match=r"arena.poi_height = 0.152: must be greater than 0.152"):
        ArenaConfig(poi_height=LIDAR_HEIGHT)


def test_a_control_period_is_some_steps_of_the_physics(monkeypatch):
    monkeypatch.setattr(mission_settings, "TIMESTEP", 0.02)
    MissionConfig(control_period=0.1)
    with pytest.raises(ConfigError, match=r"must be a multiple of 0.02 s from 0.1 to 0.4 s"):
        MissionConfig(control_period=0.09)

"""What settings and simulation both need is said in one place."""

from jaxsense.config import LIDAR_HEIGHT, POI_HEIGHT, TIMESTEP


def test_settings_and_simulation_agree(arena):
    assert arena.mj_model.opt.timestep == TIMESTEP
    lidar = arena.mj_model.geom("robot1_lidar")
    low, high = lidar.pos[2] - lidar.size[2], lidar.pos[2] + lidar.size[2]
    assert low < LIDAR_HEIGHT < high
    assert LIDAR_HEIGHT < POI_HEIGHT

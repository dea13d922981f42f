from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arenas import arena, known_layout, place, set_native  # noqa: F401
from teams import AHEAD, CONFIG, alone, decide_alone, starting, with_config, with_eyes

import jaxsense
from jaxsense import mission
from jaxsense.mission import act
from jaxsense.mission.state import FACING


@pytest.fixture(scope="session")
def team():
    return mission.make_mission(CONFIG)


@pytest.fixture(scope="session")
def models():
    return with_eyes(jaxsense.init(jax.random.key(0), CONFIG))


@pytest.fixture(scope="session")
def arena_of(team, models):
    return starting(team, models)


@pytest.fixture(scope="session")
def set_robot():
    """The state with some entries of one robot's record replaced."""

    def change(state, robot, **values):
        robots = {name: np.array(getattr(state.robots, name)) for name in values}
        for name, value in values.items():
            robots[name][robot] = value
        state = replace(state, robots=replace(state.robots, **robots))
        if "view" not in values:
            return state
        ways, own = state.roadmap, jax.tree.map(lambda x: x[robot], state.robots)
        view = jnp.minimum(own.view, ways.is_free.shape[1] - 1)
        to_view = state.robots.to_view.at[robot].set(ways.to_viewpoint(own.target, view))
        return replace(state, robots=replace(state.robots, to_view=to_view))

    return change


@pytest.fixture(scope="session")
def facing(arena_of, set_robot):
    """A robot that turns to a red cube 0.8 m east of the origin."""

    def make(robot, pose=(0.0, 0.0, 0.0), other=(0.0, 1.2, 0.0), faults=None, error=(0.0,) * 3):
        poses = [pose, other] if robot == 0 else [other, pose]
        state = arena_of(AHEAD, poses, classes=(2, 0, 1), faults=faults)
        state = replace(state, pose_error=jnp.zeros((2, 3)).at[robot].set(jnp.array(error)))
        # It has waited long enough to scan whatever is in the way.
        return set_robot(state, robot, phase=FACING, target=0, progress_at=-100.0)

    return make


@pytest.fixture(scope="session")
def as_numpy():
    return lambda tree: jax.tree.map(np.asarray, tree)


@pytest.fixture(scope="session")
def decides(team, as_numpy):
    """The state after a decision of robot 0, by models."""
    jitted = jax.jit(lambda models, state: decide_alone(jax.random.key(0), team, models, state, 0))
    # JAX would compile another program for weakly typed numbers.
    return lambda models, state: jitted(as_numpy(models), state)


@pytest.fixture(scope="session")
def scan(team, models, as_numpy):
    """A scan in a mission, by one program for all robots, networks and numbers."""

    @jax.jit
    def of_one(key, state, robot, models, config):
        changed = with_config(team, config)
        return alone(lambda key, state: act.scan(key, changed, models, state, robot))(key, state)

    # JAX would compile another program for weakly typed numbers.
    return lambda key, state, robot, models=models, config=CONFIG: of_one(
        key, state, robot, as_numpy(models), config
    )

"""First states hold no weakly typed numbers: JAX would compile a second program after a step."""

import jax
import pytest

from jaxsense import PRESETS, init, looks, mission
from jaxsense.dqn import map_mdp, team_mdp


def weak(tree):
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [jax.tree_util.keystr(path) for path, leaf in leaves if leaf.weak_type]


@pytest.mark.parametrize("preset", ["smoke", "team"])
def test_a_mission_begins_without_weak_types(preset):
    config = PRESETS[preset]
    team, models = mission.make_mission(config), init(jax.random.key(0), config)
    key = jax.random.key(0)
    state = jax.eval_shape(lambda: mission.reset(key, team, models))
    assert not weak(state)


@pytest.mark.slow
def test_episodes_begin_without_weak_types():
    key = jax.random.key(0)
    for preset, reset in (("smoke", map_mdp.reset), ("team", team_mdp.reset)):
        config = PRESETS[preset]
        mdp = looks.make_mdp(config, init(key, config))
        state = jax.eval_shape(lambda mdp=mdp, reset=reset: reset(key, mdp))
        assert not weak(state)

"""The team behind all interfaces for several agents, without any of their libraries."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

from jaxsense import looks
from jaxsense.interfaces import team

NOP = 4


start = jax.jit(lambda key, mdp: team.robots_of(mdp, small.TEAM).start(key))
step = jax.jit(team.step)


def at_the_limit(number):
    """Two cameras and a LiDAR, before the last of so many choices."""
    config = dataclasses.replace(small.team().config, max_steps=number)
    mdp = dataclasses.replace(small.team(), config=config)
    act = functools.partial(step, jax.random.key(1), mdp)
    state = start(jax.random.key(0), mdp)
    for _ in range(number - 1):
        state, outcome = act(state, jnp.zeros(3, int))
        assert not outcome.truncated.any()
    return state, act


@pytest.mark.slow
def test_a_robot_that_chose_nop_at_the_limit_is_done_and_not_cut():
    state, act = at_the_limit(1)
    _, outcome = act(state, jnp.full(3, NOP))
    np.testing.assert_array_equal(outcome.terminated, [True, False, False])
    np.testing.assert_array_equal(outcome.truncated, [False, True, True])


def test_all_that_work_are_cut_at_the_limit():
    state, act = at_the_limit(3)
    _, outcome = act(state, jnp.zeros(3, int))
    np.testing.assert_array_equal(outcome.terminated, [False] * 3)
    np.testing.assert_array_equal(outcome.truncated, [True] * 3)


def test_the_end_of_all_at_the_limit_is_no_cut():
    state, act = at_the_limit(3)
    state = dataclasses.replace(
        state, team=dataclasses.replace(state.team, works=jnp.arange(3) == state.agent)
    )
    _, outcome = act(state, jnp.full(3, NOP))
    np.testing.assert_array_equal(outcome.terminated, [True] * 3)
    np.testing.assert_array_equal(outcome.truncated, [False] * 3)


@pytest.mark.parametrize("actions", [np.array([0, 0, 5]), np.array([0.0, 0.0, 0.0])])
def test_actions_that_do_not_exist_are_refused(actions):
    state = start(jax.random.key(0), small.team())
    with pytest.raises(ValueError, match=r"actions"):
        team.step(jax.random.key(1), small.team(), state, jnp.asarray(actions))


@pytest.mark.slow
def test_classes_and_scans_of_detections_are_drawn_from_keys_of_their_own(monkeypatch):
    """With one key for both, the order of the classes and the first scene would be related."""
    keys, balanced, survey = {}, looks.balanced_classes, looks.surveys

    def classes_of(key, config, number):
        jax.debug.callback(lambda x: keys.update(classes=x), jax.random.key_data(key))
        each = jax.random.split(key, number)
        jax.debug.callback(lambda x: keys.update(split=x), jax.random.key_data(each))
        return balanced(key, config, number)

    def surveys_of(of_scenes, world, classes):
        jax.debug.callback(lambda x: keys.update(scenes=x), jax.random.key_data(of_scenes))
        return survey(of_scenes, world, classes)

    monkeypatch.setattr(looks, "balanced_classes", classes_of)
    monkeypatch.setattr(looks, "surveys", surveys_of)
    models = small.init(jax.random.key(0), small.CONFIG)
    key = jax.random.key(1)
    jax.block_until_ready(looks.detections(key, small.CONFIG, models, 4))
    jax.effects_barrier()
    rows = [keys["classes"][None], keys["split"], keys["scenes"], jax.random.key_data(key)[None]]
    found = np.concatenate(rows)
    assert len(keys["scenes"]) >= 4
    assert len(np.unique(found, axis=0)) == len(found)

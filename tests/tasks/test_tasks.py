"""Frozen tasks: their observations, rewards, masks and ends, and what references reach."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from benchmarks import ship
from jaxsense.dqn import mdp as mdps
from jaxsense.tasks import registry
from jaxsense.tasks.task import EPISODES, SEEDS, key_of_seed

KEY = jax.random.key(3)
NAMES = jaxsense.registered()
SENSORS = "camera", "lidar"
MAPS = tuple(name for name in NAMES if name != "team-v0")


@functools.cache
def programs(name, agent=None):
    """The task, and its functions compiled."""
    task = jaxsense.make(name, agent)
    return task, jax.jit(task.reset), jax.jit(task.step)


def test_a_team_pays_for_the_time_of_all_robots():
    task, reset, step = programs("team-v0")
    _, state = reset(KEY)
    price = float(task.mdp.second_cost)
    assert price > 0
    for _ in range(2):  # both robots choose, then time passes
        before = state
        state, found = step(KEY, state, 0)
    _, outcome = jax.jit(lambda s: mdps.step(KEY, task.mdp, s, jnp.int32(0)))(before)
    assert outcome.seconds > 1
    np.testing.assert_allclose(
        found.reward, outcome.reward - 2 * price * outcome.seconds, rtol=1e-5
    )


def test_a_poi_that_is_not_there_counts_as_nop_in_a_team():
    task, reset, step = programs("team-v0")
    keys = (jax.random.fold_in(KEY, i) for i in range(99))
    state = next(s for s in (reset(key)[1] for key in keys) if not s.team.present[-1])
    absent = task.num_actions - 2
    assert not task.action_mask(state)[absent]
    after, _ = step(KEY, state, absent)
    assert not after.team.works[state.agent]


@pytest.mark.parametrize(
    ("name", "agent", "row"),
    [
        ("team-v0", None, -1),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("team-v0", None, 0),
                *((name, agent, row) for name in MAPS for agent in SENSORS for row in (0, -1)),
            )
        ),
    ],
)
def test_stored_returns_of_references_are_what_they_reach(name, agent, row):
    task = jaxsense.make(name, agent)
    assert task.returns.shape == (len(task.references), SEEDS)
    assert np.isfinite(task.returns).all()
    assert task.references[-1] == "random"
    assert (task.returns[0] > task.returns[-1]).all()
    # A few of the episodes: within five standard errors.
    keys = jax.random.split(key_of_seed(0), EPISODES)[:64]
    played = task.references[row]
    returns = jax.jit(jax.vmap(lambda key: task.play_reference(key, played)))(keys)
    error = 5 * np.std(returns) / np.sqrt(len(keys))
    assert abs(np.mean(returns) - task.returns[row, 0]) < error


@pytest.mark.parametrize("agent", ["camera", "team"])
def test_a_task_is_printed_as_it_is_made(agent):
    name = "team-v0" if agent == "team" else "map-v0"
    for task in (jaxsense.make(name, agent), jaxsense.make(name)):  # by default the first
        assert repr(task) == f"jaxsense.make('{name}', '{agent}')"


@pytest.mark.slow
def test_a_task_is_frozen_from_models(tmp_path, monkeypatch):
    config = jaxsense.PRESETS["smoke"]
    models = jaxsense.init(KEY, config)
    looks = jaxsense.detections(KEY, config, models, 8)
    made = jaxsense.tasks.origin("default")
    monkeypatch.setattr(registry, "DATA", tmp_path)
    monkeypatch.setattr(ship, "EPISODES", 2)
    ship.freeze(KEY, tmp_path / "map-v0.npz", "map-v0", config, models, looks, made)
    task = jaxsense.make("map-v0", "lidar")
    np.testing.assert_array_equal(task.mdp.looks.features[1], looks[1])
    np.testing.assert_array_equal(task.mdp.fusion.classes.mean, models.fusion.classes.mean)
    assert task.returns.shape == (4, SEEDS)
    # Looks at nothing but what the networks, untrained, make of it: scaled to a spread of 1.
    keys = jax.random.split(KEY, 64)
    observed = jax.jit(jax.vmap(lambda key: task.reset(key)[0]))(keys)
    assert np.isfinite(observed).all()
    assert dataclasses.is_dataclass(task)


def test_seeds_of_scores_are_keys_of_their_own():
    numbers = jax.random.key_data(key_of_seed(3))
    np.testing.assert_array_equal(numbers, [0, 2**31 + 3])

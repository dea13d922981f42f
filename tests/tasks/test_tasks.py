"""Frozen tasks: their observations, rewards, masks and ends, and what references reach."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense.config import ConfigError
from jaxsense.dqn import map_mdp, team_mdp
from jaxsense.tasks import registry
from jaxsense.tasks.environment import CLIP
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


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_goes_from_reset_to_nop(name):
    task, reset, step = programs(name)
    observation, state = reset(KEY)
    assert observation.shape == (task.observation_size,)
    assert observation.dtype == jnp.float32
    assert task.action_mask(state).shape == (task.num_actions,)
    assert task.action_mask(state)[-1]
    state, first = step(KEY, state, 0)
    assert np.isfinite(first.reward)
    assert not first.terminated
    assert not np.array_equal(first.observation, observation)
    robots = 2 if name == "team-v0" else 1
    for left in reversed(range(robots)):
        state, last = step(KEY, state, task.num_actions - 1)
        assert bool(last.terminated) == (left == 0)


@pytest.mark.parametrize("name", NAMES)
def test_observations_are_scaled_the_same_way_for_every_poi(name):
    task, reset, step = programs(name)
    observed = []
    for seed in range(16):
        key = jax.random.fold_in(KEY, seed)
        observation, state = reset(key)
        for i in range(4):
            observed.append(observation)
            pois = np.flatnonzero(task.action_mask(state)[:-1])
            state, after = step(jax.random.fold_in(key, i), state, int(pois[i % len(pois)]))
            observation = after.observation
    number = task.num_actions - 1
    features = np.array(observed).reshape(-1, task.observation_size // number)
    assert np.abs(features).max() <= CLIP
    assert np.abs(features.mean(axis=0)).max() < 1.5
    assert (features.std(axis=0) < 2.5).all()
    assert task.scaling.offset.shape == (task.observation_size // number,)


@pytest.mark.parametrize("name", MAPS)
def test_a_reward_is_that_of_the_map_mdp(name):
    task, reset, step = programs(name, "lidar")
    _, state = reset(KEY)
    direct, outcome = jax.jit(lambda s: map_mdp.step(KEY, task.mdp, s, jnp.int32(1), 1))(state)
    after, found = step(KEY, state, 1)
    np.testing.assert_allclose(found.reward, outcome.reward, atol=1e-6)
    np.testing.assert_allclose(after.belief.mean, direct.belief.mean, atol=1e-6)


def test_a_team_pays_for_the_time_of_all_robots():
    task, reset, step = programs("team-v0")
    _, state = reset(KEY)
    price = float(task.mdp.config.second_cost)
    assert price > 0
    for _ in range(2):  # both robots choose, then time passes
        before = state
        state, found = step(KEY, state, 0)
    _, outcome = jax.jit(lambda s: team_mdp.step(KEY, task.mdp, s, jnp.int32(0)))(before)
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
    ("name", "agent"),
    [
        ("team-v0", None),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in ((name, agent) for name in MAPS for agent in SENSORS)
        ),
    ],
)
def test_stored_returns_of_references_are_what_they_reach(name, agent):
    task = jaxsense.make(name, agent)
    assert task.returns.shape == (len(task.references), SEEDS)
    assert np.isfinite(task.returns).all()
    best, worst = task.references[0], task.references[-1]
    assert worst == "random"
    assert (task.returns[0] > task.returns[-1]).all()
    # A few of the episodes: within five standard errors.
    keys = jax.random.split(key_of_seed(0), EPISODES)[:64]
    for row, played in ((0, best), (-1, worst)):
        returns = jax.jit(jax.vmap(lambda key, p=played: task.play_reference(key, p)))(keys)
        error = 5 * np.std(returns) / np.sqrt(len(keys))
        assert abs(np.mean(returns) - task.returns[row, 0]) < error


@pytest.mark.parametrize("agent", ["camera", "team"])
def test_a_task_is_printed_as_it_is_made(agent):
    name = "team-v0" if agent == "team" else "map-v0"
    assert repr(jaxsense.make(name, agent)) == f"jaxsense.make('{name}', '{agent}')"


def test_unknown_tasks_and_agents_are_refused():
    with pytest.raises(ConfigError, match=r"name = 'noisy': must be one of map-v0"):
        jaxsense.make("noisy")
    with pytest.raises(ConfigError, match=r"agent = 'sonar': must be one of camera, lidar"):
        jaxsense.make("noisy-v0", "sonar")
    with pytest.raises(ConfigError, match=r"agent = 'camera': must be team"):
        jaxsense.make("team-v0", "camera")


@pytest.mark.slow
def test_a_task_is_frozen_from_models(tmp_path, monkeypatch):
    config = jaxsense.PRESETS["smoke"]
    models = jaxsense.init(KEY, config)
    looks = jaxsense.detections(KEY, config, models, 8)
    made = jaxsense.tasks.origin("default")
    monkeypatch.setattr(registry, "DATA", tmp_path)
    monkeypatch.setattr(registry, "EPISODES", 2)
    registry.freeze(KEY, tmp_path / "map-v0.npz", "map-v0", config, models, looks, made)
    task = jaxsense.make("map-v0", "lidar")
    np.testing.assert_array_equal(task.mdp.looks.features[1], looks[1])
    np.testing.assert_array_equal(task.mdp.fusion.classes.mean, models.fusion.classes.mean)
    assert task.returns.shape == (4, SEEDS)
    # Looks at nothing but what the networks, untrained, make of it: scaled to a spread of 1.
    keys = jax.random.split(KEY, 64)
    observed = jax.jit(jax.vmap(lambda key: task.reset(key)[0]))(keys)
    assert np.isfinite(observed).all()
    assert dataclasses.is_dataclass(task)

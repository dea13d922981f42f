"""The team of which each robot is an agent, behind jaxmarl and PettingZoo."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.team import surroundings
from jaxsense.interfaces.common import robots_of

AGENTS, NOP = small.AGENTS, small.TEAM_NOP


@pytest.fixture(scope="module")
def robots():
    return robots_of(small.team(), small.TEAM)


@jax.jit
def reset(key, robots):
    return robots.played.reset(key)[1]


@jax.jit
def step(key, robots, state, actions):
    return robots.step(key, state, actions)


def with_limit(robots, number):
    mdp = robots.played.mdp
    mdp = dataclasses.replace(mdp, config=dataclasses.replace(mdp.config, max_steps=number))
    return dataclasses.replace(robots, played=dataclasses.replace(robots.played, mdp=mdp))


def test_the_whole_team_starts_and_is_never_alone(robots):
    assert robots.names == AGENTS
    one_each = robots_of(small.team(), dataclasses.replace(small.TEAM, robots=None))
    assert one_each.names == ("camera", "lidar")
    keys = jax.random.split(jax.random.key(1), 64)
    states = jax.jit(jax.vmap(lambda key: robots.played.reset(key)[1]))(keys)
    assert states.team.works.all()
    assert states.asks.all()
    np.testing.assert_array_equal(states.team.modality, [[0, 0, 1]] * 64)
    # Robots and PoIs are at places of their own: `Teams.alone` is 1 in these settings.
    assert len(np.unique(states.team.poses[:, :, 0])) == 64 * 3
    assert len(np.unique(states.team.positions[:, :, 0])) > 64
    assert set(np.asarray(states.team.present.sum(axis=1))) <= set(range(1, 9))


def test_every_step_equals_the_mdps(robots):
    mdp = robots.played.mdp
    mdp_step = jax.jit(lambda key, state, action: mdps.step(key, mdp, state, action))
    observe = jax.jit(lambda s, r: surroundings(s.belief, s.team, mdp.times(s), r, 2))
    state = expected = reset(jax.random.key(3), robots)
    turns, looks = [], 0
    for i in range(11):
        agent = int(expected.agent)
        turns.append(agent)
        present = np.asarray(expected.team.present)
        for r, mask in enumerate(robots.action_mask(state)):
            np.testing.assert_array_equal(mask, [*(present & (r == agent)), True])
        # PoIs in turn; the lidar ends its part with its second choice.
        pois = np.flatnonzero(present)
        action = NOP if agent == 2 and turns.count(2) == 2 else int(pois[i % len(pois)])
        actions = jnp.full(3, NOP).at[agent].set(action)
        state, found, seconds = step(jax.random.key(i), robots, state, actions)
        expected, outcome = mdp_step(jax.random.key(i), expected, jnp.int32(action))
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), state, expected)
        assert seconds == pytest.approx(float(outcome.seconds), abs=1e-5)
        looks += seconds > 0
        # 0.125 a second for each robot that works; only the robot that has looked is rewarded.
        works = np.asarray(expected.team.works)
        own = np.where(np.arange(3) == int(expected.agent), float(outcome.reward), 0.0)
        np.testing.assert_allclose(found.reward, own - 0.125 * float(seconds) * works, atol=1e-5)
        np.testing.assert_array_equal(found.terminated, ~works)
        assert not found.truncated.any()
        for r, seen in enumerate(found.observation):
            np.testing.assert_allclose(seen, observe(expected, r).T.reshape(-1), atol=1e-5)
    # All three choose at the start, and then whoever has looked.
    assert turns[:3] == [0, 1, 2]
    assert looks > 5


def test_actions_of_the_others_and_absent_pois_do_nothing(robots):
    states = [reset(key, robots) for key in jax.random.split(jax.random.key(4), 32)]
    state = min(states, key=lambda state: int(state.team.present.sum()))
    assert state.team.present.tolist() == [True, *[False] * 7]

    def after(*actions):
        return step(jax.random.key(5), robots, state, jnp.array(actions))

    quiet, ended = after(0, NOP, NOP), after(NOP, NOP, NOP)
    for same, actions in ((quiet, (0, 0, 3)), (ended, (2, NOP, NOP))):
        jax.tree.map(np.testing.assert_array_equal, after(*actions), same)
    assert ended[1].terminated.tolist() == [True, False, False]
    assert not quiet[1].terminated.any()


@pytest.mark.parametrize(
    ("works", "action", "terminated", "truncated"),
    [
        ([True] * 3, 0, [False] * 3, [True] * 3),
        ([True] * 3, NOP, [False, False, True], [True, True, False]),
        # The end of all at the limit is no cut.
        ([False, False, True], NOP, [True] * 3, [False] * 3),
    ],
)
def test_robots_that_would_go_on_at_the_limit_are_cut(robots, works, action, terminated, truncated):
    robots = with_limit(robots, 3)
    state = reset(jax.random.key(0), robots)
    for _ in range(2):
        state, found, _ = step(jax.random.key(1), robots, state, jnp.zeros(3, int))
        assert not found.truncated.any()
    assert state.agent == 2
    state = dataclasses.replace(state, team=dataclasses.replace(state.team, works=jnp.array(works)))
    _, found, _ = step(jax.random.key(1), robots, state, jnp.full(3, action))
    assert (found.terminated.tolist(), found.truncated.tolist()) == (terminated, truncated)


@pytest.mark.parametrize("action", [-3, 9, 0.7])
def test_actions_that_do_not_exist_are_refused_or_reward_nan(robots, action):
    state = reset(jax.random.key(0), robots)
    with pytest.raises(ValueError, match=r"actions"):
        robots.step(jax.random.key(1), state, jnp.full(3, action))
    if isinstance(action, int):
        for _ in AGENTS:  # the first look comes after all have chosen
            state, found, _ = step(jax.random.key(4), robots, state, jnp.full(3, action))
        assert np.isnan(found.reward).any()

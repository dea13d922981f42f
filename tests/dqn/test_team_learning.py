"""What a team's Q-network learns from, and what it then says, where that is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import (
    ONCE_Q,
    ONCE_SEEN,
    PLACES,
    TRAVEL,
    Fixed,
    agent_of,
    classes_mdp,
    paying_once_mdp,
    team_mdp_of,
)

from jaxsense.config import DqnConfig
from jaxsense.dqn import starts, training
from jaxsense.dqn.agent import Agent, Environment
from jaxsense.dqn.team import alone

FAST_TO_COMPILE = {"xla_backend_optimization_level": 0}
SMALL = DqnConfig(
    task="team", observe="bank", hidden=(8,), num_envs=8, epochs=12, updates=1, batch=8,
    replay_capacity=64, discount=0.5,
)  # fmt: skip


def team_of(mapped, poses, places, **config):
    return team_mdp_of(mapped, Fixed(places, poses), **{"alone": 0.0, "partly_seen": 0.0, **config})


def learning_in(mdp, config=SMALL):
    return Environment(agent_of(mdp, config.hidden, config.discount), mdp)


# From the origin 6, 11 and 16 s to look, less the turns, see `test_travel.py`.
TWO = team_of(
    classes_mdp(partly_seen_starts=False),
    jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, jnp.pi / 2]]),
    PLACES,
    num_pois=(3, 3),
)


def test_values_of_setting_out_as_worked_by_hand(monkeypatch):
    # D = 1 and M = 1: nine numbers of each PoI, the third of which is its time in tens of seconds.
    seen = jnp.zeros((9, 3)).at[2].set(jnp.array([0.2, 0.0, 0.4])).reshape(-1)
    after = jnp.array([8.0, 3.0, 16.0, 0.0])
    monkeypatch.setattr(Agent, "q", lambda agent, params, observed: params)
    agent = Agent(0.5, 0.1, TRAVEL, 3, 1, 1, (8,))
    # 2 s: 8/4 - .2; at once; 4 s: 16/16 - .4; NOP.
    np.testing.assert_allclose(agent.values(after, seen), [1.8, 3.0, 0.6, 0.0], rtol=1e-6)
    # By half and by a quarter there is no PoI, and the way there costs the same.
    doubtful = agent.values(after, seen, jnp.array([0.5, 0.25, 1.0]))
    np.testing.assert_allclose(doubtful, [0.8, 0.75, 0.6, 0.0], rtol=1e-6)
    # The same for a batch in the last axis.
    both = agent.values(jnp.stack([after, -after], 1), jnp.stack([seen, seen], 1))
    np.testing.assert_allclose(both.T, [[1.8, 3.0, 0.6, 0], [-2.2, -3.0, -1.4, 0]], rtol=1e-6)
    far = Agent(0.2, 0.0, TRAVEL, 3, 1, 1, (8,)).values(jnp.array([1.0, -1, -1, 0]), 900 * seen)
    assert jnp.sign(far).tolist() == [1, -1, -1, 0]  # half an hour away and more
    # Of two PoIs more than 43 s away, where .2^t is less than 1e-30, the nearer counts more.
    times = jnp.zeros((9, 3)).at[2].set(jnp.array([4.4, 9.0, 5.0])).reshape(-1)
    far = Agent(0.2, 0.0, TRAVEL, 3, 1, 1, (8,)).values(jnp.ones(4), times)
    assert far[0] > far[2] > far[1] > 0


@pytest.fixture(scope="module")
def steps():
    """What is learned from each choice of two robots, with the observations before them."""
    place = learning_in(TWO)
    observe, step = jax.jit(place.observe), jax.jit(place.step)
    state, found = jax.jit(place.reset)(jax.random.key(0)), []
    # Robot 0 to PoI 0, 6 s away; robot 1 to PoI 1, 11 s; robot 0 ends; robot 1 chooses anew what it
    # has chosen, looks, and ends.
    for action in (0, 1, 3, 1, 3):
        seen = observe(state)
        agent = int(state.now.agent)
        state, transition, outcome = step(jax.random.key(1), state, seen, jnp.int32(action))
        found.append((agent, seen, transition, outcome, observe(state)))
    return found


def test_a_look_is_learned_from_its_robots_last_choice(steps):
    agents, seen, transitions, outcomes, after = zip(*steps, strict=True)
    assert agents == (0, 1, 0, 1, 1)
    # No look, that of robot 0 at PoI 0, none, that of robot 1 at PoI 1, and none.
    assert [int(t.a_tm1) for t in transitions] == [3, 0, 3, 1, 3]
    assert [float(t.discount_t) for t in transitions] == [0, 1, 0, 1, 0]
    gain = 0.2 - 1 / np.sqrt(40)
    np.testing.assert_allclose([t.r_t for t in transitions], [0, gain, 0, gain, 0], atol=1e-6)
    assert [bool(o.terminated) for o in outcomes] == [False, False, False, False, True]
    np.testing.assert_array_equal(transitions[1].s_tm1, seen[0])
    np.testing.assert_array_equal(transitions[3].s_tm1, seen[3])
    assert not np.array_equal(seen[1], seen[3])
    for i in (1, 3):
        np.testing.assert_array_equal(transitions[i].s_t, after[i])


def test_without_a_look_nothing_is_lost(steps):
    for _, _, t, _, _ in (steps[0], steps[2], steps[4]):
        # The network knows that nothing follows NOP.
        q_tm1, q_t = jnp.array([1.0, 2.0, 3.0, 0.0]), jnp.full(4, 9.0)
        found = t.a_tm1, t.r_t, t.discount_t, q_t
        error = lambda q, found=found: training.td_error(q, *found)  # noqa: E731
        assert error(q_tm1) == 0
        slope = jax.grad(lambda q: training.pseudo_huber(error(q)))(q_tm1)  # noqa: B023
        np.testing.assert_array_equal(slope, 0.0)


def test_exploring_takes_every_poi_that_is_present_and_no_other():
    state = jax.jit(learning_in(TWO).reset)(jax.random.key(0))
    present = jnp.array([[True, False, True], [False, False, True], [True, True, True]])
    states = jax.tree.map(lambda x: jnp.stack([x] * 3), state)
    team = replace(states.now.team, present=present)
    states = replace(states, now=replace(states.now, team=team))
    draws = jax.random.uniform(jax.random.key(1), (600,)).at[:2].set(jnp.array([0.0, 0.9999999]))
    of_draw = jax.jit(jax.vmap(lambda x: training._explored(states, jnp.full(3, x))))
    found = np.asarray(of_draw(draws))
    for column, expected in zip(found.T, ([0, 2, 3], [2, 3], [0, 1, 2, 3]), strict=True):
        assert sorted(set(column)) == expected
        shares = np.bincount(column, minlength=4)[np.array(expected)] / 600
        # Four standard errors.
        np.testing.assert_allclose(shares, 1 / len(expected), atol=4 * 0.5 / np.sqrt(600))


# As the probe in `test_dqn_training.py`, for a team of one: the first look at a PoI pays .8, others
# cost 1. After the look comes the way to the next one, a second of looking: gamma = .5.
ALONE = team_of(
    paying_once_mdp(num_pois=2), jnp.ones((1, 3)), jnp.ones((2, 2)), num_pois=(2, 2), alone=1.0,
    max_steps=3,
)  # fmt: skip
PROBE = replace(
    SMALL, hidden=(16,), num_envs=32, epochs=600, updates=2, batch=64,
    replay_capacity=4096, learning_rate=1e-2, epsilon_min=0.5,
    target_period=20,
)  # fmt: skip


def test_a_robot_alone_learns_the_values_worked_by_hand():
    learning = learning_in(ALONE, PROBE)
    train = lambda key: training.train(key, learning, PROBE)  # noqa: E731
    train = jax.jit(train, compiler_options=FAST_TO_COMPILE)
    state, info = train(jax.random.key(0))
    assert np.all(info.is_finite)

    @jax.jit
    @jax.vmap
    def learned(seen):
        known = starts.reset(jax.random.key(0), ALONE, jnp.zeros(2, int), seen).belief
        agent = learning_in(ALONE, PROBE).agent
        x = agent.observe(known, alone(2, 0), jnp.ones((1, 2)), jnp.int32(0))
        return agent.q(state.params, x)

    np.testing.assert_allclose(learned(ONCE_SEEN), ONCE_Q, atol=0.1)

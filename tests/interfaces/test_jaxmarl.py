"""jaxmarl: what its wrappers and its import do; `test_team` and `test_parity` have the steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

AGENTS, NOP = [*small.AGENTS], small.TEAM_NOP


@pytest.fixture(scope="module")
def env():
    """Its import takes seconds: not of every worker that collects these tests."""
    needs = "needs the extra jaxsense[jaxmarl]"
    made = pytest.importorskip("jaxsense.interfaces.jaxmarl", reason=needs)
    return made.TeamEnv(small.team(), small.TEAM)


def test_agents_and_spaces_are_those_of_the_robots(env):
    from jaxmarl.environments import MultiAgentEnv

    assert isinstance(env, MultiAgentEnv)
    assert (env.num_agents, env.agents) == (3, AGENTS)
    # Mean, deviation (2 each), time, 3 for each of 2 modalities, presence and place: 14 of 8 PoIs.
    observations, state = env.reset(jax.random.key(0))
    available = env.get_avail_actions(state)
    for agent in AGENTS:
        space = env.observation_space(agent)
        assert space.shape == observations[agent].shape == (14 * 8,)
        assert space.dtype == observations[agent].dtype == jnp.float32
        assert env.action_space(agent).n == NOP + 1
        assert available[agent].shape == (NOP + 1,)


def test_an_ended_episode_starts_again_in_the_same_step(env):
    _, state = env.reset(jax.random.key(7))
    for i, number in enumerate([1, 2, 3]):
        key = jax.random.key(i)
        observations, state, _, dones, _ = env.step(key, state, dict.fromkeys(AGENTS, NOP))
        assert [bool(dones[agent]) for agent in AGENTS] == [True] * number + [False] * (3 - number)
    assert dones["__all__"]
    start = env.reset(jax.random.split(key)[1])
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), (observations, state), start
    )
    assert not state.done


def test_a_robot_without_an_action_is_named(env):
    _, state = env.reset(jax.random.key(3))
    for actions in ({AGENTS[0]: 0}, [0, 0]):
        with pytest.raises(ValueError, match=r"actions = .*: must have one of each of"):
            env.step_env(jax.random.key(4), state, actions)

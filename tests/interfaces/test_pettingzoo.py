"""The PettingZoo form: its own tests, and the same steps as the MDP of a team."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

pytest.importorskip("pettingzoo", reason="needs the extra jaxsense[pettingzoo]")

from gymnasium.error import ResetNeeded
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from jaxsense.dqn import team_mdp
from jaxsense.interfaces.pettingzoo import TeamAECEnv, TeamParallelEnv

AGENTS = ["camera_1", "camera_2", "lidar"]
NOP = 4


@pytest.fixture(scope="module")
def env():
    return TeamParallelEnv(small.team(), small.TEAM)


@pytest.mark.slow
def test_pettingzoos_own_tests_pass(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(env, num_cycles=40)
        parallel_seed_test(lambda: TeamParallelEnv(small.team(), small.TEAM), num_cycles=40)


@pytest.mark.slow
def test_pettingzoos_own_tests_of_turns_pass():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # A mean has no bounds, the only LiDAR no number, and there is nothing to render.
        for known in ("Agent's .* observation space", "We recommend agents", ".*render"):
            warnings.filterwarnings("ignore", known)
        api_test(TeamAECEnv(small.team(), small.TEAM), num_cycles=40)
        seed_test(lambda: TeamAECEnv(small.team(), small.TEAM), num_cycles=40)


@pytest.mark.parametrize("seed", range(3))
def test_turns_are_the_steps_of_the_parallel_environment(env, seed):
    turns = TeamAECEnv(small.team(), small.TEAM)
    turns.reset(seed=seed)
    observations, infos = env.reset(seed=seed)
    assert turns.agents == AGENTS
    totals, earned, moves = dict.fromkeys(AGENTS, 0.0), dict.fromkeys(AGENTS, 0.0), 0
    rng, left = np.random.default_rng(seed), {}
    for agent in turns.agent_iter():
        seen, reward, terminated, truncated, info = turns.last()
        earned[agent] += reward
        if terminated or truncated:
            turns.step(None)
            assert agent not in turns.agents
            left[agent] = seen
            continue
        assert agent == env.possible_agents[int(env._state.agent)]
        np.testing.assert_array_equal(seen, observations[agent])
        assert info["seconds"] == infos[agent]["seconds"]
        np.testing.assert_array_equal(info["action_mask"], infos[agent]["action_mask"])
        action = int(rng.choice(np.flatnonzero(info["action_mask"])))
        turns.step(action)
        for name, last in left.items():  # wrappers ask robots that have left, too
            np.testing.assert_array_equal(turns.observe(name), last)
        observations, rewards, terminations, truncations, infos = env.step({agent: action})
        moves += 1
        assert (turns.rewards, turns.terminations, turns.truncations) == (
            rewards, terminations, truncations
        )  # fmt: skip
        totals = {name: total + rewards.get(name, 0.0) for name, total in totals.items()}
    assert turns.agents == env.agents == []
    assert moves > 3
    # Whoever is asked gets all that it has earned since its last turn.
    assert earned == pytest.approx(totals)


def test_a_turn_takes_actions_of_its_robot_only():
    turns = TeamAECEnv(small.team(), small.TEAM)
    with pytest.raises(ResetNeeded):
        turns.step(0)
    turns.reset(seed=0)
    for action in (5, -1, 0.5, None):
        with pytest.raises(ValueError, match=rf"action = {action}: must be in Discrete"):
            turns.step(action)
    for agent in AGENTS:
        assert turns.agent_selection == agent
        turns.step(jnp.int32(NOP))
        assert turns.terminations[agent]
        # First it leaves.
        turns.step(None)
    with pytest.raises(ResetNeeded, match="after the end"):
        turns.step(0)


@pytest.mark.parametrize("kind", [int, np.int64, np.uint8, jnp.int32])
def test_integers_of_all_libraries_are_actions(env, kind):
    env.reset(seed=1)
    found = env.step({"camera_1": kind(0)})[0]
    env.reset(seed=1)
    expected = env.step({"camera_1": 0})[0]
    np.testing.assert_array_equal(found["camera_1"], expected["camera_1"])
    assert not env.step({"camera_2": kind(NOP)})[2]["camera_1"]
    assert "camera_2" not in env.agents


def test_every_step_equals_the_mdps(env):
    """The keys are those that the environment splits from its seed."""
    mdp = small.team()
    observations, infos = env.reset(seed=3)
    (word,) = np.random.SeedSequence(3).generate_state(1)
    key, start_key = jax.random.split(jax.random.key(int(word)))
    modality = jnp.array([0, 0, 1])
    state = jax.jit(lambda key: team_mdp.reset(key, mdp, modality))(start_key)
    step = jax.jit(lambda key, state, action: team_mdp.step(key, mdp, state, action))
    observe = jax.jit(
        lambda s, r: team_mdp.observation(mdp.config.travel, s.map.belief, s.team, r, 2)
    )
    for i in range(12):
        agent, live = (
            int(state.agent),
            [a for a, w in zip(AGENTS, state.team.works, strict=True) if w],
        )
        assert env.agents == live
        for r, name in enumerate(AGENTS):
            if name in live:
                expected = observe(state, r).reshape(-1)
                np.testing.assert_allclose(observations[name], expected, atol=1e-5)
                pois = np.asarray(state.team.present) & (r == agent)
                np.testing.assert_array_equal(infos[name]["action_mask"], [*pois, True])
                assert env.observation_space(name).contains(observations[name])
        # The lidar ends its part with its first choice.
        action = NOP if agent == 2 else int(np.argmax(state.team.present))
        actions = dict.fromkeys(live, NOP) | {AGENTS[agent]: action}
        observations, rewards, terminations, truncations, infos = env.step(actions)
        key, step_key = jax.random.split(key)
        state, outcome = step(step_key, state, jnp.int32(action))
        works, seconds = np.asarray(state.team.works), float(outcome.seconds)
        own = np.where(np.arange(3) == int(state.agent), float(outcome.reward), 0.0)
        own = dict(zip(AGENTS, own - 0.125 * seconds * works, strict=True))
        for found in (observations, rewards, terminations, truncations, infos):
            assert list(found) == live
        for name in live:
            assert rewards[name] == pytest.approx(own[name], abs=1e-5)
            assert infos[name]["seconds"] == pytest.approx(seconds)
            assert terminations[name] == (not works[AGENTS.index(name)])
            assert truncations[name] == (i == 11)
    assert live == ["camera_1", "camera_2"]
    assert env.agents == []


def test_values_are_of_python(env):
    observations, infos = env.reset(seed=0)
    assert infos["lidar"]["action_mask"].dtype == np.int8
    for agent in AGENTS:
        assert (observations[agent].dtype, observations[agent].shape) == (np.float32, (56,))
        assert env.action_space(agent).n == NOP + 1
    # What it gives is the caller's to change.
    observations["lidar"] += 1.0
    _, rewards, terminations, truncations, infos = env.step(dict.fromkeys(AGENTS, NOP))
    assert type(rewards["lidar"]) is float
    assert type(terminations["lidar"]) is type(truncations["lidar"]) is bool
    assert type(infos["lidar"]["seconds"]) is float


def test_agents_leave_when_their_part_is_over(env):
    env.reset(seed=1)
    for number in (1, 2, 3):
        # Not all have to act, and actions of those that have left are ignored.
        turn = AGENTS[number - 1]
        terminations = env.step({"camera_1": 99, turn: NOP})[2]
        assert [agent for agent, over in terminations.items() if over] == [turn]
        assert env.agents == AGENTS[number:]
    assert env.possible_agents == AGENTS


def test_seeds_repeat_and_differ(env):
    def play(**reset):
        seen = [env.reset(**reset)[0]["lidar"]]
        for _ in range(4):
            seen.append(env.step(dict.fromkeys(env.agents, 0))[0]["lidar"])
        return np.stack(seen)

    first, again, other, later = play(seed=1), play(seed=1), play(seed=2), play()
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (other[0] != later[0]).any()
    # Without any seed, two environments differ.
    fresh = [TeamParallelEnv(small.team(), small.TEAM).reset()[0]["lidar"] for _ in range(2)]
    assert (fresh[0] != fresh[1]).any()


def test_what_cannot_be_is_told(env):
    with pytest.raises(
        ValueError, match=r"modalities \('camera', 'lidar'\): must be a TeamMdp with \('camera',\)"
    ):
        TeamParallelEnv(small.team(), small.ONLY_CAMERAS)
    fresh = TeamParallelEnv(small.team(), small.TEAM)
    with pytest.raises(ResetNeeded):
        fresh.step(dict.fromkeys(AGENTS, 0))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions of \['lidar'\]: must have one of 'camera_1'"):
        env.step({"lidar": 0})
    with pytest.raises(
        ValueError, match=r"actions = \[0, 0\]: must be dict, with one of 'camera_1'"
    ):
        env.step([0, 0])
    for action in (5, -1, 0.5):
        with pytest.raises(
            ValueError, match=rf"actions\['lidar'\] = {action}: must be in Discrete"
        ):
            env.step({"camera_1": 0, "lidar": action})
    for turn in AGENTS:
        env.step({turn: NOP})
    with pytest.raises(ResetNeeded, match="after the end"):
        env.step(dict.fromkeys(AGENTS, 0))

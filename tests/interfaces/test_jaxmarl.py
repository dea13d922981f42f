"""The jaxmarl form: the functions of the MDP of a team behind the real `MultiAgentEnv`."""

import dataclasses
import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

import jaxsense.interfaces
from jaxsense.dqn import team_mdp

AGENTS = ["camera_1", "camera_2", "lidar"]
NOP = 4
CAMERA, LIDAR = 0, 1


@pytest.fixture(scope="module")
def team_env():
    """The class, whose import takes seconds: not of every worker that collects these tests."""
    needs = "needs the extra jaxsense[jaxmarl]"
    return pytest.importorskip("jaxsense.interfaces.jaxmarl", reason=needs).TeamEnv


@pytest.fixture(scope="module")
def env(team_env):
    return team_env(small.team(), small.TEAM)


@pytest.fixture(scope="module")
def mdp_step(env):
    return jax.jit(lambda key, state, action: team_mdp.step(key, small.team(), state, action))


@pytest.fixture(scope="module")
def step_env(env):
    return jax.jit(env.step_env)


def named(values):
    """By the names of the agents."""
    return dict(zip(AGENTS, jnp.asarray(values), strict=True))


def first(mask):
    """The first action that is available."""
    return int(np.argmax(mask))


def assert_trees_close(actual, expected):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), actual, expected)


def random_actions(key, available):
    """One of those that each robot has."""
    logits = {agent: jnp.where(available[agent], 0.0, -jnp.inf) for agent in AGENTS}
    keys = dict(zip(AGENTS, jax.random.split(key, 3), strict=True))
    return {agent: jax.random.categorical(keys[agent], logits[agent]) for agent in AGENTS}


def test_agents_are_the_robots_of_the_settings(team_env, env):
    from jaxmarl.environments import MultiAgentEnv

    assert isinstance(env, MultiAgentEnv)
    assert (env.num_agents, env.agents) == (3, AGENTS)
    assert env.agent_classes == {"camera": ["camera_1", "camera_2"], "lidar": ["lidar"]}
    one_each = team_env(small.team(), dataclasses.replace(small.TEAM, robots=None))
    assert one_each.agents == ["camera", "lidar"]


def test_spaces_tell_what_is_given(env):
    # Mean, deviation (2 each), time, 3 for each of 2 modalities, presence and place: 14 of 4 PoIs.
    observations, state = env.reset(jax.random.key(0))
    available = env.get_avail_actions(state)
    for found in (observations, available, env.observation_spaces, env.action_spaces):
        assert list(found) == AGENTS
    for agent in AGENTS:
        space = env.observation_space(agent)
        assert space.shape == observations[agent].shape == (14 * 4,)
        assert space.dtype == observations[agent].dtype == jnp.float32
        assert space.contains(observations[agent])
        assert env.action_space(agent).n == NOP + 1
        assert available[agent].shape == (NOP + 1,)


def test_the_whole_team_starts_and_is_never_alone(env):
    keys = jax.random.split(jax.random.key(1), 64)

    @jax.jit
    @jax.vmap
    def start(key):
        observations, state = env.reset(key)
        known = small.team().config.travel, state.team.map.belief, state.team.team
        expected = [team_mdp.observation(*known, r, 2).reshape(-1) for r in range(3)]
        return observations, state, dict(zip(AGENTS, expected, strict=True))

    observations, states, expected = start(keys)
    team = states.team.team
    assert team.works.all()
    assert states.team.asks.all()
    np.testing.assert_array_equal(team.modality, [[CAMERA, CAMERA, LIDAR]] * 64)
    # Robots and PoIs are at places of their own: `TeamConfig.alone` is 1 in these settings.
    assert len(np.unique(team.poses[:, :, 0])) == 64 * 3
    assert len(np.unique(team.positions[:, :, 0])) > 64
    assert set(np.asarray(team.present.sum(axis=1))) == {1, 2, 3, 4}
    assert not states.done.any()
    assert_trees_close(observations, expected)


def test_only_the_robot_whose_turn_it_is_has_pois(env, step_env):
    _, state = env.reset(jax.random.key(2))
    turns = []
    for i in range(6):
        available = env.get_avail_actions(state)
        turn = AGENTS[int(state.team.agent)]
        turns.append(turn)
        present = [bool(x) for x in state.team.team.present]
        for agent in AGENTS:
            expected = [*present, True] if agent == turn else [False] * 4 + [True]
            assert list(available[agent]) == expected
        actions = named([NOP] * 3) | {turn: jnp.int32(first(available[turn]))}
        _, state, *_ = step_env(jax.random.key(i), state, actions)
    # All three choose at the start, and then whoever has looked.
    assert turns[:3] == AGENTS


def test_every_step_equals_the_mdps(env, mdp_step, step_env):
    _, state = env.reset(jax.random.key(3))
    expected = state.team
    looks = 0
    observe = jax.jit(
        lambda state, r: team_mdp.observation(
            small.team().config.travel, state.map.belief, state.team, r, 2
        ).reshape(-1)
    )
    for i in range(11):
        key = jax.random.key(10 + i)
        agent = int(expected.agent)
        # PoIs in turn; the lidar ends its part with its third choice.
        present = np.flatnonzero(expected.team.present)
        action = NOP if (agent, i) == (2, 8) else int(present[i % len(present)])
        others = jnp.array([NOP, NOP, NOP]).at[agent].set(action)
        observations, state, rewards, dones, infos = step_env(key, state, named(others))
        expected, outcome = mdp_step(key, expected, jnp.int32(action))
        assert_trees_close(state.team, expected)
        assert state.step == i + 1
        seconds, works = float(outcome.seconds), np.asarray(expected.team.works)
        looks += seconds > 0
        # 0.125 a second for each robot that works; only the robot that has looked is rewarded.
        own = np.where(np.arange(3) == int(expected.agent), float(outcome.reward), 0.0)
        assert_trees_close(rewards, named(own - 0.125 * seconds * works))
        assert {a: bool(done) for a, done in dones.items()} == {
            **{a: not w for a, w in zip(AGENTS, works, strict=True)},
            "__all__": False,
        }
        np.testing.assert_allclose(infos["seconds"], [seconds] * 3)
        for r, name in enumerate(AGENTS):
            np.testing.assert_allclose(observations[name], observe(expected, r), atol=1e-5)
    assert looks > 5


def test_actions_of_the_others_and_absent_pois_do_nothing(env, step_env):
    keys = jax.random.split(jax.random.key(4), 16)
    states = [env.reset(key)[1] for key in keys]
    state = min(states, key=lambda state: int(state.team.team.present.sum()))
    assert list(state.team.team.present) == [True, False, False, False]
    key = jax.random.key(5)
    quiet = step_env(key, state, named([0, NOP, NOP]))
    assert_trees_close(step_env(key, state, named([0, 0, 3])), quiet)
    ended = step_env(key, state, named([NOP, NOP, NOP]))
    assert_trees_close(step_env(key, state, named([2, NOP, NOP])), ended)
    assert bool(ended[3]["camera_1"])
    assert not bool(quiet[3]["camera_1"])


def test_all_are_done_when_the_last_ends_or_the_limit_is_reached(env, step_env):
    _, state = env.reset(jax.random.key(6))
    for i, number in enumerate([1, 2, 3]):
        _, state, _, dones, _ = step_env(jax.random.key(i), state, named([NOP] * 3))
        assert [bool(dones[agent]) for agent in AGENTS] == [True] * number + [False] * (3 - number)
        assert bool(dones["__all__"]) == bool(state.done) == (number == 3)
    for mask in env.get_avail_actions(state).values():
        assert mask.tolist() == [False] * 4 + [True]
    _, state = env.reset(jax.random.key(6))
    for i in range(12):
        assert not state.done
        _, state, _, dones, _ = step_env(jax.random.key(i), state, named([0, 0, 0]))
    assert state.step == 12
    assert all(dones.values())
    assert state.team.team.works.all()


def test_an_ended_episode_starts_again_in_the_same_step(env):
    _, state = env.reset(jax.random.key(7))
    for i in range(3):
        key = jax.random.key(i)
        observations, state, _, dones, _ = env.step(key, state, named([NOP] * 3))
    assert dones["__all__"]
    start = env.reset(jax.random.split(key)[1])
    assert_trees_close((observations, state), start)
    assert not state.done


def test_it_scans_in_a_batch_and_equals_one_alone(env):
    choose = jax.jit(lambda key, state: random_actions(key, env.get_avail_actions(state)))

    def step(carry, key):
        _, state = carry
        choose_key, step_key = jax.random.split(key)
        after, state, rewards, dones, infos = env.step(step_key, state, choose(choose_key, state))
        return (after, state), (after, rewards, dones, infos)

    def play(key):
        start_key, key = jax.random.split(key)
        return jax.lax.scan(step, env.reset(start_key), jax.random.split(key, 24))

    keys = jax.random.split(jax.random.key(8), 4)
    together = jax.jit(jax.vmap(play))(keys)
    # One alone: the programs that the other tests have, step by step.
    start_key, key = jax.random.split(keys[2])
    alone, found = env.reset(start_key), jax.tree.map(lambda x: x[2], together[1])
    for i, step_key in enumerate(jax.random.split(key, 24)):
        alone, outcome = step(alone, step_key)
        assert_trees_close(jax.tree.map(lambda x: x[i], found), outcome)  # noqa: B023
    observations, rewards, dones, infos = together[1]
    assert observations["lidar"].shape == (4, 24, 56)
    assert rewards["lidar"].shape == dones["__all__"].shape == (4, 24)
    assert infos["seconds"].shape == (4, 24, 3)
    # 24 steps of at most 12 each: every environment ended at least once.
    assert dones["__all__"].any(axis=1).all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((observations, rewards)))


def test_the_log_wrapper_sums_rewards(env):
    from jaxmarl.wrappers.baselines import LogWrapper

    logged = LogWrapper(env)
    _, state = logged.reset(jax.random.key(9))
    total, returned = np.zeros(3), np.zeros(3)
    for i in range(13):
        actions = env.get_avail_actions(state.env_state)
        actions = {agent: jnp.int32(first(mask)) for agent, mask in actions.items()}
        _, state, rewards, dones, infos = logged.step(jax.random.key(i), state, actions)
        total = total + np.array([rewards[agent] for agent in AGENTS])
        if i == 11:
            assert dones["__all__"]
            returned, total = total, np.zeros(3)
        assert infos["returned_episode"].tolist() == [i == 11] * 3
        np.testing.assert_allclose(infos["returned_episode_returns"], returned, rtol=1e-5)
        assert infos["seconds"].shape == infos["returned_episode"].shape
    assert infos["returned_episode_lengths"].tolist() == [12.0] * 3
    assert (returned != 0).all()


def test_the_manager_of_rollouts_takes_masks_as_the_page_says(env):
    from jaxmarl.wrappers.baselines import CTRolloutManager

    manager = CTRolloutManager(env, batch_size=4)
    _, states = manager.batch_reset(jax.random.key(10))
    assert all(mask.all() for mask in manager.get_valid_actions(states).values())
    manager.get_valid_actions = jax.vmap(env.get_avail_actions)
    # At first the first robot chooses, and the others have NOP alone.
    for agent, mask in manager.get_valid_actions(states).items():
        np.testing.assert_array_equal(mask[:, -1], True)
        assert mask[:, :-1].any() == (agent == AGENTS[0])


@pytest.mark.parametrize("action", [-3, 5, 0.7])
def test_actions_that_do_not_exist_are_refused_or_reward_nan(env, step_env, action):
    _, state = env.reset(jax.random.key(3))
    actions = {agent: action for agent in AGENTS}
    with pytest.raises(ValueError, match=r"actions( = |.*: must be a whole number)"):
        env.step_env(jax.random.key(4), state, actions)
    if isinstance(action, int):
        for _ in AGENTS:  # the first look comes after all have chosen
            _, state, rewards, _, _ = step_env(jax.random.key(4), state, actions)
        assert np.isnan([*rewards.values()]).any()


def test_a_robot_without_an_action_is_named(env):
    _, state = env.reset(jax.random.key(3))
    first, *_ = AGENTS
    with pytest.raises(ValueError, match=rf"actions of \['{first}'\]: must have one of each of"):
        env.step_env(jax.random.key(4), state, {first: 0})
    with pytest.raises(ValueError, match=r"actions = \[0, 0\]: must be dict, with one of each of"):
        env.step_env(jax.random.key(4), state, [0, 0])


def test_other_sensors_than_those_of_the_settings_are_named(team_env):
    with pytest.raises(
        ValueError, match=r"modalities \('camera', 'lidar'\): must be a TeamMdp with \('camera',\)"
    ):
        team_env(small.team(), small.ONLY_CAMERAS)
    # In another order a robot would carry another's sensor.
    mdp = dataclasses.replace(small.team(), modalities=("lidar", "camera"))
    with pytest.raises(ValueError, match=r"modalities \('lidar', 'camera'\): must be"):
        team_env(mdp, small.TEAM)
    with pytest.raises(ValueError, match=r"mdp = MapMdp with modalities \(\): must be a TeamMdp"):
        team_env(small.team().map, small.ONLY_CAMERAS)


@pytest.mark.usefixtures("team_env")  # which is skipped without jaxmarl
def test_the_import_prints_nothing_and_keeps_streams(monkeypatch, capfd):
    for name in list(sys.modules):
        if name.partition(".")[0] == "jaxmarl" or name == "jaxsense.interfaces.jaxmarl":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(jaxsense.interfaces, "jaxmarl")
    streams = sys.stdout, sys.stderr, sys.__stdout__
    importlib.import_module("jaxsense.interfaces.jaxmarl")
    found = sys.stdout, sys.stderr, sys.__stdout__
    assert "jaxmarl.environments" in sys.modules
    assert all(x is y for x, y in zip(found, streams, strict=True))
    assert capfd.readouterr().out == ""

"""Every adapter plays a task as the task's own functions do, with the keys that it splits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

import jaxsense
from jaxsense.tasks.task import Environment

SEED, NUMBER = 3, 6
WORD = np.random.Generator(np.random.PCG64(np.random.SeedSequence(SEED))).integers(2**32)


@functools.cache
def played(name):
    return Environment(small.small_mdp().of(1)) if name == "own map" else jaxsense.make(name)


def module(name):
    needs = f"needs the extra of {name}"
    return pytest.importorskip(f"jaxsense.interfaces.{name}", reason=needs)


# Each gives the key of the start, and, for an action each, the key of the step and what it shows:
# observation and actions that exist, then reward, and whether the episode is terminated and cut.


def splits(word, rows):
    """Keys of a start and of steps of the first row, as they are split from a seed."""
    key = jax.random.key(int(word))
    while True:
        key, own = jax.random.split(key)
        yield jax.random.split(own, rows)[0] if rows else own


def of_gymnasium(task, rows):
    keys = splits(WORD, rows)
    envs = module("gymnasium").MapVectorEnv(task, num_envs=rows, autoreset_mode="Disabled")
    observations, infos = envs.reset(seed=SEED)
    action = yield next(keys), observations[0], infos["action_mask"][0]
    while True:
        *found, infos = envs.step(np.full(rows, action))
        action = yield next(keys), found[0][0], infos["action_mask"][0], *(x[0] for x in found[1:])


def of_gymnasium_alone(task):
    keys, env = splits(WORD, 1), module("gymnasium").TaskEnv(task)
    observation, info = env.reset(seed=SEED)
    action = yield next(keys), observation, info["action_mask"]
    while True:
        observation, *found, info = env.step(action)
        np.testing.assert_array_equal(env.action_masks(), info["action_mask"])
        action = yield next(keys), observation, info["action_mask"], *found


def of_stable_baselines3(task):
    module("gymnasium")
    envs = module("gymnasium").MapVectorEnv(task, num_envs=1, autoreset_mode="SameStep")
    keys, env = splits(WORD, 1), module("stable_baselines3").MapVecEnv(envs)
    env.seed(SEED)
    observations = env.reset()
    action = yield next(keys), observations[0], env.env_method("action_masks")[0]
    while True:
        observations, rewards, dones, (info,) = env.step(np.array([action]))
        observation = info.get("terminal_observation", observations[0])
        is_cut = info["TimeLimit.truncated"]
        ended = dones[0] & ~is_cut, is_cut
        mask = None if dones[0] else info["action_mask"]
        action = yield next(keys), observation, mask, rewards[0], *ended


def of_gymnax(task, name="gymnax"):
    env = module(name).MapEnv(task)
    params = env.default_params
    observation, state = env.reset(jax.random.key(SEED), params)
    action = yield jax.random.key(SEED), observation, env.action_mask(state)
    for i in range(NUMBER):
        _, state, reward, *ended, info = env.step(jax.random.key(i), state, action, params)
        observation = info["final_observation"]
        ended = ended if name == "gymnax" else [*ended, False]  # of rejax, whether either
        key = jax.random.split(jax.random.key(i))[0]
        action = yield key, observation, info["action_mask"], reward, *ended


def of_jaxmarl(task):
    env = module("jaxmarl").TeamEnv(task)
    observations, state = env.reset(jax.random.key(SEED))
    turn, step = env.agents[int(state.team.agent)], jax.jit(env.step_env)
    action = yield jax.random.key(SEED), observations[turn], env.get_avail_actions(state)[turn]
    for i in range(NUMBER):
        actions = dict.fromkeys(env.agents, jnp.int32(action))
        observations, state, rewards, dones, _ = step(jax.random.key(i), state, actions)
        turn = env.agents[int(state.team.agent)]
        shown = observations[turn], env.get_avail_actions(state)[turn]
        ended = dones["__all__"], False
        action = yield jax.random.key(i), *shown, sum(rewards.values()), *ended


def of_pettingzoo(task):
    env = module("pettingzoo").TeamAECEnv(task)
    (word,) = np.random.SeedSequence(SEED).generate_state(1)
    keys = splits(word, 0)
    env.reset(seed=SEED)
    turn = env.agent_selection
    action = yield next(keys), env.observe(turn), env.infos[turn]["action_mask"]
    while True:
        env.step(action)
        rewards, ended = sum(env.rewards.values()), (all(env.terminations.values()), False)
        while env.terminations[env.agent_selection] and not ended[0]:
            env.step(None)
        turn = env.agent_selection
        shown = env.observe(turn), env.infos[turn]["action_mask"]
        action = yield next(keys), *shown, rewards, *ended


ADAPTERS = {
    "gymnasium": of_gymnasium_alone,
    "gymnasium vector": functools.partial(of_gymnasium, rows=3),
    "stable_baselines3": of_stable_baselines3,
    "gymnax": of_gymnax,
    "rejax": functools.partial(of_gymnax, name="rejax"),
    "jaxmarl": of_jaxmarl,
    "pettingzoo": of_pettingzoo,
}
OF_TEAMS = "jaxmarl", "pettingzoo"
FAST = {
    ("gymnasium vector", "map-v0"), ("gymnax", "map-v0"), ("rejax", "map-v0"),
    ("jaxmarl", "team-v0"), ("pettingzoo", "team-v0"),
}  # fmt: skip
CASES = [
    pytest.param(*case, marks=[] if case in FAST else pytest.mark.slow, id=" ".join(case))
    for adapter in ADAPTERS
    for name in ("map-v0", "team-v0", "own map")
    if not (adapter in OF_TEAMS and name != "team-v0")
    and (adapter, name) != ("gymnasium", "own map")
    for case in [(adapter, name)]
]


@functools.cache
def own_functions(name):
    task = played(name)
    step = jax.jit(task.step)
    return jax.jit(task.reset), lambda *given: step(*given[:2], jnp.int32(given[2]))


@pytest.mark.parametrize(("adapter", "name"), CASES)
def test_an_adapter_plays_as_the_task_does(adapter, name):
    task = played(name)
    reset, step = own_functions(name)
    steps = ADAPTERS[adapter](task)
    key, observation, mask = next(steps)
    expected, state = reset(key)
    for i in range(NUMBER):
        np.testing.assert_allclose(observation, expected, atol=1e-5)
        assert np.asarray(observation).dtype == np.float32
        existing = np.asarray(task.action_mask(state))
        np.testing.assert_array_equal(mask, existing)
        pois = np.flatnonzero(existing[:-1])
        # All PoIs in turn, and NOP at last.
        action = task.num_actions - 1 if i == NUMBER - 1 else pois[i % len(pois)]
        key, observation, mask, reward, *ended = steps.send(int(action))
        state, found = step(key, state, action)
        expected = found.observation
        assert float(reward) == pytest.approx(float(found.reward), abs=1e-4)
        assert ended == [found.terminated, found.truncated]
    if "team" not in name:
        assert found.terminated
        np.testing.assert_allclose(observation, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_spaces_are_bounded_and_hold_what_is_shown(name):
    task = played(name)
    observation, _ = own_functions(name)[0](jax.random.key(0))
    for library in ("gymnasium", "gymnax.environments", "jaxmarl.environments"):
        spaces = pytest.importorskip(f"{library}.spaces", reason=f"needs {library}")
        box, actions = jaxsense.interfaces.common.spaces_of(spaces, task)
        assert box.shape == observation.shape
        assert box.contains(np.asarray(observation))
        assert np.isfinite(box.high).all()
        assert actions.n == task.num_actions


@pytest.mark.parametrize("library", ["gymnax", "jaxmarl"])
def test_environments_of_a_task_share_their_programs(library):
    form = module(library)
    make = {"gymnax": lambda: form.make_env("map-v0"), "jaxmarl": lambda: form.make("team-v0")}
    assert make[library]() is make[library]()


# What the wrappers of jaxmarl do.

AGENTS, NOP = [*small.AGENTS], small.TEAM_NOP


@pytest.fixture(scope="module")
def env():
    """Its import takes seconds: not of every worker that collects these tests, nor of two."""
    return module("jaxmarl").TeamEnv(small.team(), small.TEAM)


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

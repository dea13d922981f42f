"""Frozen tasks by the same names in every library: spaces, masks, seeds and their own checks."""

import functools
import importlib
import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense.config import ConfigError
from jaxsense.interfaces import common
from jaxsense.tasks.environment import CLIP

NAMES = jaxsense.registered()
ROBOTS = ["camera", "lidar"]

make = functools.cache(jaxsense.make)


@pytest.fixture(scope="module")
def gymnasium():
    """Gymnasium, with the tasks."""
    needs = "needs the extra jaxsense[gymnasium]"
    found = pytest.importorskip("gymnasium", reason=needs)
    found.register_envs(pytest.importorskip("jaxsense.interfaces.gymnasium", reason=needs))
    return found


def play(env, seed, number):
    """Observations, masks and rewards of actions that exist, in turn and then NOP."""
    observation, info = env.reset(seed=seed)
    seen, masks, rewards = [observation], [info["action_mask"]], []
    for i in range(number):
        pois = np.flatnonzero(masks[-1][:-1])
        action = len(masks[-1]) - 1 if i == number - 1 else pois[i % len(pois)]
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        masks.append(info["action_mask"])
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(seen), np.array(masks), np.array(rewards)


def test_a_forked_process_is_told_to_spawn(gymnasium, monkeypatch):
    monkeypatch.setattr(common, "_processes", set())
    env = gymnasium.make("jaxsense/map-v0")
    monkeypatch.setattr(common.os, "getpid", lambda: -1)  # as in a process forked from this one
    with pytest.raises(RuntimeError, match=r"was forked .*: start processes with spawn, as vector"):
        env.reset(seed=0)
    with pytest.raises(RuntimeError, match="was forked"):
        gymnasium.make_vec("jaxsense/map-v0", 2).reset(seed=0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork", "ignore:.*ERROR")
def test_asynchronous_environments_of_gymnasium_do_not_hang(gymnasium):
    make_vec = functools.partial(
        gymnasium.make_vec, "jaxsense/map-v0", 2, vectorization_mode="async"
    )
    envs = make_vec(vector_kwargs={"context": "fork"})
    with pytest.raises(RuntimeError, match="was forked"):
        envs.reset(seed=0)
    envs.close(terminate=True)
    envs = make_vec(vector_kwargs={"context": "spawn"})
    assert envs.reset(seed=0)[0].shape == (2, 12)
    envs.close()


@pytest.mark.parametrize("library", ["gymnax", "jaxmarl"])
def test_environments_of_a_task_share_their_programs(library):
    pytest.importorskip(library, reason=f"needs the extra jaxsense[{library}]")
    form = importlib.import_module(f"jaxsense.interfaces.{library}")
    made = {"gymnax": lambda: form.make_env("map-v0"), "jaxmarl": lambda: form.make("team-v0")}
    first, second = made[library](), made[library]()
    compiled = jax.jit(lambda env, key: env.reset(key), static_argnums=0)
    compiled(first, jax.random.key(0))
    compiled(second, jax.random.key(0))
    assert compiled._cache_size() == 1


def test_gymnasium_has_every_task(gymnasium):
    for name in NAMES:
        spec = gymnasium.spec(f"jaxsense/{name}")
        assert spec.kwargs == {"task": name}
        assert json.loads(spec.to_json())["id"] == f"jaxsense/{name}"


@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_gymnasiums_own_check_passes_without_a_warning(gymnasium, name):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(f"jaxsense/{name}", render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_an_environment_of_gymnasium_is_the_task(gymnasium, name):
    task, env = make(name), gymnasium.make(f"jaxsense/{name}")
    assert env.action_space.n == task.num_actions
    assert env.observation_space == gymnasium.spaces.Box(-CLIP, CLIP, (task.observation_size,))
    seen, masks, rewards = play(env, 1, 6)
    assert all(env.observation_space.contains(x) for x in seen)
    assert masks.dtype == np.int8
    # The keys are those that the environment splits from its seed.
    seed = np.random.Generator(np.random.PCG64(np.random.SeedSequence(1))).integers(2**32)
    key, start_key = jax.random.split(jax.random.key(int(seed)))
    observation, state = jax.jit(task.reset)(start_key)
    step = jax.jit(task.step)
    for i, reward in enumerate(rewards):
        np.testing.assert_allclose(seen[i], observation, atol=1e-5)
        np.testing.assert_array_equal(masks[i], task.action_mask(state))
        pois = np.flatnonzero(masks[i][:-1])
        action = task.num_actions - 1 if i == 5 else pois[i % len(pois)]
        key, step_key = jax.random.split(key)
        state, found = step(step_key, state, np.int32(action))
        observation = found.observation
        assert reward == pytest.approx(float(found.reward), abs=1e-5)
    np.testing.assert_array_equal(env.unwrapped.action_masks(), task.action_mask(state))


def test_seeds_of_gymnasium_repeat_and_differ(gymnasium):
    env = gymnasium.make("jaxsense/map-v0", agent="lidar")
    first, again, other = (play(env, seed, 4)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[0] != other[0]).any()
    assert (env.reset()[0] != env.reset()[0]).any()


def test_a_picture_of_gymnasium_shows_what_changes(gymnasium):
    for name, width in (("map-v0", 800), ("team-v0", 1200)):
        env = gymnasium.make(f"jaxsense/{name}", render_mode="rgb_array")
        env.reset(seed=0)
        before = env.render()
        env.step(0)
        after = env.render()
        assert (after.shape, after.dtype) == ((400, width, 3), np.uint8)
        assert (before != after).any()
    assert gymnasium.make("jaxsense/map-v0").unwrapped.render() is None


def test_vector_environments_draw_each_map(gymnasium):
    envs = gymnasium.make_vec("jaxsense/map-v0", num_envs=2, render_mode="rgb_array")
    assert envs.metadata["render_fps"] == 2
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.render()
    envs.reset(seed=3)
    before = envs.render()
    assert [picture.dtype for picture in before] == [np.uint8] * 2
    envs.step(np.array([0, 3]))  # the second episode ends
    after = envs.render()
    assert all(np.any(x != y) for x, y in zip(before, after, strict=True))
    assert envs._actions == [[0], [3]]
    envs.step(np.array([1, 0]))  # and starts anew
    assert envs._actions == [[0, 1], []]
    envs.reset(options={"reset_mask": np.array([True, False])})
    assert envs._actions == [[], []]
    assert gymnasium.make_vec("jaxsense/map-v0", num_envs=2).render() is None
    options = {"render_mode": "rgb_array", "autoreset_mode": "SameStep"}
    envs = gymnasium.make_vec("jaxsense/map-v0", num_envs=2, **options)
    envs.reset(seed=3)
    envs.step(np.array([0, 3]))
    assert envs._actions == [[0], []]


def test_what_cannot_be_in_gymnasium_is_told(gymnasium):
    env = gymnasium.make("jaxsense/map-v0", render_mode="rgb_array").unwrapped
    for act in (lambda: env.step(0), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
            act()
    env.reset(seed=0)
    for action in (4, -1, 0.5):
        with pytest.raises(ValueError, match=f"action = {action}: must be in Discrete"):
            env.step(action)
    assert env.step(3)[2]
    with pytest.raises(gymnasium.error.ResetNeeded, match="after the end"):
        env.step(0)
    with pytest.raises(ValueError, match="render_mode = 'ansi': must be rgb_array or None"):
        gymnasium.make_vec("jaxsense/map-v0", num_envs=1, render_mode="ansi")
    with pytest.raises(ValueError, match="render_mode = 'ansi': must be rgb_array or None"):
        type(env)("map-v0", render_mode="ansi")
    with pytest.raises(ConfigError, match="agent = 'sonar': must be one of camera, lidar"):
        gymnasium.make("jaxsense/map-v0", agent="sonar")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_a_vector_of_gymnasium_is_one_program(gymnasium, name):
    from jaxsense.interfaces.gymnasium import MapVectorEnv

    task = make(name)
    envs = gymnasium.make_vec(f"jaxsense/{name}", num_envs=4, autoreset_mode="SameStep", starts=8)
    assert isinstance(envs, MapVectorEnv)
    observations, infos = envs.reset(seed=0)
    nop = task.num_actions - 1
    for _ in range(4):
        assert envs.observation_space.contains(observations)
        expected = jax.vmap(task.action_mask)(envs._states)
        np.testing.assert_array_equal(infos["action_mask"], expected)
        assert infos["action_mask"].dtype == np.int8
        first = infos["action_mask"].argmax(axis=1)
        actions = np.array([nop, first[1], first[2], first[3]])
        observations, _, terminations, _, infos = envs.step(actions)
        if terminations[0]:
            # Of the next episode, and of the one that has ended.
            assert infos["action_mask"][0].any()
            assert infos["final_info"]["_action_mask"].tolist() == [True, False, False, False]
            assert envs.single_observation_space.contains(infos["final_obs"][0])


def test_a_task_has_its_sensor():
    gymnax = pytest.importorskip("jaxsense.interfaces.gymnax", reason="needs jaxsense[gymnax]")
    with pytest.raises(ValueError, match="modality = 0: must be None with a task"):
        gymnax.MapEnv(make("map-v0"), 0)


def test_gymnax_has_every_task():
    gymnax = pytest.importorskip("gymnax", reason="needs the extra jaxsense[gymnax]")
    import jaxsense.interfaces.gymnax  # noqa: F401

    assert set(NAMES) <= set(gymnax.registered_envs)
    env, params = gymnax.make("map-v0", agent="lidar")
    assert env.played.agent == "lidar"
    assert params.max_steps_in_episode == make("map-v0").max_steps


# What maps and teams do is the task's; `test_gymnax` steps through a map.
@pytest.mark.parametrize("name", [pytest.param("map-v0", marks=pytest.mark.slow), "team-v0"])
def test_a_step_of_gymnax_is_the_tasks(name):
    gymnax = pytest.importorskip("jaxsense.interfaces.gymnax", reason="needs jaxsense[gymnax]")
    task, env = make(name), gymnax.make_env(name)
    params = env.default_params
    key = jax.random.key(4)
    observation, state = env.reset(key, params)
    expected, inner = jax.jit(task.reset)(key)
    np.testing.assert_allclose(observation, expected, atol=1e-5)
    step = jax.jit(task.step)
    for action in (0, 1, 1):
        np.testing.assert_array_equal(env.action_mask(state), task.action_mask(inner))
        observation, state, reward, *ends, info = env.step(key, state, action, params)
        inner, found = step(jax.random.split(key)[0], inner, np.int32(action))
        assert env.observation_space(params).contains(observation)
        np.testing.assert_allclose(observation, found.observation, atol=1e-5)
        np.testing.assert_allclose(reward, found.reward, atol=1e-5)
        np.testing.assert_array_equal(info["action_mask"], task.action_mask(inner))
        assert ends == [found.terminated, found.truncated]


def scaled(task, state, robot):
    """What a robot knows, scaled as the task scales it for the robot whose turn it is."""
    return task.observe(state.replace(agent=jnp.int32(robot)))


@pytest.mark.slow
def test_jaxmarl_scales_for_every_robot():
    jaxmarl = pytest.importorskip("jaxsense.interfaces.jaxmarl", reason="needs jaxsense[jaxmarl]")
    task, env = make("team-v0"), jaxmarl.make("team-v0")
    assert env.agents == ROBOTS
    assert env.agent_classes == {"camera": ["camera"], "lidar": ["lidar"]}
    key = jax.random.key(5)
    observations, state = env.reset(key)
    np.testing.assert_allclose(observations["camera"], jax.jit(task.reset)(key)[0], atol=1e-5)
    observe, step, task_step = jax.jit(scaled), jax.jit(env.step_env), jax.jit(task.step)
    inner = state.team
    for i in range(5):
        key = jax.random.key(i)
        actions = dict.fromkeys(ROBOTS, jnp.int32(i % 3))
        observations, state, rewards, _, _ = step(key, state, actions)
        inner, found = task_step(key, inner, jnp.int32(i % 3))
        for robot, name in enumerate(ROBOTS):
            assert env.observation_space(name).contains(observations[name])
            expected = observe(task, state.team, robot)
            np.testing.assert_allclose(observations[name], expected, atol=1e-5)
        # The team earns what its robots earn.
        np.testing.assert_allclose(sum(rewards.values()), found.reward, atol=1e-4)
    with pytest.raises(ConfigError, match="name = 'map-v0': must be a task of a team"):
        jaxmarl.make("map-v0")


def test_turns_of_pettingzoo_have_masks_and_seeds():
    needs = "needs jaxsense[pettingzoo]"
    pettingzoo = pytest.importorskip("jaxsense.interfaces.pettingzoo", reason=needs)
    env, together = pettingzoo.make("team-v0"), pettingzoo.make_parallel("team-v0")
    seen = []
    for _ in range(2):
        env.reset(seed=3)
        observations, infos = together.reset(seed=3)
        assert env.possible_agents == together.possible_agents == ROBOTS
        for i in range(6):
            observation, _, _, _, info = env.last()
            agent = env.agent_selection
            np.testing.assert_array_equal(observation, observations[agent])
            np.testing.assert_array_equal(info["action_mask"], infos[agent]["action_mask"])
            assert env.observation_space(agent).contains(observation)
            assert np.isfinite(env.observation_space(agent).high).all()
            pois = np.flatnonzero(info["action_mask"][:-1])
            action = int(pois[i % len(pois)])
            env.step(action)
            observations, _, _, _, infos = together.step({agent: action})
            seen.append(observation)
    np.testing.assert_array_equal(seen[:6], seen[6:])
    with pytest.raises(ValueError, match="config: must be None with a task"):
        pettingzoo.TeamAECEnv(make("team-v0"), jaxsense.PRESETS["team"])


def test_pettingzoos_own_tests_pass():
    needs = "needs jaxsense[pettingzoo]"
    ours = pytest.importorskip("jaxsense.interfaces.pettingzoo", reason=needs)
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # The only camera and LiDAR have no number.
        warnings.filterwarnings("ignore", "We recommend agents")
        api_test(ours.make("team-v0"), num_cycles=40)
        seed_test(lambda: ours.make("team-v0"), num_cycles=40)
        parallel_api_test(ours.make_parallel("team-v0"), num_cycles=40)
        parallel_seed_test(lambda: ours.make_parallel("team-v0"), num_cycles=40)

"""Gymnasium's own checks, its rules of what follows an end, pictures, and refusals."""

import dataclasses
import functools
import json
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

pytest.importorskip("gymnasium", reason="needs the extra jaxsense[gymnasium]")

import gymnasium
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import jaxsense
from jaxsense.config import ConfigError
from jaxsense.dqn import map_mdp
from jaxsense.dqn.map_agent import observation
from jaxsense.interfaces import gymnasium as ours
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv

LIDAR, NOP = 1, 3


@pytest.fixture(scope="module")
def starts():
    return prepared_starts(jax.random.key(0), small.small_mdp(), 16)


@pytest.fixture
def make(starts):
    return functools.partial(MapVectorEnv, small.small_mdp(), LIDAR, starts=starts)


class OneEnv(gymnasium.Env):
    """A single environment, always from the same start; without noise, as `small.noiseless`."""

    def __init__(self, mdp, start, step):
        self.mdp, self.start, self.mdp_step = mdp, start, step
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(4)

    def seen(self):
        return np.asarray(observation(self.state.belief))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.start
        return self.seen(), {"action_mask": np.ones(4, np.int8)}

    def step(self, action):
        self.state, outcome = self.mdp_step(jax.random.key(0), self.state, jnp.int32(action))
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return self.seen(), float(outcome.reward), *ends, {"action_mask": np.ones(4, np.int8)}


def assert_same(ours, theirs):
    """Results of `step`, and the same keys and masks in the infos."""
    for mine, reference in zip(ours[:4], theirs[:4], strict=True):
        assert (mine.shape, mine.dtype) == (reference.shape, reference.dtype)
        np.testing.assert_allclose(mine, reference, atol=1e-5)
    assert ours[4].keys() == theirs[4].keys()
    mine, reference = (each[4].pop("final_obs", [None]) for each in (ours, theirs))
    assert [x is None for x in mine] == [x is None for x in reference]
    for x, y in zip(mine, reference, strict=True):
        np.testing.assert_allclose(0 if x is None else x, 0 if y is None else y, atol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, ours[4], theirs[4])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_ends_are_followed_by_starts_as_in_gymnasiums_own(mode):
    mdp, start = small.noiseless()
    one = jax.tree.map(lambda x: x[0], start)
    step = jax.jit(lambda k, s, a: map_mdp.step(k, mdp, s, a, LIDAR))
    theirs = SyncVectorEnv([lambda: OneEnv(mdp, one, step)] * 3, autoreset_mode=mode)
    ours = MapVectorEnv(mdp, LIDAR, 3, start, mode)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    for space in ("single_observation_space", "observation_space", "single_action_space"):
        assert getattr(ours, space) == getattr(theirs, space), space
    assert ours.action_space == theirs.action_space
    np.testing.assert_allclose(ours.reset(seed=0)[0], theirs.reset(seed=0)[0], atol=1e-6)
    rng = np.random.default_rng(0)
    number_of_ends = np.zeros(2)
    for i in range(30):
        # The first of them never ends by itself, and so is cut after 20 steps.
        actions = np.array([0, rng.integers(4), rng.integers(4)])
        mine = ours.step(actions)
        number_of_ends += mine[2].sum(), mine[3].sum()
        assert_same(mine, theirs.step(actions))
        if i % 9 == 8:
            ours.reset(options={"reset_mask": np.array([False, True, True])})
            theirs.reset(options={"reset_mask": np.array([False, True, True])})
    assert (number_of_ends > 0).all()


@pytest.mark.parametrize(("mode", "later"), [("NextStep", 1), ("SameStep", 0)])
def test_an_ended_episode_starts_again(make, mode, later):
    env = make(num_envs=2, autoreset_mode=mode)
    first, _ = env.reset(seed=1)
    seen, _, ended, _, infos = env.step(np.array([NOP, 0]))
    assert ended.tolist() == [True, False]
    # NOP shows the same map, which the last observation is before a new start.
    last = seen[0] if later else infos["final_obs"][0]
    np.testing.assert_array_equal(last, first[0])
    if later:
        seen, rewards, ended, *_ = env.step(np.array([0, 0]))
        assert rewards[0] == 0
        assert not ended.any()
    assert (seen[0] != first[0]).any()


@pytest.mark.parametrize("kind", [list, np.array])
def test_without_autoreset_only_the_masked_environments_start_again(make, kind):
    env = make(num_envs=3, autoreset_mode="Disabled")
    env.reset(seed=0)
    before, _, terminations, _, _ = env.step(np.array([NOP, 0, NOP]))
    with pytest.raises(ResetNeeded, match=r"\[0 2\] have ended"):
        env.step(np.zeros(3, int))
    after, _ = env.reset(options={"reset_mask": kind(terminations.tolist())})
    assert list((after != before).any(axis=1)) == [True, False, True]
    assert not env.step(np.zeros(3, int))[2].any()


def test_the_mdp_is_an_input_of_the_programs(make):
    mdp = small.small_mdp()
    # The classes swap their detections.
    other = dataclasses.replace(mdp, looks=jax.tree.map(lambda x: x[::-1], mdp.looks))
    seen, programs = [], []
    for each in (mdp, other):
        env = MapVectorEnv(each, LIDAR, 3, make.keywords["starts"])
        env.reset(seed=3)
        seen.append(env.step(np.zeros(3, int))[0])
        programs.append((ours._start._cache_size(), ours._step._cache_size()))
    assert programs[0] == programs[1]
    assert np.any(seen[0] != seen[1])


def test_seeds_repeat_and_differ(make):
    env = make(num_envs=3)

    def play(**reset):
        seen = [env.reset(**reset)[0]]
        seen += [env.step(np.full(3, action))[0] for action in (0, 1, NOP, 2)]
        return np.stack(seen)

    first, again, other, later = play(seed=1), play(seed=1), play(seed=2), play()
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (other[0] != later[0]).any()
    # What it gives is the caller's to change.
    first[0] += 1.0


def test_wrappers_of_gymnasium_take_it(make):
    env = RecordEpisodeStatistics(make(num_envs=3))
    env.reset(seed=0)
    total = env.step(np.array([0, 1, 1]))[1][0]
    *_, infos = env.step(np.array([NOP, 2, 2]))
    assert infos["episode"]["l"][0] == 2
    assert infos["episode"]["r"][0] == pytest.approx(total)


def test_every_task_is_registered():
    for name in jaxsense.registered():
        spec = gymnasium.spec(f"jaxsense/{name}")
        assert spec.kwargs == {"task": name}
        assert json.loads(spec.to_json())["id"] == f"jaxsense/{name}"
    envs = gymnasium.make_vec("jaxsense/map-v0", num_envs=3, agent="lidar", starts=8)
    assert isinstance(envs, MapVectorEnv)


@pytest.mark.parametrize("name", ["map-v0", pytest.param("team-v0", marks=pytest.mark.slow)])
def test_gymnasiums_own_check_passes_without_a_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(f"jaxsense/{name}", render_mode="rgb_array").unwrapped)


@pytest.mark.slow
def test_pictures_show_what_changes():
    envs = gymnasium.make_vec("jaxsense/map-v0", num_envs=2, render_mode="rgb_array")
    assert envs.metadata["render_fps"] == 2
    with pytest.raises(ResetNeeded):
        envs.render()
    envs.reset(seed=3)
    before = envs.render()
    assert [(x.shape, x.dtype) for x in before] == [((400, 800, 3), np.uint8)] * 2
    envs.step(np.array([0, NOP]))  # the second episode ends
    after = envs.render()
    assert all(np.any(x != y) for x, y in zip(before, after, strict=True))
    assert envs._actions == [[0], [NOP]]
    envs.step(np.array([1, 0]))  # and starts anew
    assert envs._actions == [[0, 1], []]
    env = gymnasium.make("jaxsense/map-v0", render_mode="rgb_array")
    env.reset(seed=3)
    assert env.render().shape == (400, 800, 3)
    assert gymnasium.make("jaxsense/map-v0").unwrapped.render() is None


def test_what_cannot_be_is_told(make):
    env = make(num_envs=3)
    with pytest.raises(ResetNeeded, match="before reset"):
        env.step(np.zeros(3, int))
    with pytest.raises(ValueError, match="render_mode = 'ansi': must be one of"):
        ours.TaskEnv("map-v0", render_mode="ansi")
    with pytest.raises(ConfigError, match="agent = 'sonar': must be one of camera, lidar"):
        gymnasium.make("jaxsense/map-v0", agent="sonar")
    with pytest.raises(ValueError, match="modality = 0: must be None with a task"):
        MapVectorEnv(jaxsense.make("map-v0"), 0)

"""The vector environment: the MDP's own functions, and Gymnasium's rules of what follows an end."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small

pytest.importorskip("gymnasium", reason="needs the extra jaxsense[gymnasium]")

import gymnasium
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from jaxsense.dqn import map_mdp, observation
from jaxsense.interfaces import gymnasium as ours
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv

LIDAR, NOP = 1, 3


@pytest.fixture(scope="module")
def starts():
    return prepared_starts(jax.random.key(0), small.small_mdp(), 16)


class OneEnv(gymnasium.Env):
    """A single environment, always from the same start; without noise, as `small.noiseless`."""

    def __init__(self, mdp, start, step):
        self.mdp, self.start, self.mdp_step = mdp, start, step
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (12,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(4)

    def observation(self):
        return np.asarray(observation(self.state.belief))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.start
        return self.observation(), self.info()

    def step(self, action):
        self.state, outcome = self.mdp_step(jax.random.key(0), self.state, jnp.int32(action))
        ends = bool(outcome.terminated), bool(outcome.truncated)
        return self.observation(), float(outcome.reward), *ends, self.info()

    def info(self):
        return {"action_mask": np.ones(4, np.int8)}


def test_every_step_equals_the_mdps(starts):
    """The keys are those that the environment splits from its seed."""
    mdp = small.small_mdp()
    env = MapVectorEnv(mdp, LIDAR, 4, starts, AutoresetMode.DISABLED)
    observations, _ = env.reset(seed=3)
    seed = np.random.Generator(np.random.PCG64(np.random.SeedSequence(3))).integers(2**32)
    key, start_key = jax.random.split(jax.random.key(int(seed)))
    rows = [int(jax.random.randint(k, (), 0, 16)) for k in jax.random.split(start_key, 4)]
    states = jax.tree.map(lambda x: x[np.array(rows)], starts)
    step = jax.jit(jax.vmap(lambda k, s, a: map_mdp.step(k, mdp, s, a, LIDAR)))
    for actions in ([0, 1, 2, 0], [1, 1, 0, 2], [2, 0, NOP, NOP]):
        expected = jax.vmap(observation)(states.belief)
        np.testing.assert_allclose(observations, expected, rtol=1e-6, atol=1e-6)
        observations, rewards, terminations, truncations, _ = env.step(np.array(actions))
        key, step_key = jax.random.split(key)
        states, outcome = step(jax.random.split(step_key, 4), states, jnp.array(actions))
        np.testing.assert_allclose(rewards, outcome.reward, rtol=1e-5)
        np.testing.assert_array_equal(terminations, outcome.terminated)
        np.testing.assert_array_equal(truncations, outcome.truncated)
    assert list(terminations) == [False, False, True, True]


def assert_same(ours, theirs):
    """Results of `step`, and the same keys and masks in the infos."""
    for mine, reference in zip(ours[:4], theirs[:4], strict=True):
        assert (mine.shape, mine.dtype) == (reference.shape, reference.dtype)
        np.testing.assert_allclose(mine, reference, atol=1e-5)
    assert ours[4].keys() == theirs[4].keys()
    for name, value in theirs[4].items():
        if name == "final_obs":
            for mine, reference in zip(ours[4][name], value, strict=True):
                assert (mine is None) == (reference is None)
                if mine is not None:
                    np.testing.assert_allclose(mine, reference, atol=1e-5)
        else:
            jax.tree.map(np.testing.assert_array_equal, ours[4][name], value)


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
        assert_same(mine, theirs.step(actions))
        number_of_ends += mine[2].sum(), mine[3].sum()
        if i % 9 == 8:
            ours.reset(options={"reset_mask": np.array([False, True, True])})
            theirs.reset(options={"reset_mask": np.array([False, True, True])})
    assert (number_of_ends > 0).all()


def test_without_autoreset_only_the_masked_environments_start_again(starts):
    env = MapVectorEnv(small.small_mdp(), LIDAR, 3, starts, "Disabled")
    env.reset(seed=0)
    observations, _, terminations, _, _ = env.step(np.array([NOP, 0, NOP]))
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"\[0 2\] have ended"):
        env.step(np.zeros(3, int))
    after, _ = env.reset(options={"reset_mask": terminations})
    assert (after[1] == observations[1]).all()
    assert (after[[0, 2]] != observations[[0, 2]]).any(axis=1).all()
    assert not env.step(np.zeros(3, int))[2].any()
    with pytest.raises(ValueError, match=r"reset_mask = .*must hold 3 booleans"):
        env.reset(options={"reset_mask": np.ones(2, bool)})
    with pytest.raises(ValueError, match=r"reset_mask = \[1, 0, 1\]: must hold 3 booleans"):
        env.reset(options={"reset_mask": [1, 0, 1]})


def test_the_mdp_is_an_input_of_the_programs(starts):
    mdp = small.small_mdp()
    # The classes swap their detections.
    bank = jax.tree.map(lambda features: features[::-1], mdp.looks)
    seen, programs = [], []
    for each in (mdp, dataclasses.replace(mdp, looks=bank)):
        env = MapVectorEnv(each, LIDAR, 4, starts)
        env.reset(seed=3)
        seen.append(env.step(np.zeros(4, int))[0])
        programs.append((ours._start._cache_size(), ours._step._cache_size()))
    assert programs[0] == programs[1]
    assert np.any(seen[0] != seen[1])


def test_a_mask_may_be_a_list(starts):
    env = MapVectorEnv(small.small_mdp(), LIDAR, 3, starts, "Disabled")
    env.reset(seed=0)
    before = env.step(np.array([NOP, 0, NOP]))[0]
    after, _ = env.reset(options={"reset_mask": [True, False, True]})
    assert list((after != before).any(axis=1)) == [True, False, True]
    assert not env.step(np.zeros(3, int))[2].any()


def test_seeds_repeat_and_differ(starts):
    env = MapVectorEnv(small.small_mdp(), LIDAR, 8, starts)

    def play(**reset):
        seen = [env.reset(**reset)[0]]
        seen += [env.step(np.full(8, action))[0] for action in (0, 1, NOP, 2)]
        return np.stack(seen)

    first, again, other, later = play(seed=1), play(seed=1), play(seed=2), play()
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert (other[0] != later[0]).any()
    assert first.dtype == np.float32
    assert env.observation_space.contains(first[0])
    # What it gives is the caller's to change.
    first[0] += 1.0


def test_wrappers_of_gymnasium_take_it(starts):
    env = RecordEpisodeStatistics(MapVectorEnv(small.small_mdp(), LIDAR, 2, starts))
    env.reset(seed=0)
    total = env.step(np.array([0, 1]))[1][0]
    *_, infos = env.step(np.array([NOP, 2]))
    assert infos["episode"]["l"][0] == 2
    assert infos["episode"]["r"][0] == pytest.approx(total)


def test_what_cannot_be_is_told(starts):
    mdp = small.small_mdp()
    with pytest.raises(ValueError, match="modality = 2: must be a whole number from 0 to 1"):
        MapVectorEnv(mdp, 2, 2)
    with pytest.raises(ValueError, match="autoreset_mode = 'Sometimes': must be one of NextStep, "):
        MapVectorEnv(mdp, 0, 2, autoreset_mode="Sometimes")
    env = MapVectorEnv(mdp, LIDAR, 2, starts)
    with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
        env.step(np.zeros(2, int))
    env.reset(seed=0)
    for actions in (np.array([0, 4]), np.array([-1, 0]), np.zeros(3, int)):
        with pytest.raises(ValueError, match="must be integers in MultiDiscrete"):
            env.step(actions)

"""Gymnasium's own checks, its rules of what follows an end, pictures, and refusals."""

import dataclasses
import functools
import json
import warnings

import jax
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
from jaxsense.interfaces import gymnasium as ours
from jaxsense.interfaces import prepared_starts
from jaxsense.interfaces.gymnasium import MapVectorEnv

LIDAR, NOP = 1, 3


@pytest.fixture(scope="module")
def starts():
    return prepared_starts(jax.random.key(0), small.small_mdp(), 16)


@pytest.fixture
def make(starts):
    return functools.partial(MapVectorEnv, small.small_mdp().of(LIDAR), starts=starts)


def test_starts_of_another_mdp_are_refused(starts):
    other = jax.tree.map(lambda x: x[:, None], starts)
    with pytest.raises(ValueError, match=r"^starts are of another MDP: must be from prepared"):
        MapVectorEnv(small.small_mdp().of(LIDAR), num_envs=2, starts=other).reset(seed=0)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_ends_are_followed_by_starts_as_in_gymnasiums_own(mode):
    theirs = SyncVectorEnv([lambda: ours.TaskEnv("map-v0")] * 3, autoreset_mode=mode)
    mine = ours.make_vec("map-v0", 3, autoreset_mode=mode)
    assert mine.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"]
    for space in ("single_observation_space", "observation_space", "action_space"):
        assert getattr(mine, space) == getattr(theirs, space), space
    (before, _), _ = mine.reset(seed=0), theirs.reset(seed=0)
    rng, number_of_ends, ended = np.random.default_rng(0), np.zeros(2), np.zeros(3, bool)
    for i in range(30):
        # The first of them never ends by itself, and so is cut after 20 steps.
        actions = np.array([0, rng.integers(4), rng.integers(4)])
        (seen, *found, infos), (*expected, of_theirs) = mine.step(actions), theirs.step(actions)
        for x, y in zip([seen, *found], expected, strict=True):
            assert (x.shape, x.dtype) == (y.shape, y.dtype)
        np.testing.assert_array_equal(found[1:], expected[2:])
        assert not found[0][ended].any()  # rewards of those that only start
        last = infos.pop("final_obs", seen)
        at_end = of_theirs.pop("final_obs", seen)
        assert [x is None for x in last] == [x is None for x in at_end]
        jax.tree.map(np.testing.assert_array_equal, infos, of_theirs)
        for row in np.flatnonzero(found[1]):  # NOP shows the same map, and then comes another
            np.testing.assert_array_equal(last[row], before[row])
        for row in np.flatnonzero(found[1] if last is not seen else ended):
            assert (seen[row] != before[row]).any()
        number_of_ends += [x.sum() for x in found[1:]]
        before, ended = seen, np.any(found[1:], axis=0) & (last is seen)
        if i % 9 == 8:
            mask = np.array([False, True, True])
            before, _ = mine.reset(options={"reset_mask": mask})
            theirs.reset(options={"reset_mask": mask})
            ended &= ~mask
    assert (number_of_ends > 0).all()


@pytest.mark.parametrize("kind", [list, np.array])
def test_without_autoreset_only_the_masked_environments_start_again(make, kind):
    env = make(num_envs=3, autoreset_mode="Disabled")
    with pytest.raises(ResetNeeded, match="before reset"):
        env.step(np.zeros(3, int))
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
        env = MapVectorEnv(each.of(LIDAR), num_envs=3, starts=make.keywords["starts"])
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
    assert [(x.shape, x.dtype) for x in before] == [((400, 400, 3), np.uint8)] * 2
    envs.step(np.array([0, NOP]))  # the second episode ends
    after = envs.render()
    assert all(np.any(x != y) for x, y in zip(before, after, strict=True))
    env = gymnasium.make("jaxsense/map-v0", render_mode="rgb_array")
    env.reset(seed=3)
    assert env.render().shape == (400, 400, 3)
    assert gymnasium.make("jaxsense/map-v0").unwrapped.render() is None

"""What a mission starts with, and where robots stand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import mission, sim
from jaxsense.config import Config
from jaxsense.config.scene import ArenaConfig
from jaxsense.core.types import Belief
from jaxsense.mission import begin, roadmap

# So narrow that from some places there is no way out.
CONFIG = Config(arena=ArenaConfig(num_pois=16, poi_gap=0.1))
KEEP = 0.241421  # m, a cube's corner from its middle and a robot in planning
REACH = 1.4  # m, half the arena's side less the robot


@pytest.fixture(scope="module")
def started():
    """Of 64 arenas: candidates `[2, 32, 3]`, the room at them, whether ways lead on, and poses."""

    def start(key):
        layout_key, pose_key = jax.random.split(key)
        layout = sim.random_layout(layout_key, CONFIG.arena, jnp.arange(16) % 3)
        ways = roadmap.build(CONFIG, layout)
        draws = jax.random.uniform(pose_key, (2, 3, 32), minval=-1.0)
        candidates = jnp.swapaxes(draws, 1, 2) * jnp.array([[[REACH, REACH, jnp.pi]]])

        def look(pose):
            def reached(poi):
                return jnp.isfinite(ways.lengths(pose[:2], poi).min())

            to_pois = jnp.linalg.norm(layout.position - pose[None, :2], axis=-1)
            return jnp.min(to_pois) - KEEP, jnp.all(jax.vmap(reached)(jnp.arange(16)))

        room, has_ways = jax.vmap(jax.vmap(look))(candidates)
        return candidates, room, has_ways, begin._random_poses(pose_key, CONFIG, layout, ways)

    return jax.tree.map(np.array, jax.jit(jax.vmap(start))(jax.random.split(jax.random.key(0), 64)))


def test_robots_start_at_the_first_places_with_room_and_ways_to_all_pois(started):
    number = only_cut_off = only_too_close = latest = cut_off = 0
    for candidates, room, has_ways, poses in zip(*started, strict=True):
        taken = np.full((1, 2), 9.0)
        for robot in range(2):
            apart = np.linalg.norm(candidates[robot, :, None, :2] - taken[None], axis=-1)
            is_apart, has_room = apart.min(axis=-1) > 0.3, room[robot] > 0
            is_right = has_room & has_ways[robot] & is_apart
            if not is_right.any():  # in an arena where no PoI has ways to all others
                most = np.where(has_ways[robot], room[robot], room[robot] - 3.0)
                best = np.argmax(np.minimum(most, apart.min(axis=-1) - 0.3))
                np.testing.assert_allclose(poses[robot], candidates[robot, best], atol=1e-6)
                cut_off += 1
                break
            first = np.argmax(is_right)
            np.testing.assert_allclose(poses[robot], candidates[robot, first], atol=1e-6)
            taken = np.append(taken, poses[robot][None, :2], axis=0)
            number, latest = number + 1, max(latest, first)
            only_cut_off += np.any((has_room & is_apart & ~has_ways[robot])[:first])
            only_too_close += np.any((has_room & has_ways[robot] & ~is_apart)[:first])
    assert number > 120
    assert latest >= 8
    # All conditions matter.
    assert only_cut_off > 0
    assert only_too_close > 0
    assert cut_off > 0


def test_the_map_starts_from_the_prior_of_the_fusion(team, models):
    prior = Belief(jnp.array([0.5, -1.0]), jnp.array([2.0, 3.0]))
    other = replace(models, fusion=replace(models.fusion, prior=prior))
    begin = jax.jit(lambda key, models: mission.reset(key, team, models).belief)
    for each, mean, std in ((models, [0, 0], [20**0.5] * 2), (other, [0.5, -1.0], [2.0, 3.0])):
        belief = begin(jax.random.key(0), each)
        np.testing.assert_allclose(belief.mean, [mean] * 3)
        np.testing.assert_allclose(belief.std, [std] * 3, rtol=1e-6)


@pytest.mark.parametrize("preset", ["smoke", "team"])
def test_a_mission_begins_without_weak_types(preset):
    # JAX would compile a second program after a step.
    config, key = jaxsense.PRESETS[preset], jax.random.key(0)
    given = mission.make_mission(config), jaxsense.init(key, config)
    state = jax.eval_shape(lambda: mission.reset(key, *given))
    leaves = jax.tree_util.tree_leaves_with_path(state)
    assert not [jax.tree_util.keystr(path) for path, leaf in leaves if leaf.weak_type]

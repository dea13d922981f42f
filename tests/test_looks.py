"""The two ways of looking, that they see the same, and the MDPs of them."""

import collections
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from exact_filter import exact_filter
from untrained import blank, untrained

import jaxsense
from jaxsense import looks
from jaxsense.config import PRESETS, JmvaeConfig
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts
from jaxsense.looks import Bank, Live
from jaxsense.sim import world as worlds
from jaxsense.vae import jmvae
from jaxsense.vae.jmvae import Jmvae

CONFIG = replace(PRESETS["smoke"], jmvae=JmvaeConfig(hidden=(8,)))
MODEL = Jmvae(CONFIG.modalities, (2, 2), 2, (8,))
NUM_LOOKS = 1024


@pytest.fixture(scope="module")
def models():
    return untrained(CONFIG)


def numbered_bank():
    """Detections that tell where they come from: (class + row / 10, modality)."""
    place = np.arange(3)[:, None] + np.arange(5) / 10
    stacked = (np.stack([place, np.full_like(place, m)], axis=-1) for m in range(2))
    return tuple(jnp.asarray(x, jnp.float32) for x in stacked)


@pytest.mark.parametrize("modality", [0, 1])
def test_bank_draws_every_detection_of_the_true_class_and_no_other(modality):
    bank, classes = Bank(numbered_bank()), jnp.array([2, 0, 1])
    scene = bank.scene(jax.random.key(0), classes)
    keys = jax.random.split(jax.random.key(1), 200)
    look = jax.jit(
        jax.vmap(lambda key, poi: bank.observe(key, scene, poi, modality)[0], in_axes=(0, None))
    )
    for poi in range(3):
        features = look(keys, np.int32(poi))
        expected = [int(classes[poi]) + row / 10 for row in range(5)]
        np.testing.assert_allclose(np.unique(features[:, 0]), expected, rtol=1e-6)
        np.testing.assert_array_equal(features[:, 1], modality)


def test_a_bank_by_distance_draws_looks_from_about_as_far():
    far = jnp.tile(jax.random.permutation(jax.random.key(0), jnp.arange(1.0, 33.0)), (3, 1))
    bank, classes = looks.by_distance((jnp.stack([far, 0 * far], -1),), (far,)), jnp.array([1])
    draw = lambda key, far: bank.observe(key, classes, jnp.int32(0), 0, far)[0][0]  # noqa: E731
    look = jax.jit(jax.vmap(draw, (0, None)))
    keys = jax.random.split(jax.random.key(1), 500)
    drawn = [{*np.asarray(look(keys, far)).tolist()} for far in (10.5, 0.5, 99.0, 0.0)]
    assert drawn == [{10, 11}, {1, 2}, {31, 32}, {*range(1, 33)}]


def test_an_mdp_updates_beliefs_by_the_jmvae(models):
    mdp = looks.make_mdp(CONFIG, models, Bank(numbered_bank()))
    assert (mdp.num_pois, mdp.num_classes, mdp.num_modalities, mdp.robots) == (3, 3, 2, (0,))
    seen = jnp.array([[0, 0], [0, 1], [1, 0]], bool)
    reset = jax.jit(starts.reset)
    state = reset(jax.random.key(1), mdp, jnp.array([2, 0, 1]), seen)
    np.testing.assert_allclose(state.belief.std[0], np.sqrt(20.0), rtol=1e-6)
    # PoI 1 is of class 0 and was seen by the LiDAR: one of five beliefs.
    encode = jax.jit(jax.vmap(lambda x: jmvae.encode(models.jmvae, MODEL, (None, x))[0]))
    distances = np.abs(np.asarray(encode(numbered_bank()[1][0])) - np.asarray(state.belief.mean[1]))
    assert np.min(np.max(distances, axis=1)) < 1e-5


def test_an_mdp_is_an_argument_of_jit(models):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def gain(mdp, state):
        after, outcome = mdps.step(jax.random.key(1), mdp.of(jnp.int32(0)), state, jnp.int32(0))
        return after.belief, outcome.reward

    features = tuple(
        jnp.asarray(np.broadcast_to([p, 1 - p], (3, 4, 2)), jnp.float32) for p in (0.5, 0.51)
    )
    found, reset = [], jax.jit(starts.reset)
    posterior = jax.jit(jmvae.posterior, static_argnums=1)
    for number in range(2):
        jmvae_of = jax.tree.map(lambda x, n=number: (1 + n) * x, models.jmvae)
        other = replace(models, jmvae=jmvae_of, fusion=replace(models.fusion, params=jmvae_of))
        mdp = looks.make_mdp(CONFIG, other, Bank(features))
        state = reset(jax.random.key(0), mdp, jnp.array([0, 1, 2]), np.zeros((3, 2), bool))
        belief, _ = gain(mdp, state)
        expected = posterior(other.jmvae, MODEL, (features[0][0, 0], None))
        np.testing.assert_allclose(belief.mean[0], expected.mean, rtol=1e-5)
        found.append(belief.mean[0])
    assert np.all(found[0] != found[1])


def test_an_agent_of_a_team_has_the_mdp_of_a_team():
    config = replace(CONFIG, dqn=replace(CONFIG.dqn, task="team", hidden=(4,)))
    mdp = looks.make_mdp(config, blank(config), Bank(numbered_bank()))
    assert mdp.num_pois == config.team.num_pois[1]
    assert mdp.robots.tolist() == [0, 0, 1, 1]
    places = mdp.teams.places
    assert (places.config, places.poi_pitch) == (config.team, config.arena.poi_pitch)
    # Nothing else of them is an input of a compiled program.
    assert jax.tree.leaves(places) == jax.tree.leaves(config.team)
    assert mdp.teams.config is config.team


def test_the_reward_in_nats_is_the_fall_of_the_maps_entropy_minus_the_cost(models):
    config = replace(
        CONFIG,
        jmvae=replace(CONFIG.jmvae, fusion="filter"),
        mdp=replace(CONFIG.mdp, reward="nats", look_cost=0.0625),
    )
    seen = (jnp.broadcast_to(jnp.array([0.8, 0.2]), (3, 1, 2)),) * 2
    mdp = looks.make_mdp(config, replace(models, fusion=exact_filter()), Bank(seen))
    state = jax.jit(starts.reset)(
        jax.random.key(0), mdp, np.array([1, 1, 1]), np.zeros((3, 2), bool)
    )

    @jax.jit
    def look(mdp, state, modality):
        return mdps.step(jax.random.key(0), mdp.of(modality), state, jnp.int32(1))

    # Red by .8: .2 to .8 to .8. Then a cylinder by .8: .16 to .64 to .16.
    one, two = np.array([1, 4, 4]) / 9, np.array([1, 4, 1]) / 6
    entropies = [np.log(3), *(-np.sum(w * np.log(w)) for w in (one, two))]
    for modality, before, after in ((0, *entropies[:2]), (1, *entropies[1:])):
        state, outcome = look(mdp, state, jnp.int32(modality))
        assert outcome.reward == pytest.approx(before - after - 0.0625, abs=1e-4)


def test_repeated_looks_are_at_one_poi_from_one_place_or_near_it(monkeypatch):
    Scene = collections.namedtuple("Scene", ["poses", "classes"])

    def look(key, world, scene, modality, poi, farthest=None):
        """Where the robot stands after it: at 5 m, or as far from there as it may."""
        place = jnp.float32(5) if farthest is None else scene.poses[modality, 0] + farthest
        seen = jnp.stack([place, scene.classes[poi]]), 2.0 * place
        return seen, scene._replace(poses=scene.poses.at[modality, 0].set(place))

    start = lambda key, world, classes, places: Scene(jnp.zeros((2, 3)), classes)  # noqa: E731
    monkeypatch.setattr(worlds, "random_scene", start)
    monkeypatch.setattr(worlds, "look", look)
    keys, classes = jax.random.split(jax.random.key(0), 400), jnp.tile(jnp.arange(3.0), (400, 1))
    seen, distances, places = looks.repeats(keys, None, classes, 1, 4)
    assert (seen.shape, distances.shape, places.shape) == ((400, 4, 2), (400, 4), (400, 4, 2))
    first, *others = np.moveaxis(np.asarray(places[..., 0]), 1, 0)
    np.testing.assert_array_equal(first, 5.0)
    for other in others:
        np.testing.assert_array_equal(other, others[0])
    assert set(others[0]) == {5.0, 6.0}
    assert np.mean(others[0] == 6.0) == pytest.approx(0.5, abs=0.1)
    np.testing.assert_array_equal(distances, 2 * places[..., 0])
    np.testing.assert_array_equal(seen[..., 1], 0.0)  # the first PoI's class


@pytest.mark.slow
@pytest.mark.parametrize("modality", [0, 1])
def test_live_and_bank_features_have_the_same_distribution(modality):
    config, models = jaxsense.load_pretrained("noisy")
    live = Live(worlds.make_world(config), models.detectors)

    def look_thrice(key):
        """The class and the features of the last look of an episode."""
        class_key, poi_key, scene_key, look_key = jax.random.split(key, 4)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        pois = jax.random.randint(poi_key, (3,), 0, 3)

        def look(scene, inputs):
            key, poi = inputs
            seen, scene = live.observe(key, scene, poi, modality)
            return scene, (classes[poi], seen)

        scene = live.scene(scene_key, classes)
        _, seen = jax.lax.scan(look, scene, (jax.random.split(look_key, 3), pois))
        return jax.tree.map(lambda x: x[-1], seen)

    keys = jax.random.split(jax.random.key(3), NUM_LOOKS)
    classes, found = jax.tree.map(np.asarray, jax.jit(jax.vmap(look_thrice))(keys))
    bank = np.asarray(jaxsense.detections(jax.random.key(0), config, models, NUM_LOOKS)[modality])
    for c in range(3):
        assert scipy.stats.ks_2samp(found[classes == c, 0], bank[c, :, 0]).pvalue > 1e-3


def test_missions_beyond_those_that_a_team_learns_for_are_told():
    team = PRESETS["team"]
    beyond = replace(team.arena, num_pois=9, side=6.5)
    assert looks.beyond_training(replace(team, arena=beyond, robots=("camera",) * 3)) == [
        "9 PoIs: the Q-network learns with 3 to 8",
        "an arena of 6.5 m: the Q-network learns with 3 to 6",
        "3 robots with camera: the Q-network learns with 1 to 2",
        "0 robots with lidar: the Q-network learns with 1 to 2",
    ]
    assert not any(looks.beyond_training(PRESETS[name]) for name in ("team", "paper", "smoke"))

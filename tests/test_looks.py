"""The two ways of looking, that they see the same, and the MDPs of them."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import looks
from jaxsense.config import PRESETS, JmvaeConfig
from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core import supervised
from jaxsense.core.types import Belief
from jaxsense.dqn import map_mdp, rewards
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.looks import Bank, Live
from jaxsense.sim import world as worlds
from jaxsense.vae import detectors, fusion, jmvae
from jaxsense.vae.jmvae import Jmvae

CONFIG = replace(PRESETS["smoke"], jmvae=JmvaeConfig(hidden=(8,)))
MODEL = Jmvae(CONFIG.modalities, (2, 2), 2, (8,))
NUM_LOOKS = 1024
PARTS = slice(500), slice(500, None)


@pytest.fixture(scope="module")
def models():
    return jaxsense.init(jax.random.key(0), CONFIG)


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


def test_an_mdp_updates_beliefs_by_the_jmvae(models):
    mdp = looks.make_mdp(CONFIG, models, Bank(numbered_bank()))
    assert (mdp.num_pois, mdp.num_classes, mdp.num_modalities) == (3, 3, 2)
    seen = jnp.array([[0, 0], [0, 1], [1, 0]], bool)
    reset = jax.jit(map_mdp.reset)
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
        after, outcome = map_mdp.step(jax.random.key(1), mdp, state, jnp.int32(0), jnp.int32(0))
        return after.belief, outcome.reward

    features = tuple(
        jnp.asarray(np.broadcast_to([p, 1 - p], (3, 4, 2)), jnp.float32) for p in (0.5, 0.51)
    )
    found, reset = [], jax.jit(map_mdp.reset)
    posterior = jax.jit(jmvae.posterior, static_argnums=1)
    for number in range(2):
        other = jaxsense.init(jax.random.key(number), CONFIG)
        mdp = looks.make_mdp(CONFIG, other, Bank(features))
        state = reset(jax.random.key(0), mdp, jnp.array([0, 1, 2]), np.zeros((3, 2), bool))
        belief, _ = gain(mdp, state)
        expected = posterior(other.jmvae, MODEL, (features[0][0, 0], None))
        np.testing.assert_allclose(belief.mean[0], expected.mean, rtol=1e-5)
        found.append(belief.mean[0])
    assert np.all(found[0] != found[1])


def test_an_agent_of_a_team_has_the_mdp_of_a_team():
    config = replace(CONFIG, dqn=replace(CONFIG.dqn, task="team", hidden=(4,)))
    mdp = looks.make_mdp(config, jaxsense.init(jax.random.key(0), config), Bank(numbered_bank()))
    assert isinstance(mdp, TeamMdp)
    assert mdp.map.num_pois == config.team.num_pois[1]
    assert mdp.places.poi_pitch == config.arena.poi_pitch
    assert mdp.places.robot_radius == PLANNING_RADIUS
    # Nothing else of them is an input of a compiled program.
    assert jax.tree.leaves(mdp.places) == [*config.team.sides, PLANNING_RADIUS]
    assert mdp.config is config.team


def test_entropy_by_hand():
    # (ln 2) / 2 + 2 (ln 4) / 4; a class without weight counts nothing.
    weights = jnp.array([[0.5, 0.25, 0.25], [0.0, 0.5, 0.5], [0.0, 1.0, 0.0]])
    expected = [1.5 * np.log(2), np.log(2), 0.0]
    np.testing.assert_allclose(rewards.entropy(weights), expected, atol=1e-6)


def test_the_reward_in_nats_is_the_fall_of_the_maps_entropy_minus_the_cost(models):
    # Green is class 0, red the others. The filter adds the logarithm of the label's probability.
    classes = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
    prior = fusion.prior(MODEL, 20.0)
    found = jax.jit(lambda key: fusion.init_filter(key, MODEL, classes, prior, (1,)))(
        jax.random.key(0)
    )
    of_moments = np.linalg.pinv(found.readout.of_classes)
    kernel = jnp.float32(np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]]) @ of_moments.T)
    layer = {"kernel": kernel, "bias": jnp.zeros(len(of_moments))}
    of_each = {m: {"params": {"Dense_0": layer}} for m in MODEL.modalities}
    found = replace(found, networks=of_each, hidden=())
    config = replace(
        CONFIG,
        jmvae=replace(CONFIG.jmvae, fusion="filter"),
        mdp=replace(CONFIG.mdp, reward="nats", look_cost=0.0625),
    )
    looks_red = (jnp.broadcast_to(jnp.array([0.8, 0.2]), (3, 1, 2)),) * 2
    mdp = looks.make_mdp(config, replace(models, fusion=found), Bank(looks_red))
    state = jax.jit(map_mdp.reset)(
        jax.random.key(0), mdp, np.array([1, 1, 1]), np.zeros((3, 2), bool)
    )

    @jax.jit
    def look(mdp, state, modality):
        return map_mdp.step(jax.random.key(0), mdp, state, jnp.int32(1), modality)

    # .2 to .8 to .8 after one look, and .04 to .64 to .64 after two.
    one, two = np.array([1, 4, 4]) / 9, np.array([1, 16, 16]) / 33
    entropies = [np.log(3), *(-np.sum(w * np.log(w)) for w in (one, two))]
    for modality, before, after in ((0, *entropies[:2]), (1, *entropies[1:])):
        state, outcome = look(mdp, state, jnp.int32(modality))
        assert outcome.reward == pytest.approx(before - after - 0.0625, abs=1e-4)


@pytest.fixture(scope="module")
def world():
    return worlds.make_world(CONFIG)


@pytest.fixture(scope="module")
def trained(world):
    """For each modality a detector of a short training, its training windows and new ones."""
    number = 500 + NUM_LOOKS

    def survey(key):
        class_key, survey_key = jax.random.split(key)
        classes = looks.balanced_classes(class_key, CONFIG, number)
        keys = jax.random.split(survey_key, number)
        return classes, *looks.surveys(keys, world, classes)[1:]

    classes, surveyed, distances = jax.jit(survey)(jax.random.key(0))
    config, found = replace(CONFIG.detector, steps=200), []
    for m, name in enumerate(CONFIG.modalities):
        given = detectors.Looks(surveyed[m], distances[:, m])
        by_class = jax.tree.map(lambda x: jnp.stack([x[classes == c] for c in range(3)]), given)
        windows, new = (jax.tree.map(lambda x: x[:, part], by_class) for part in PARTS)  # noqa: B023
        flat = jax.tree.map(lambda x: x.reshape(1500, *x.shape[2:]), windows)
        labels = jnp.array(CONFIG.label_of_class(name))
        detector = detectors.init(jax.random.key(1), flat.windows, 2, config)
        nothing = replace(flat, windows=jnp.zeros_like(flat.windows))
        labels = jnp.repeat(labels, 500)
        problem = detectors.Fitting(config, detector, flat, labels, nothing)
        start = supervised.start(detector.params, config)
        fit = jax.jit(lambda key, state: supervised.fit(key, state, problem, 200))  # noqa: B023
        state, _ = fit(jax.random.key(2), start)
        found.append((replace(detector, params=state.params), windows.windows, new))
    return found


@pytest.fixture(scope="module")
def look_live(trained, world):
    """A modality's live features of `[S]` looks, and their classes."""
    live = Live(world, tuple(found[0] for found in trained))

    def look_thrice(key, modality):
        class_key, poi_key, scene_key, look_key = jax.random.split(key, 4)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        pois = jax.random.randint(poi_key, (3,), 0, 3)

        def look(scene, inputs):
            key, poi = inputs
            seen, scene = live.observe(key, scene, poi, modality)
            return scene, (classes[poi], seen)

        scene = live.scene(scene_key, classes)
        _, seen = jax.lax.scan(look, scene, (jax.random.split(look_key, 3), pois))
        return jax.tree.map(lambda x: x[-1], seen)  # the last look of an episode

    keys = jax.random.split(jax.random.key(3), NUM_LOOKS)
    return lambda modality: jax.jit(jax.vmap(lambda key: look_thrice(key, modality)))(keys)


@pytest.fixture(scope="module", params=[0, 1], ids=CONFIG.modalities)
def windows_of(request, trained):
    """A modality, its detector, the detector's training windows and new ones."""
    return request.param, *trained[request.param]


@pytest.fixture(scope="module")
def features(windows_of, look_live):
    """A modality, and features `[C, S, 2]` from the bank and, live, with their `[S]` classes."""
    modality, detector, _, new = windows_of
    bank = jax.jit(jax.vmap(jax.vmap(detectors.features, (None, 0, 0)), (None, 0, 0)))
    found = np.asarray(bank(detector, new.windows, new.distances))
    return modality, found, jax.tree.map(np.asarray, look_live(modality))


@pytest.mark.slow
def test_a_short_training_tells_most_looks_apart(features):
    modality, bank, (classes, live) = features
    labels = np.array(CONFIG.label_of_class(CONFIG.modalities[modality]))
    of_bank = np.mean(bank.argmax(axis=-1) == labels[:, None])
    of_live = np.mean(live.argmax(axis=-1) == labels[classes])
    assert of_bank > 0.9
    # Four standard errors of a share at worst .9, of 3 x 1024 and of 1024 looks.
    error = np.sqrt(0.9 * 0.1 * (1 / bank[..., 0].size + 1 / len(live)))
    np.testing.assert_allclose(of_live, of_bank, atol=4 * error)


@pytest.mark.slow
def test_live_and_bank_features_have_the_same_distribution(features):
    _, bank, (classes, live) = features
    for c in range(3):
        here, there = live[classes == c, 0], bank[c, :, 0]
        # Kolmogorov-Smirnov: the largest gap of the distribution functions; 1.95 is p = .001.
        values = np.concatenate([here, there])
        gaps = [np.searchsorted(np.sort(x), values, side="right") / len(x) for x in (here, there)]
        scale = np.sqrt(1 / len(here) + 1 / len(there))
        assert np.max(np.abs(gaps[0] - gaps[1])) < 1.95 * scale
        # And the means, within four standard errors.
        spread = np.std(values) + 1e-6
        np.testing.assert_allclose(here.mean(), there.mean(), atol=4 * spread * scale)

"""The two ways of looking, and that they see the same."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import observe
from jaxsense.config import MODALITIES, PRESETS, FilterConfig
from jaxsense.core.types import Belief
from jaxsense.dqn import belief_mdp
from jaxsense.sim import world as worlds
from jaxsense.vae import detectors, filtering, fusion, jmvae
from jaxsense.vae.jmvae import Jmvae

CONFIG = PRESETS["smoke"]
MODEL = Jmvae(CONFIG.modalities, (2, 2), 2, (8,))
NUM_LOOKS = 1024


def numbered_bank():
    """Detections that tell where they come from: (class + row / 10, modality)."""
    classes, rows = jnp.meshgrid(jnp.arange(3.0), jnp.arange(5.0), indexing="ij")
    place = classes + rows / 10
    return tuple(jnp.stack([place, jnp.full_like(place, m)], axis=-1) for m in range(2))


@pytest.mark.parametrize("modality", [0, 1])
def test_bank_draws_every_detection_of_the_true_class_and_no_other(modality):
    mdp = observe.bank_mdp(CONFIG, numbered_bank(), {}, MODEL)
    classes = jnp.array([2, 0, 1])
    scene = mdp.new_scene(jax.random.key(0), classes)
    keys = jax.random.split(jax.random.key(1), 200)
    for poi in range(3):
        look = jax.vmap(lambda key: mdp.observe(key, scene, jnp.int32(poi), modality)[0])  # noqa: B023
        features = look(keys)
        expected = [int(classes[poi]) + row / 10 for row in range(5)]
        np.testing.assert_allclose(np.unique(features[:, 0]), expected, rtol=1e-6)
        np.testing.assert_array_equal(features[:, 1], modality)


def test_bank_mdp_writes_by_the_jmvae():
    params = jmvae.init(jax.random.key(0), MODEL)
    mdp = observe.bank_mdp(CONFIG, numbered_bank(), params, MODEL)
    assert (mdp.num_pois, mdp.num_classes, mdp.num_modalities) == (3, 3, 2)
    seen = jnp.array([[0, 0], [0, 1], [1, 0]], bool)
    reset = jax.jit(lambda key, *start: belief_mdp.reset(key, mdp, *start))
    state = reset(jax.random.key(1), jnp.array([2, 0, 1]), seen)
    np.testing.assert_allclose(state.belief.std[0], np.sqrt(20.0), rtol=1e-6)
    # PoI 1 is of class 0 and was seen by the LiDAR: one of five entries.
    encode = jax.vmap(lambda x: jmvae.encode(params, MODEL, (None, x))[0])
    distances = np.abs(np.asarray(encode(numbered_bank()[1][0])) - state.belief.mean[1][None])
    assert np.min(np.max(distances, axis=1)) < 1e-5


def test_the_reward_in_nats_is_the_fall_of_entropy_of_the_map_less_the_cost():
    # Green is class 0, red the others. The filter adds the logarithm of the label's probability.
    classes = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
    inputs = classes, fusion.unseen(MODEL, 20.0), FilterConfig(hidden=(1,))
    params = jax.jit(lambda key: filtering.init(key, MODEL, *inputs))(jax.random.key(0))
    layer = {"kernel": jnp.array([[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]]), "bias": jnp.zeros(3)}
    params["networks"] = {m: {"params": {"Dense_0": layer}} for m in MODEL.modalities}
    config = replace(
        CONFIG,
        jmvae=replace(CONFIG.jmvae, fusion="filter"),
        mdp=replace(CONFIG.mdp, reward="nats", look_cost=0.0625),
    )
    looks_red = (jnp.broadcast_to(jnp.array([0.8, 0.2]), (3, 1, 2)),) * 2
    mdp = observe.bank_mdp(config, looks_red, {"filter": params}, MODEL)
    reset = jax.jit(lambda key, *start: belief_mdp.reset(key, mdp, *start))
    state = reset(jax.random.key(0), np.array([1, 1, 1]), np.zeros((3, 2), bool))

    @jax.jit
    def look(state, modality):
        return belief_mdp.step(jax.random.key(0), mdp, state, jnp.int32(1), modality)

    # .2 to .8 to .8 after one look, and .04 to .64 to .64 after two.
    one, two = np.array([1, 4, 4]) / 9, np.array([1, 16, 16]) / 33
    entropies = [np.log(3), *(-np.sum(w * np.log(w)) for w in (one, two))]
    for modality, before, after in ((0, *entropies[:2]), (1, *entropies[1:])):
        state, outcome = look(state, jnp.int32(modality))
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
        classes = observe.balanced_classes(class_key, CONFIG, number)
        keys = jax.random.split(survey_key, number)
        return classes, observe.surveys(keys, world, classes)[1]

    classes, surveyed = jax.jit(survey)(jax.random.key(0))
    train = jax.jit(detectors.train, static_argnames=("config", "steps"))
    config, found = CONFIG.detector, []
    for name, of_sensor in zip(CONFIG.modalities, surveyed, strict=True):
        by_class = jnp.stack([of_sensor[classes == c] for c in range(3)])
        windows, new = jnp.split(by_class, [500], axis=1)
        flat = windows.reshape(-1, windows.shape[-1])
        labels = jnp.array(CONFIG.arena.label_of_class(MODALITIES[name]))
        detector = detectors.init(jax.random.key(1), flat, 2, config)
        inputs = detectors.start(detector, config), detector, flat, jnp.repeat(labels, 500)
        state, _ = train(jax.random.key(2), *inputs, config=config, steps=200)
        found.append((replace(detector, params=state.params), windows, new))
    return found


@pytest.fixture(scope="module")
def look_live(trained, world):
    """A modality's live features of `[S]` looks, and their classes."""
    mdp = observe.live_mdp(CONFIG, world, tuple(found[0] for found in trained), {}, MODEL)

    def look_thrice(key, modality):
        class_key, poi_key, scene_key, look_key = jax.random.split(key, 4)
        classes = jax.random.randint(class_key, (3,), 0, 3)
        pois = jax.random.randint(poi_key, (3,), 0, 3)

        def look(scene, inputs):
            key, poi = inputs
            seen, scene = mdp.observe(key, scene, poi, modality)
            return scene, (classes[poi], seen)

        scene = mdp.new_scene(scene_key, classes)
        _, seen = jax.lax.scan(look, scene, (jax.random.split(look_key, 3), pois))
        return jax.tree.map(lambda x: x[-1], seen)  # the last look of an episode

    keys = jax.random.split(jax.random.key(3), NUM_LOOKS)
    return lambda modality: jax.jit(jax.vmap(lambda key: look_thrice(key, modality)))(keys)


@pytest.fixture(scope="module", params=[0, 1], ids=CONFIG.modalities)
def looks(request, trained):
    """A modality, its detector, the detector's training windows and new ones."""
    return request.param, *trained[request.param]


@pytest.fixture(scope="module")
def features(looks, look_live):
    """A modality, and features `[C, S, 2]` from the bank and, live, with their `[S]` classes."""
    modality, detector, _, new = looks
    bank = jax.jit(jax.vmap(jax.vmap(detectors.detect, in_axes=(None, 0)), in_axes=(None, 0)))
    return modality, np.asarray(bank(detector, new)), jax.tree.map(np.asarray, look_live(modality))


def test_surveys_look_at_pois_of_the_classes_that_they_tell(looks):
    modality, _, windows, _ = looks
    sensor = (CONFIG.camera, CONFIG.lidar)[modality]
    values = 3 if modality == 0 else 1  # red, green and blue
    assert windows.shape == (3, 500, sensor.window * values)
    middle = windows.reshape(3, 500, sensor.window, values)[:, :, sensor.window // 2]
    if modality == 0:
        # Green cylinder, red cylinder, red cube: the PoI is in the middle of its window.
        is_green = np.asarray(middle[..., 1] > middle[..., 0])
        assert np.all(is_green.mean(axis=1)[1:] < 0.02)
        assert is_green.mean(axis=1)[0] > 0.98
    else:
        # A PoI's surface is .07 to .14 m nearer than its centre, which is .3 to 1.2 m away.
        assert np.mean((middle > 0.1) & (middle < 1.2)) > 0.98


def test_looks_are_all_different(looks):
    windows = np.asarray(looks[2])
    assert len(np.unique(windows.reshape(1500, -1), axis=0)) == 1500


def test_a_short_training_tells_most_looks_apart(features):
    modality, bank, (classes, live) = features
    labels = np.array(CONFIG.arena.label_of_class(MODALITIES[CONFIG.modalities[modality]]))
    of_bank = np.mean(bank.argmax(axis=-1) == labels[:, None])
    of_live = np.mean(live.argmax(axis=-1) == labels[classes])
    assert of_bank > 0.9
    # Four standard errors of a share at worst .9, of 3 x 1024 and of 1024 looks.
    error = np.sqrt(0.9 * 0.1 * (1 / bank[..., 0].size + 1 / len(live)))
    np.testing.assert_allclose(of_live, of_bank, atol=4 * error)


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

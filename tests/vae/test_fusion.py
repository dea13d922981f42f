"""Fusion in place: which encoder is asked, and with what; and what every kind of fusion has."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import JmvaeConfig
from jaxsense.core.types import Belief
from jaxsense.vae import fusion, jmvae, readout
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=2, hidden=(8,))
OLD = Belief(jnp.array([0.4, -0.7]), jnp.array([0.9, 1.1]))


init = jax.jit(jmvae.init, static_argnums=1)
encode = jax.jit(jmvae.encode, static_argnums=1)
decode = jax.jit(jmvae.decode, static_argnums=1)
update = jax.jit(fusion.InPlace.update, static_argnames="modality")


def in_place(model, params, classes=None):
    """Fusion in place; classes do not matter to an update."""
    shape = 3, model.latent_size
    classes = Belief(jnp.zeros(shape), jnp.ones(shape)) if classes is None else classes
    prior = fusion.prior(model, 20.0)
    return fusion.InPlace(classes, prior, readout.make(classes), model, params)


def look(model, modality, seed=0):
    return jax.nn.softmax(jax.random.normal(jax.random.key(seed), (model.feature_sizes[modality],)))


def assert_same(belief, mean_and_log_var):
    mean, log_var = mean_and_log_var
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(belief.std, np.exp(log_var / 2), rtol=1e-5)


def test_every_update_encodes_the_look_with_what_the_map_says_of_the_others():
    model, params = THREE, init(jax.random.key(0), THREE)
    number = len(model.modalities)
    generated = decode(params, model, OLD.mean)
    for modality in range(number):
        new = look(model, modality)
        for seen in itertools.product([False, True], repeat=number):
            found = in_place(model, params)
            belief = update(found, OLD, jnp.array(seen), new, modality=modality)
            inputs = [g if s else None for g, s in zip(generated, seen, strict=True)]
            inputs[modality] = new  # never generated, whether it has been seen before or not
            assert_same(belief, encode(params, model, tuple(inputs)))


def test_several_sensors_may_look_at_once():
    # What has looked before and does not look now is decoded; all the others are as they are.
    params = init(jax.random.key(0), THREE)
    camera, sonar = look(THREE, 0), look(THREE, 2)
    generated = decode(params, THREE, OLD.mean)
    for has_lidar in (False, True):
        belief = fusion.fuse(
            params, THREE, OLD, np.array([True, has_lidar, False]), (camera, None, sonar)
        )
        lidar = generated[1] if has_lidar else None
        assert_same(belief, encode(params, THREE, (camera, lidar, sonar)))


def test_the_loss_of_decoding_is_the_error_at_the_mean_of_every_posterior():
    params, looks = init(jax.random.key(0), TWO), (look(TWO, 0), look(TWO, 1))
    config = JmvaeConfig(reconstruction_weights=(2.0, 0.5))
    problem = fusion.Decoding(config, tuple(x[None, None] for x in looks), TWO, params)
    drawn = jnp.zeros((2, 1)), tuple(x[:, None] for x in looks)
    found = problem.loss(params["decoders"], drawn, jnp.int32(0))
    expected = 0.0
    for given in ((looks[0], None), (None, looks[1]), looks):
        decoded = decode(params, TWO, encode(params, TWO, given)[0])
        for weight, shown, read in zip((2.0, 0.5), given, decoded, strict=True):
            expected += 0.0 if shown is None else 0.5 * weight * np.sum((shown - read) ** 2)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


CLASSES = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))


def test_in_place_the_class_shown_is_not_one_that_the_belief_rules_out():
    # The mean of two classes may lie nearest to a third.
    found = in_place(TWO, init(jax.random.key(0), TWO), CLASSES)
    for a, b in itertools.combinations(range(3), 2):
        halves = jnp.zeros(3).at[jnp.array([a, b])].set(0.5)
        belief = readout.mixture(found.classes, halves)
        probabilities = found.class_probabilities(belief)
        np.testing.assert_allclose(probabilities, halves, atol=0.02)
        assert found.most_likely_class(belief) == np.argmax(probabilities)

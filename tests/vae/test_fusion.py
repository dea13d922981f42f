"""Fusion in place: which encoder is asked, and with what; and what every kind of fusion has."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from exact_filter import CLASSES
from plain import decode, encode, looks, random_params

from jaxsense.config import JmvaeConfig
from jaxsense.core.types import Belief
from jaxsense.vae import fusion, jmvae, readout
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=2, hidden=(8,))
OLD = Belief(jnp.array([0.4, -0.7]), jnp.array([0.9, 1.1]))


update = jax.jit(fusion.InPlace.update, static_argnames="modality")


def in_place(model, params, classes=None):
    """Fusion in place; classes do not matter to an update."""
    shape = 3, model.latent_size
    classes = Belief(jnp.zeros(shape), jnp.ones(shape)) if classes is None else classes
    prior = fusion.prior(model, 20.0)
    return fusion.InPlace(classes, prior, readout.make(classes), model, params)


def assert_same(belief, mean_and_log_var):
    mean, log_var = mean_and_log_var
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(belief.std, np.exp(log_var / 2), rtol=1e-5)


def test_every_update_encodes_the_look_with_what_the_map_says_of_the_others():
    model, params = THREE, random_params(jmvae.init, THREE)
    number, found = len(model.modalities), in_place(model, params)
    generated = decode(params, model, OLD.mean)
    for modality, new in enumerate(looks(model)):
        for seen in itertools.product([False, True], repeat=number):
            belief = update(found, OLD, jnp.array(seen), new, modality=modality)
            inputs = [g if s else None for g, s in zip(generated, seen, strict=True)]
            inputs[modality] = new  # never generated, whether it has been seen before or not
            assert_same(belief, encode(params, model, tuple(inputs)))


def test_looks_add_up_in_a_filter_alone():
    assert fusion.Filter.accumulates
    assert not fusion.InPlace.accumulates


def test_the_loss_of_decoding_is_the_error_at_the_mean_of_every_posterior():
    params, shown = random_params(jmvae.init, TWO), looks(TWO)
    config = JmvaeConfig(reconstruction_weights=(2.0, 0.5))
    problem = fusion.decoding(config, tuple(x[None, None] for x in shown), TWO, params)
    drawn = jnp.zeros((2, 1)), tuple(x[:, None] for x in shown)
    found = jax.jit(problem.loss)(params["decoders"], drawn, jnp.int32(0))
    expected = 0.0
    for given in ((shown[0], None), (None, shown[1]), shown):
        decoded = decode(params, TWO, encode(params, TWO, given)[0])
        for weight, x, read in zip((2.0, 0.5), given, decoded, strict=True):
            expected += 0.0 if x is None else 0.5 * weight * np.sum((x - read) ** 2)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_in_place_the_class_shown_is_not_one_that_the_belief_rules_out():
    # The mean of two classes may lie nearest to a third.
    found = in_place(TWO, random_params(jmvae.init, TWO), CLASSES)
    read = jax.jit(lambda halves: found.class_probabilities(readout.mixture(found.classes, halves)))
    for a, b in itertools.combinations(range(3), 2):
        halves = 0.5 * np.isin(range(3), (a, b)).astype(np.float32)
        np.testing.assert_allclose(read(halves), halves, atol=0.02)

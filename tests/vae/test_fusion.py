"""Writing into the map: which encoder is asked, and with what."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core.types import Belief
from jaxsense.vae import fusion, jmvae
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=2, hidden=(8,))
OLD = Belief(jnp.array([0.4, -0.7]), jnp.array([0.9, 1.1]))


@pytest.fixture(scope="module", params=[TWO, THREE], ids=["two", "three"])
def model_and_params(request):
    return request.param, jmvae.init(jax.random.key(0), request.param)


def look(model, modality, seed=0):
    return jax.nn.softmax(jax.random.normal(jax.random.key(seed), (model.feature_sizes[modality],)))


def assert_same(belief, mean_and_log_var):
    mean, log_var = mean_and_log_var
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(belief.std, np.exp(log_var / 2), rtol=1e-5)


def test_every_write_encodes_the_look_with_what_the_map_says_of_the_others(model_and_params):
    model, params = model_and_params
    write = jax.jit(fusion.write, static_argnames=("model", "modality"))
    number = len(model.modalities)
    generated = jmvae.decode(params, model, OLD.mean)
    for modality in range(number):
        new = look(model, modality)
        for seen in itertools.product([False, True], repeat=number):
            belief = write(params, model, OLD, jnp.array(seen), new, modality=modality)
            inputs = [g if s else None for g, s in zip(generated, seen, strict=True)]
            inputs[modality] = new  # never generated, whether it has been seen before or not
            assert_same(belief, jmvae.encode(params, model, tuple(inputs)))


@pytest.mark.parametrize("modality", [0, 1])
def test_a_first_look_gives_the_uni_modal_posterior_whatever_the_entry_was(modality):
    params, new = jmvae.init(jax.random.key(0), TWO), look(TWO, modality)
    alone = tuple(new if m == modality else None for m in range(2))
    for own in (False, True):  # a second look with the same sensor starts afresh
        seen = (jnp.arange(2) == modality) & own
        belief = fusion.write(params, TWO, OLD, seen, new, modality)
        assert_same(belief, jmvae.encode(params, TWO, alone))


def test_several_sensors_may_look_at_once():
    # What has looked before and does not look now is decoded; all the others are as they are.
    params = jmvae.init(jax.random.key(0), THREE)
    camera, sonar = look(THREE, 0), look(THREE, 2)
    generated = jmvae.decode(params, THREE, OLD.mean)
    for has_lidar in (False, True):
        belief = fusion.fuse(
            params, THREE, OLD, np.array([True, has_lidar, False]), (camera, None, sonar)
        )
        lidar = generated[1] if has_lidar else None
        assert_same(belief, jmvae.encode(params, THREE, (camera, lidar, sonar)))
    with pytest.raises(ValueError, match="must hold one modality or more"):
        fusion.fuse(params, THREE, OLD, jnp.zeros(3, bool), (None, None, None))
    with pytest.raises(ValueError, match="must be 3, one for each"):
        fusion.fuse(params, THREE, OLD, jnp.zeros(3, bool), (camera, None))


def test_fusion_decodes_the_mean_and_ignores_the_width_of_the_old_entry():
    params, new = jmvae.init(jax.random.key(0), TWO), look(TWO, 1)
    seen = jnp.array([True, False])
    belief = fusion.write(params, TWO, OLD, seen, new, 1)
    camera, _ = jmvae.decode(params, TWO, OLD.mean)
    assert_same(belief, jmvae.encode(params, TWO, (camera, new)))
    wider = fusion.write(params, TWO, replace(OLD, std=5 * OLD.std), seen, new, 1)
    np.testing.assert_array_equal(wider.mean, belief.mean)
    moved = fusion.write(params, TWO, replace(OLD, mean=OLD.mean + 1), seen, new, 1)
    assert np.all(moved.mean != belief.mean)


def test_a_batch_of_writes_equals_a_loop_of_singles_in_any_order():
    params = jmvae.init(jax.random.key(0), TWO)
    mean, std = jax.random.normal(jax.random.key(1), (2, 6, 2))
    old = Belief(mean, jnp.abs(std))
    seen = jnp.array([[0, 0], [0, 1], [1, 0], [1, 1], [0, 1], [1, 0]], bool)
    new = jax.nn.softmax(jax.random.normal(jax.random.key(2), (6, 2)))

    @jax.jit
    @jax.vmap
    def write(old, seen, new):
        return fusion.write(params, TWO, old, seen, new, 0)

    batch = write(old, seen, new)
    for i in range(6):
        single = fusion.write(params, TWO, Belief(old.mean[i], old.std[i]), seen[i], new[i], 0)
        np.testing.assert_allclose(batch.mean[i], single.mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(batch.std[i], single.std, rtol=1e-5)
    order = np.array([3, 5, 0, 1, 4, 2])
    permuted = write(Belief(old.mean[order], old.std[order]), seen[order], new[order])
    np.testing.assert_allclose(permuted.mean, batch.mean[order], rtol=1e-5, atol=1e-6)


def test_unseen_has_mean_zero_and_the_given_variance():
    belief = fusion.unseen(TWO, 20.0)
    np.testing.assert_array_equal(belief.mean, [0.0, 0.0])
    np.testing.assert_allclose(belief.std, [4.472136, 4.472136], rtol=1e-6)  # sqrt(20)


def test_wrong_shapes_raise_errors_that_name_the_argument():
    params, new = jmvae.init(jax.random.key(0), TWO), look(TWO, 0)
    seen = jnp.array([False, False])
    with pytest.raises(AssertionError, match="belief"):
        fusion.write(params, TWO, Belief(jnp.zeros((1, 2)), jnp.ones((1, 2))), seen, new, 0)
    with pytest.raises(AssertionError, match="seen"):
        fusion.write(params, TWO, OLD, jnp.array([False]), new, 0)
    with pytest.raises(AssertionError, match="features of camera"):
        fusion.write(params, TWO, OLD, seen, jnp.zeros(3), 0)


@pytest.mark.parametrize("modality", [-1, 2, 3])
def test_a_modality_that_is_not_there_is_named(modality):
    params, seen = jmvae.init(jax.random.key(0), TWO), jnp.array([False, False])
    with pytest.raises(ValueError, match=rf"modality = {modality}: must be a whole number"):
        fusion.write(params, TWO, OLD, seen, look(TWO, 0), modality)

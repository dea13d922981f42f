"""Variants of the JMVAE of scans: ours is the library's, and each changes what its name says."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import raw
from benchmarks.raw import ABLATION, OURS, PAPER, Data, Model
from jaxsense.vae import leave_one_out
from jaxsense.vae.leave_one_out import Shape

KEY = jax.random.key(0)
SIZES, NUMBER, POIS = (3, 5), 4, 6
LOOKS = tuple(
    jax.random.normal(jax.random.fold_in(KEY, m), (size, POIS, NUMBER))
    for m, size in enumerate(SIZES)
)


def test_the_variant_ours_has_the_loss_of_the_library():
    model = Model(OURS, SIZES, 2)
    params = model.init(KEY)
    shape = Shape(("camera", "lidar"), SIZES, 2, OURS.hidden)
    named = {
        part: dict(zip(shape.modalities, params[ours], strict=True))
        for part, ours in (("encoders", "alone"), ("embeddings", "embedding"),
                           ("decoders", "decoders"))
    }  # fmt: skip
    noise = jnp.stack([
        jax.random.normal(keys[0], (2, POIS, NUMBER)) for keys in jax.random.split(KEY, (2, 2))
    ])  # fmt: skip
    expected = leave_one_out.losses(
        noise, {**named, "joint": params["joint"][0]}, shape,
        tuple(jnp.moveaxis(x, 0, -1) for x in LOOKS),
        alpha=OURS.alpha, beta=0.7, has_begun=0.6, reconstruction_weights=(60.0, 60.0),
    )  # fmt: skip
    found = model.loss(KEY, params, LOOKS, jnp.float32(0.7), jnp.float32(0.6))
    np.testing.assert_allclose(found, jnp.mean(expected), rtol=1e-4)


# The others differ in the looks that they are given.
IN_LOSS = [v for v in ABLATION if v.looks == NUMBER and v.has_frames and v != OURS]


@pytest.mark.parametrize("variant", IN_LOSS, ids=lambda v: v.name)
def test_each_variant_has_another_loss(variant):
    changed, ours = Model(variant, SIZES, 2), Model(OURS, SIZES, 2)
    params = changed.init(KEY)
    found = changed.loss(KEY, params, LOOKS, jnp.float32(1), jnp.float32(1))
    assert jnp.isfinite(found)
    if not variant.private:
        usual = ours.loss(KEY, params, LOOKS, jnp.float32(1), jnp.float32(1))
        assert abs(found - usual) > 1e-3


def test_variants_learn_what_is_easy():
    classes = np.arange(96) % 3
    x = jnp.asarray(np.eye(3)[classes][:, None] * np.ones((1, NUMBER, 1)), jnp.float32)
    noise = 0.1 * jax.random.normal(KEY, (2, *x.shape))
    data = Data((x + noise[0], x + noise[1]), classes)
    model = Model(dataclasses.replace(OURS, depth=1), (3, 3), 2)
    params, norms = jax.jit(lambda key: raw.train(key, model, data, 300))(KEY)
    assert norms.shape == (300, 2)
    assert (norms > 0).all()
    found = raw.measured(model, params, data, data)
    assert found["all_looks"] == 1
    assert found["units"] == 2


def test_a_row_shows_medians_with_the_worst_and_the_best():
    found = {"pair": [0.5], "first_over_last": [0.5], "units": [2, 1, 2]}
    row = raw.as_row(PAPER, {**found, "all_looks": [0.1, 0.9, 0.4]})
    assert "| paper | 0.400 (0.100 to 0.900) |" in row
    assert "| 2 (1 to 2) |" in row

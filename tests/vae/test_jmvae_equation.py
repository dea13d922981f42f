"""The loss, term by term, against the equation written down anew and against MultiVae."""

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxsense.vae import jmvae
from jaxsense.vae.jmvae import Jmvae

MODEL = Jmvae(("camera", "lidar"), (2, 3), latent_size=2, hidden=(8, 5))
OPTIONS = {"alpha": 0.3, "beta": 0.7, "reconstruction_weights": (2.0, 5.0)}
BATCH = 6


@pytest.fixture(scope="module")
def example():
    """Parameters, all of them random, noise, features and what `losses` makes of them."""
    keys = jax.random.split(jax.random.key(0), 4)
    params = jmvae.init(keys[0], MODEL)
    flat, unravel = ravel_pytree(params)
    # Biases of zero would hide where they are added.
    params = unravel(flat + 0.3 * jax.random.normal(keys[1], flat.shape))
    noise = jax.random.normal(keys[2], (MODEL.latent_size, BATCH))
    features = tuple(
        jax.random.uniform(k, (size, BATCH))
        for k, size in zip(jax.random.split(keys[3]), MODEL.feature_sizes, strict=True)
    )
    found = jax.jit(lambda *inputs: jmvae.losses(*inputs, **OPTIONS), static_argnums=2)
    return params, noise, features, found(noise, params, MODEL, features)


def dense(params, x):
    """Layers with ReLU between them, in double precision."""
    layers = [params["params"][f"Dense_{i}"] for i in range(3)]
    for i, layer in enumerate(layers):
        x = np.asarray(layer["kernel"], np.float64).T @ x + np.asarray(layer["bias"])
        x = np.maximum(x, 0) if i < 2 else x
    return x


def kl(mean, variance, mean_q, variance_q):
    """`KL(N(mean, variance) || N(mean_q, variance_q))`, summed over dimensions."""
    of_each = np.log(np.sqrt(variance_q / variance)) - 0.5
    of_each = of_each + (variance + (mean - mean_q) ** 2) / (2 * variance_q)
    return of_each.sum()


def test_every_term_is_that_of_the_equation(example):
    params, noise, features, (total, parts) = example
    for i in range(BATCH):
        x, w = (np.asarray(f[:, i], np.float64) for f in features)
        joint, camera, lidar = (
            np.split(dense(params["encoders"][name], v), 2)
            for name, v in (
                ("camera+lidar", np.concatenate([x, w])), ("camera", x), ("lidar", w)
            )
        )  # fmt: skip
        mean, variance = joint[0], np.exp(joint[1])
        z = mean + np.sqrt(variance) * np.asarray(noise[:, i])
        # -log N(x; decoded, 1) without the constant.
        of_camera = 0.5 * np.sum((x - dense(params["decoders"]["camera"], z)) ** 2)
        of_lidar = 0.5 * np.sum((w - dense(params["decoders"]["lidar"], z)) ** 2)
        prior = kl(mean, variance, np.zeros(2), np.ones(2))
        subsets = kl(mean, variance, camera[0], np.exp(camera[1]))
        subsets += kl(mean, variance, lidar[0], np.exp(lidar[1]))
        reconstruction = 2.0 * of_camera + 5.0 * of_lidar
        np.testing.assert_allclose(parts["reconstruction"][i], reconstruction, rtol=1e-4)
        np.testing.assert_allclose(parts["prior"][i], prior, rtol=1e-4)
        np.testing.assert_allclose(parts["subsets"][i], subsets, rtol=1e-4)
        expected = reconstruction + 0.7 * prior + 0.3 * subsets
        np.testing.assert_allclose(total[i], expected, rtol=1e-4)

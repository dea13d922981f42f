"""The likelihood of features, with decoders for which it is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxsense import vae
from jaxsense.vae import jmvae

LINEAR = vae.Jmvae(("camera", "lidar"), (2, 3), latent_size=2, hidden=())
WEIGHTS = (4.0, 0.5)
FEATURES = (np.float32([0.3, -0.2]), np.float32([0.5, 0.1, -0.4]))
estimate = jax.jit(vae.log_likelihood, static_argnames=("model", "samples"))


@pytest.fixture(scope="module")
def params():
    return jmvae.init(jax.random.key(0), LINEAR)


def exact(params, present):
    """Features of linear decoders are normal: their moments follow from those of the latents."""
    offset = jmvae.decode(params, LINEAR, jnp.zeros(2))
    jacobian = jax.jacobian(lambda z: jmvae.decode(params, LINEAR, z))(jnp.zeros(2))
    w = np.concatenate([jacobian[m] for m in present])
    noise = np.concatenate([np.full(len(FEATURES[m]), 1 / WEIGHTS[m]) for m in present])
    x, mean = (np.concatenate([of[m] for m in present]) for of in (FEATURES, offset))
    return multivariate_normal.logpdf(x, mean, w @ w.T + np.diag(noise))


@pytest.mark.parametrize("present", [(0,), (1,), (0, 1)])
def test_linear_decoders_have_a_likelihood_in_closed_form(params, present):
    features = tuple(x if m in present else None for m, x in enumerate(FEATURES))
    found = estimate(jax.random.key(1), params, LINEAR, features, WEIGHTS, samples=20_000)
    np.testing.assert_allclose(found, exact(params, present), atol=0.03)

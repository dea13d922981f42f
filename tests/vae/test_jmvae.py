"""The JMVAE's encoders, decoders, loss and training."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import JmvaeConfig
from jaxsense.vae import jmvae
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=4, hidden=(8,))


init = jax.jit(jmvae.init, static_argnums=1)
encode = jax.jit(jmvae.encode, static_argnums=1)
loss = jax.jit(jmvae.loss, static_argnums=2)


@functools.partial(jax.jit, static_argnums=0)
def some_features(model, seed=0):
    keys = jax.random.split(jax.random.key(seed), len(model.modalities))
    return tuple(
        jax.random.uniform(k, (n,)) for k, n in zip(keys, model.feature_sizes, strict=True)
    )


def keep(features, subset):
    return tuple(f if m in subset else None for m, f in enumerate(features))


def zero_parameters(model):
    return jax.tree.map(np.zeros_like, init(jax.random.key(0), model))


def with_output(params, name, output):
    """Parameters with the bias of one encoder's last layer replaced."""
    layers = params["encoders"][name]["params"]
    last = {**layers["Dense_1"], "bias": np.array(output, np.float32)}
    changed = {"params": {**layers, "Dense_1": last}}
    return {**params, "encoders": {**params["encoders"], name: changed}}


def test_a_subset_without_an_encoder_has_the_product_of_its_modalities():
    model = Jmvae(THREE.modalities, THREE.feature_sizes, 1, (8,), max_subset=1)
    params = zero_parameters(model)
    params = with_output(params, "camera", [1.0, np.log(0.5)])
    params = with_output(params, "lidar", [3.0, np.log(0.25)])
    assert params["encoders"].keys() == {"camera", "lidar", "sonar", "camera+lidar+sonar"}
    mean, log_var = encode(params, model, keep(some_features(model), (0, 1)))
    # The prior has precision 1, camera adds 1 and LiDAR 3: (2 x 1 + 4 x 3) / (1 + 1 + 3).
    np.testing.assert_allclose(mean, [14 / 5], rtol=1e-6)
    np.testing.assert_allclose(log_var, [-np.log(5)], rtol=1e-6)
    options = {"alpha": 1.0, "beta": 1.0, "reconstruction_weights": (1.0,) * 3}
    _, parts = loss(jax.random.key(0), params, model, some_features(model), **options)
    # KL(N(0, 1) || N(m, v)) = (1/v + m^2/v - 1 + ln v) / 2 for camera and LiDAR, 0 for the sonar.
    expected = (2 + 2 - 1 - np.log(2)) / 2 + (4 + 36 - 1 - np.log(4)) / 2
    np.testing.assert_allclose(parts["subsets"], expected, rtol=1e-5)


def test_first_half_of_an_encoders_output_is_the_mean_and_the_second_the_log_variance():
    params = with_output(zero_parameters(TWO), "lidar", [1.0, 2.0, jnp.log(4.0), 0.0])
    features = keep(some_features(TWO), (1,))
    mean, log_var = encode(params, TWO, features)
    np.testing.assert_allclose(mean, [1.0, 2.0])
    np.testing.assert_allclose(log_var, [1.386294, 0.0], rtol=1e-5)
    belief = jmvae.posterior(params, TWO, features)
    np.testing.assert_allclose(belief.mean, [1.0, 2.0])
    np.testing.assert_allclose(belief.std, [2.0, 1.0], rtol=1e-6)  # exp(ln(4) / 2) = 2


def test_beta_falls_by_equal_factors_to_its_last_value():
    config = JmvaeConfig(steps=100, annealing=0.5, initial_beta=1.0, beta=0.01)
    betas = [float(jmvae.annealed_beta(jnp.int32(s), config)) for s in (0, 25, 50, 99)]
    # Half way through the 50 steps of annealing, sqrt(1 x .01) = .1.
    np.testing.assert_allclose(betas, [1.0, 0.1, 0.01, 0.01], rtol=1e-5)

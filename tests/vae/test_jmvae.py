"""The JMVAE's encoders, decoders, loss, training and likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain import dense, encode, looks, random_params
from scipy.stats import multivariate_normal

from jaxsense.config import JmvaeConfig
from jaxsense.vae import gaussian, jmvae
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=4, hidden=(8,))


losses = jax.jit(jmvae.losses, static_argnums=2)


def with_output(params, name, output):
    """Parameters with the bias of one encoder's last layer replaced."""
    layers = params["encoders"][name]["params"]
    last = {**layers["Dense_1"], "bias": np.array(output, np.float32)}
    changed = {"params": {**layers, "Dense_1": last}}
    return {**params, "encoders": {**params["encoders"], name: changed}}


def test_a_subset_without_an_encoder_has_the_product_of_its_modalities():
    model = Jmvae(THREE.modalities, THREE.feature_sizes, 1, (8,), max_subset=1)
    params = jax.tree.map(np.zeros_like, random_params(jmvae.init, model))
    params = with_output(params, "camera", [1.0, np.log(0.5)])
    params = with_output(params, "lidar", [3.0, np.log(0.25)])
    assert params["encoders"].keys() == {"camera", "lidar", "sonar", "camera+lidar+sonar"}
    mean, log_var = jmvae.encode(params, model, (*looks(model)[:2], None))
    # The prior has precision 1, camera adds 1 and LiDAR 3: (2 x 1 + 4 x 3) / (1 + 1 + 3).
    np.testing.assert_allclose(mean, [14 / 5], rtol=1e-6)
    np.testing.assert_allclose(log_var, [-np.log(5)], rtol=1e-6)
    options = {"alpha": 1.0, "beta": 1.0, "reconstruction_weights": (1.0,) * 3}
    columns = tuple(x[:, None] for x in looks(model))
    _, parts = losses(jnp.zeros((1, 1)), params, model, columns, **options)
    # KL(N(0, 1) || N(m, v)) = (1/v + m^2/v - 1 + ln v) / 2 for camera and LiDAR, 0 for the sonar.
    expected = (2 + 2 - 1 - np.log(2)) / 2 + (4 + 36 - 1 - np.log(4)) / 2
    np.testing.assert_allclose(parts["subsets"], [expected], rtol=1e-5)


def test_a_scale_is_one_of_all_parameters():
    init = jax.jit(lambda scale: jmvae.init(jax.random.key(0), TWO, scale=scale))
    one, half = init(1.0), init(0.5)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(0.5 * x, y), one, half)


def test_a_product_with_what_knows_nothing_stays_as_it_is():
    means, log_vars = jnp.array([[1.0]]), jnp.log(jnp.array([[0.5]]))
    # One alone stays as it is, and one wider than the prior takes nothing away from another.
    np.testing.assert_allclose(gaussian.product(means, log_vars), ([1.0], [-np.log(2)]))
    mean, log_var = gaussian.product(jnp.array([[1.0], [0.0]]), jnp.log(jnp.array([[0.5], [9.0]])))
    np.testing.assert_allclose(mean, [1.0], rtol=1e-6)
    np.testing.assert_allclose(log_var, [-np.log(2)], rtol=1e-6)


def test_beta_falls_by_equal_factors_to_its_last_value():
    config = JmvaeConfig(steps=100, annealing=0.5, initial_beta=1.0, beta=0.01)
    betas = [float(jmvae.annealed_beta(jnp.int32(s), config)) for s in (0, 25, 50, 99)]
    # Half way through the 50 steps of annealing, sqrt(1 x .01) = .1.
    np.testing.assert_allclose(betas, [1.0, 0.1, 0.01, 0.01], rtol=1e-5)


# What it is trained on: which detections are drawn from a bank.

SETTINGS = JmvaeConfig(batch=64, steps=40)
# Class c and row r as 10 c + r; the two modalities have different numbers of rows.
CLASSES, ROWS = np.float32(10) * np.arange(4)[:, None, None], np.arange(5)[None, :, None]
CAMERA = CLASSES + ROWS[:, :3]
LIDAR = np.tile(CLASSES + ROWS, (1, 1, 2))


@pytest.fixture(scope="module")
def drawn():
    return jmvae.problem(
        SETTINGS, (CAMERA, LIDAR), Jmvae(("camera", "lidar"), (1, 2), 2, (3,))
    ).draw(jax.random.key(0), 20)


def test_every_class_and_every_row_of_a_bank_is_drawn(drawn):
    noise, (camera, lidar) = drawn
    assert noise.shape == (20, 2, 64)
    assert (camera.shape, lidar.shape) == ((20, 1, 64), (20, 2, 64))
    # 1,280 draws: each of 20 is missed with a chance of (19/20)^1280, below 1e-28.
    assert set(np.unique(camera)) == set(np.asarray(CAMERA).ravel().tolist())
    assert set(np.unique(lidar)) == set(np.asarray(LIDAR).ravel().tolist())


def test_a_pair_is_of_one_class_and_otherwise_independent(drawn):
    _, (camera, lidar) = drawn
    camera, first, second = np.asarray(camera[:, 0]), *np.moveaxis(np.asarray(lidar), 1, 0)
    np.testing.assert_array_equal(camera // 10, first // 10)
    np.testing.assert_array_equal(first, second)
    pairs = set(zip((camera % 10).ravel().tolist(), (first % 10).ravel().tolist(), strict=True))
    assert len(pairs) == 3 * 5
    assert not np.array_equal(camera[0], camera[1])


@pytest.mark.parametrize("steps", [1, 150])
def test_a_training_takes_as_many_steps_as_it_is_told(steps):
    bank = tuple(jnp.eye(2)[jnp.array(x)][:, None] for x in ([1, 0, 0], [0, 0, 1]))
    config = JmvaeConfig(steps=steps, batch=16, learning_rate=0.01, annealing=0.0)
    train = jax.jit(jmvae.train, static_argnums=2)
    params, found = train(jax.random.key(0), random_params(jmvae.init, TWO), TWO, bank, config)
    assert found.shape == (steps,)
    assert np.isfinite(found).all()
    assert steps == 1 or found[-9:].mean() < 0.9 * found[:9].mean()
    assert jax.tree.structure(params) == jax.tree.structure(random_params(jmvae.init, TWO))


# The loss, term by term, against the equation written down anew.

MODEL = Jmvae(("camera", "lidar"), (2, 3), latent_size=2, hidden=(8, 5))
OPTIONS = {"alpha": 0.3, "beta": 0.7, "reconstruction_weights": (2.0, 5.0)}
BATCH = 6


@pytest.fixture(scope="module")
def example():
    """Parameters, all of them random, noise, features and what `losses` makes of them."""
    rng, params = np.random.default_rng(0), random_params(jmvae.init, MODEL)
    noise = rng.normal(size=(MODEL.latent_size, BATCH)).astype(np.float32)
    features = tuple(rng.uniform(size=(n, BATCH)).astype(np.float32) for n in MODEL.feature_sizes)
    return params, noise, features, losses(noise, params, MODEL, features, **OPTIONS)


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
            encode(params, MODEL, given) for given in ((x, w), (x, None), (None, w))
        )
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


# The likelihood of features, with decoders for which it is known.

LINEAR = Jmvae(("camera", "lidar"), (2, 3), latent_size=2, hidden=())
WEIGHTS = (4.0, 0.5)
FEATURES = (np.float32([0.3, -0.2]), np.float32([0.5, 0.1, -0.4]))
estimate = jax.jit(jmvae.log_likelihood, static_argnames=("model", "samples"))


def exact(params, present):
    """Features of linear decoders are normal: their moments follow from those of the latents."""
    layers = [params["decoders"][name]["params"]["Dense_0"] for name in LINEAR.modalities]
    w = np.concatenate([layers[m]["kernel"].T for m in present])
    noise = np.concatenate([np.full(len(FEATURES[m]), 1 / WEIGHTS[m]) for m in present])
    mean = np.concatenate([layers[m]["bias"] for m in present])
    x = np.concatenate([FEATURES[m] for m in present])
    return multivariate_normal.logpdf(x, mean, w @ w.T + np.diag(noise))


@pytest.mark.parametrize("present", [(0,), (1,), (0, 1)])
def test_linear_decoders_have_a_likelihood_in_closed_form(present):
    params = random_params(jmvae.init, LINEAR)
    features = tuple(x if m in present else None for m, x in enumerate(FEATURES))
    found = estimate(jax.random.key(1), params, LINEAR, features, WEIGHTS, samples=20_000)
    np.testing.assert_allclose(found, exact(params, present), atol=0.03)

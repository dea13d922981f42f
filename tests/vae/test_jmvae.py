"""The JMVAE's encoders, decoders, loss and training."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxsense.config import JmvaeConfig
from jaxsense.core.types import Belief
from jaxsense.training import measures
from jaxsense.vae import fusion, gaussian, jmvae, readout
from jaxsense.vae.jmvae import Jmvae

TWO = Jmvae(("camera", "lidar"), (2, 2), latent_size=2, hidden=(8,))
THREE = Jmvae(("camera", "lidar", "sonar"), (2, 3, 1), latent_size=4, hidden=(8,))


init = jax.jit(jmvae.init, static_argnums=1)
encode = jax.jit(jmvae.encode, static_argnums=1)
decode = jax.jit(jmvae.decode, static_argnums=1)
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


def with_output(params, part, name, output):
    """Parameters with the bias of one network's last layer replaced."""
    network = {"params": dict(params[part][name]["params"])}
    network["params"]["Dense_1"] = {
        **network["params"]["Dense_1"],
        "bias": np.array(output, np.float32),
    }
    return {**params, part: {**params[part], name: network}}


def test_subsets_up_to_a_size_and_the_full_set_have_encoders():
    def subsets(number):
        return Jmvae(THREE.modalities, (2, 3, 1), 4, (8,), max_subset=number).subsets

    assert subsets(1) == ((0,), (1,), (2,), (0, 1, 2))
    assert subsets(2) == subsets(3) == subsets(9) == THREE.subsets
    assert Jmvae(("camera",), (2,), 4, (8,), max_subset=1).subsets == ((0,),)


def test_a_subset_without_an_encoder_has_the_product_of_its_modalities():
    model = Jmvae(THREE.modalities, THREE.feature_sizes, 1, (8,), max_subset=1)
    params = zero_parameters(model)
    params = with_output(params, "encoders", "camera", [1.0, np.log(0.5)])
    params = with_output(params, "encoders", "lidar", [3.0, np.log(0.25)])
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


def test_initial_weights_are_scaled():
    params, small = (jmvae.init(jax.random.key(0), TWO, scale=x) for x in (1.0, 0.5))
    chex.assert_trees_all_equal(small, jax.tree.map(lambda x: 0.5 * x, params))
    default = jmvae.init(jax.random.key(0), TWO)
    chex.assert_trees_all_equal(params, default)
    assert all(np.any(x["params"]["Dense_0"]["kernel"] != 0) for x in default["encoders"].values())


def test_every_subset_has_an_encoder_of_its_own():
    model = THREE
    params, features = init(jax.random.key(0), model), some_features(model)
    before = {s: encode(params, model, keep(features, s)) for s in model.subsets}
    for mean, log_var in before.values():
        assert mean.shape == log_var.shape == (model.latent_size,)
    means = [tuple(mean.tolist()) for mean, _ in before.values()]
    assert len(set(means)) == len(model.subsets)
    for changed in model.subsets:
        name = "+".join(model.modalities[m] for m in changed)
        other = with_output(params, "encoders", name, np.full(2 * model.latent_size, 9.0))
        for subset in model.subsets:
            mean, _ = encode(other, model, keep(features, subset))
            assert np.array_equal(mean, before[subset][0]) == (subset != changed)


def test_first_half_of_an_encoders_output_is_the_mean_and_the_second_the_log_variance():
    params = with_output(zero_parameters(TWO), "encoders", "lidar", [1.0, 2.0, jnp.log(4.0), 0.0])
    features = keep(some_features(TWO), (1,))
    mean, log_var = encode(params, TWO, features)
    np.testing.assert_allclose(mean, [1.0, 2.0])
    np.testing.assert_allclose(log_var, [1.386294, 0.0], rtol=1e-5)
    belief = jmvae.posterior(params, TWO, features)
    np.testing.assert_allclose(belief.mean, [1.0, 2.0])
    np.testing.assert_allclose(belief.std, [2.0, 1.0], rtol=1e-6)  # exp(ln(4) / 2) = 2


def test_loss_as_worked_by_hand():
    # Joint posterior N((1, 0), I), camera N(0, I), LiDAR N((1, 2), I); the decoders always give
    # (1, 0) and (0, 0), so that the draw does not matter.
    params = zero_parameters(TWO)
    params = with_output(params, "encoders", "camera+lidar", [1.0, 0.0, 0.0, 0.0])
    params = with_output(params, "encoders", "lidar", [1.0, 2.0, 0.0, 0.0])
    params = with_output(params, "decoders", "camera", [1.0, 0.0])
    total, parts = loss(
        jax.random.key(0),
        params,
        TWO,
        (jnp.array([0.0, 0.0]), jnp.array([0.0, 2.0])),
        alpha=0.1,
        beta=0.2,
        reconstruction_weights=(10.0, 3.0),
    )
    # 10 (1^2 / 2) + 3 (2^2 / 2) = 11; KL to the prior 1^2 / 2; KL to camera 1^2 / 2, LiDAR 2^2 / 2.
    np.testing.assert_allclose(parts["reconstruction"], 11.0, rtol=1e-6)
    np.testing.assert_allclose(parts["prior"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(parts["subsets"], 2.5, rtol=1e-6)
    np.testing.assert_allclose(total, 11 + 0.2 * 0.5 + 0.1 * 2.5, rtol=1e-6)


def test_losses_of_a_batch_are_those_of_its_examples():
    params = init(jax.random.key(0), THREE)
    keys = jax.random.split(jax.random.key(1), 5)
    examples = jax.vmap(lambda k: some_features(THREE, k))(jnp.arange(5))
    options = {"alpha": 0.7, "beta": 0.3, "reconstruction_weights": (2.0, 0.5, 3.0)}
    noise = jax.vmap(lambda k: jax.random.normal(k, (THREE.latent_size,)), out_axes=-1)(keys)
    columns = tuple(x.T for x in examples)
    together, parts = jax.jit(jmvae.losses, static_argnums=2)(
        noise, params, THREE, columns, **options
    )
    assert together.shape == (5,)
    for i, key in enumerate(keys):
        alone, of_one = loss(key, params, THREE, tuple(x[i] for x in examples), **options)
        np.testing.assert_allclose(together[i], alone, rtol=1e-5)
        for name, part in of_one.items():
            np.testing.assert_allclose(parts[name][i], part, rtol=1e-5)


def test_losses_say_under_jit_that_parameters_are_not_finite():
    steps = 230  # in the middle of the third chunk
    config = JmvaeConfig(hidden=(8,), steps=steps, batch=64)
    bank = [jax.random.uniform(k, (3, 50, 2)) for k in jax.random.split(jax.random.key(1))]
    bank[0] = bank[0].at[1, 7].set(jnp.nan)
    train = jax.jit(jmvae.train, static_argnums=2)
    params, losses = train(
        jax.random.key(2), init(jax.random.key(0), TWO), TWO, tuple(bank), config
    )
    assert not all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    assert np.isnan(losses[-1])
    assert not np.isfinite(losses).all()


def test_gradient_of_the_loss_agrees_with_finite_differences():
    with jax.enable_x64(True):
        model = Jmvae(("camera", "lidar"), (2, 2), 2, (4,))
        params = jmvae.init(jax.random.key(0), model)
        flat, unravel = ravel_pytree(params)
        flat = flat.astype(jnp.float64)
        features = tuple(x.astype(jnp.float64) for x in some_features(model))

        @jax.jit
        def of_flat(flat):
            options = {"alpha": 0.5, "beta": 0.2, "reconstruction_weights": (3.0, 1.0)}
            params = jax.tree.map(lambda x: x.astype(jnp.float64), unravel(flat))
            return jmvae.loss(jax.random.key(1), params, model, features, **options)[0]

        gradient, h = jax.jit(jax.grad(of_flat))(flat), 1e-6
        rows = np.flatnonzero(np.abs(np.asarray(gradient)) > 1e-3)[::7]
        assert len(rows) >= 5
        for i in rows:
            step = jnp.zeros_like(flat).at[i].set(h)
            slope = (of_flat(flat + step) - of_flat(flat - step)) / (2 * h)
            np.testing.assert_allclose(gradient[i], slope, rtol=1e-5)


def test_beta_falls_by_equal_factors_to_its_last_value():
    config = JmvaeConfig(steps=100, annealing=0.5, initial_beta=1.0, beta=0.01)
    betas = [float(jmvae.annealed_beta(jnp.int32(s), config)) for s in (0, 25, 50, 99)]
    # Half way through the 50 steps of annealing, sqrt(1 x .01) = .1.
    np.testing.assert_allclose(betas, [1.0, 0.1, 0.01, 0.01], rtol=1e-5)


# A trained one, on features as the detectors give them.

CONFIG = JmvaeConfig(
    hidden=(64, 64),
    alpha=0.1,
    beta=0.003,
    initial_beta=0.5,
    annealing=0.5,
    reconstruction_weights=(10.0, 10.0),
    steps=1500,
    batch=128,
    learning_rate=2e-3,
)
MODEL = Jmvae(("camera", "lidar"), (2, 2), CONFIG.latent_size, CONFIG.hidden)
LABELS = ((1, 0, 0), (0, 0, 1))  # green cylinder, red cylinder, red cube: colour and shape


@functools.partial(jax.jit, static_argnums=1)
def two_hot_bank(key, per_class):
    """`[C, S, 2]` probabilities per modality: .9 or more for the right label."""

    def features(key, labels):
        doubt = 0.1 * jax.random.uniform(key, (len(labels), per_class))
        is_second = jnp.array(labels)[:, None] == 1
        second = jnp.where(is_second, 1 - doubt, doubt)
        return jnp.stack([1 - second, second], axis=-1)

    keys = jax.random.split(key, len(LABELS))
    return tuple(features(k, labels) for k, labels in zip(keys, LABELS, strict=True))


@pytest.fixture(scope="module")
def trained():
    """Losses, and beliefs of new detections: joint and one per modality, `[C, S, D]`."""
    untrained, bank = init(jax.random.key(0), MODEL), two_hot_bank(jax.random.key(1), 500)
    train = jax.jit(jmvae.train, static_argnames=("model", "config"))
    params, losses = train(jax.random.key(2), untrained, model=MODEL, bank=bank, config=CONFIG)
    bank = two_hot_bank(jax.random.key(3), 50)

    @jax.jit
    def examine(camera, lidar):
        both = jax.vmap(jax.vmap(lambda x, w: jmvae.posterior(params, MODEL, (x, w))))
        return {
            "joint": both(camera, lidar),
            "camera": jax.vmap(jax.vmap(lambda x: jmvae.posterior(params, MODEL, (x, None))))(
                camera
            ),
            "lidar": jax.vmap(jax.vmap(lambda w: jmvae.posterior(params, MODEL, (None, w))))(lidar),
        }

    return params, losses, bank, examine(*bank)


def test_training_lowers_the_loss(trained):
    _, losses, _, _ = trained
    assert losses.shape == (CONFIG.steps,)
    assert np.all(np.isfinite(losses))
    assert losses[-50:].mean() < 0.5 * losses[:50].mean()


def test_trained_posteriors_reproduce_table_1(trained):
    beliefs = trained[3]
    class_means = beliefs["joint"].mean.mean(axis=1)
    plausible = jax.jit(jax.vmap(jax.vmap(readout.plausible_classes, (0, None)), (0, None)))
    only_true = np.eye(3, dtype=bool)[:, None]
    shares = {
        name: np.all(plausible(b, class_means) == only_true, axis=-1).mean(axis=1)
        for name, b in beliefs.items()
    }
    np.testing.assert_array_equal(shares["joint"] > 0.9, [True, True, True])
    np.testing.assert_array_equal(shares["camera"] > 0.9, [True, False, False])
    np.testing.assert_array_equal(shares["lidar"] > 0.9, [False, False, True])


def test_trained_unimodal_posteriors_match_the_moments_of_the_joint_ones(trained):
    beliefs = trained[3]
    for name, classes in (("camera", (1, 2)), ("lidar", (0, 1))):
        members = jax.tree.map(lambda x: x[np.array(classes)].reshape(-1, 2), beliefs["joint"])  # noqa: B023
        alone = jax.tree.map(lambda x: x[classes[0]], beliefs[name])  # noqa: B023
        error = jax.vmap(measures.moment_matching_error, in_axes=(0, None))(alone, members)
        assert error.mean() < 0.3
    mean, std = gaussian.moment_match(members.mean, members.std)
    other = Belief(mean + std, std)  # the bound tells a shift by one deviation
    assert measures.moment_matching_error(other, members) > 0.3


@pytest.mark.parametrize("first", [0, 1])
def test_a_trained_model_fuses_a_second_look_into_the_right_class(trained, first):
    params, _, bank, beliefs = trained
    class_means = beliefs["joint"].mean.mean(axis=1)
    seen = jnp.arange(2) == first
    old = beliefs[MODEL.modalities[first]]

    @jax.jit
    @jax.vmap
    @jax.vmap
    def fuse(old, features):
        both = (None, features) if first == 0 else (features, None)
        belief = fusion.fuse(params, MODEL, old, seen, both)
        return readout.nearest_class(belief, class_means)

    is_right = np.asarray(fuse(old, bank[1 - first])) == np.arange(3)[:, None]
    assert is_right.mean() > 0.95

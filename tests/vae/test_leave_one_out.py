"""The JMVAE of scans: its loss against a plain one in NumPy, and what its encoders know."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain import dense, random_params

from jaxsense.config import DetectorConfig, JmvaeConfig
from jaxsense.core.types import Belief
from jaxsense.vae import detectors, frames, leave_one_out, readout
from jaxsense.vae.jmvae import Jmvae
from jaxsense.vae.leave_one_out import Encoder

MODEL = Jmvae(("camera", "lidar"), (3, 5), latent_size=2, hidden=(4,))
NUMBER, POIS = 3, 2
KEY = jax.random.key(0)
PARAMS = random_params(leave_one_out.init, MODEL, scale=0.2)
RNG = np.random.default_rng(0)
LOOKS = tuple(
    jnp.asarray(RNG.normal(size=(POIS, NUMBER, size)), jnp.float32) for size in MODEL.feature_sizes
)
NOISE = RNG.normal(size=(2, 2, POIS, NUMBER)).astype(np.float32)
WEIGHTS = 6.0, 15.0
posterior = jax.jit(leave_one_out.posterior, static_argnums=1)


@jax.jit
def features(encoder, window):
    return detectors.features(encoder, window, jnp.float32(1.0))


def joint(looks):
    """Mean and log-variance from a list of looks by each sensor."""
    means = []
    for name, given in zip(MODEL.modalities, looks, strict=True):
        found = [np.maximum(dense(PARAMS["embeddings"][name], x), 0) for x in given]
        means.append(np.mean(found, axis=0))
    return np.split(dense(PARAMS["joint"], np.concatenate(means)), 2)


def divergence(p, q):
    (mean, log_var), (mean_2, log_var_2) = p, q
    ratio = np.exp(log_var - log_var_2)
    return 0.5 * np.sum(ratio + (mean - mean_2) ** 2 / np.exp(log_var_2) - 1 - log_var + log_var_2)


def plain_losses(alpha, beta):
    """The loss of each PoI as its docstring has it, one look after the other."""
    x = [np.asarray(of_sensor) for of_sensor in LOOKS]
    normal = np.zeros(2), np.zeros(2)
    errors, losses = np.zeros((2, POIS, NUMBER)), np.zeros(POIS)
    for b in range(POIS):
        every = joint([x[0][b], x[1][b]])
        losses[b] += beta * divergence(every, normal)
        for m, name in enumerate(MODEL.modalities):
            for k in range(NUMBER):
                others = [list(x[0][b]), list(x[1][b])]
                del others[m][k]
                of_others = joint(others)
                losses[b] += beta * divergence(of_others, normal) / NUMBER
                z = of_others[0] + np.exp(0.5 * of_others[1]) * np.asarray(NOISE[m, :, b, k])
                decoded = dense(PARAMS["decoders"][name], z)
                errors[m, b, k] = np.sum((x[m][b, k] - decoded) ** 2)
                alone = np.split(dense(PARAMS["encoders"][name], x[m][b, k]), 2)
                losses[b] += alpha * divergence(every, alone)
        for k in range(NUMBER):
            pair = joint([[x[0][b, k]], [x[1][b, k]]])
            losses[b] += alpha * divergence(every, pair)
    for m, size in enumerate(MODEL.feature_sizes):
        variance = np.mean(errors[m]) / size
        of_looks = errors[m] / (size * variance) + np.log(variance)
        losses += 0.5 * WEIGHTS[m] * of_looks.sum(axis=1)
    return losses


@jax.jit
def losses_of(params, alpha=0.7, beta=0.3, has_begun=1.0):
    weights = {"alpha": alpha, "beta": beta, "has_begun": has_begun}
    return leave_one_out.losses(
        NOISE, params, MODEL, LOOKS, **weights, reconstruction_weights=WEIGHTS
    )


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 0.0), (0.7, 0.3)])
def test_the_loss_is_the_plain_one(alpha, beta):
    found = losses_of(PARAMS, alpha=alpha, beta=beta)
    np.testing.assert_allclose(found, plain_losses(alpha, beta), rtol=2e-5)


def test_before_alpha_sets_in_single_encoders_follow_and_do_not_draw():
    """Without sets of one look by each sensor, which the joint network encodes too."""

    gradient = jax.jit(jax.grad(lambda params, weights: jnp.sum(losses_of(params, **weights))))

    def of_part(part, alpha=0.7, has_begun=1.0):
        of_all = gradient(PARAMS, {"alpha": alpha, "has_begun": has_begun})
        return jax.tree.leaves(of_all[part])

    for usual, stronger in zip(
        of_part("encoders", has_begun=0.0), of_part("encoders", has_begun=0.0, alpha=5.0),
        strict=True,
    ):  # fmt: skip
        assert np.abs(usual).max() > 0
        np.testing.assert_array_equal(usual, stronger)
    begun = zip(of_part("joint", alpha=0.7), of_part("joint", alpha=5.0), strict=True)
    assert all(not np.allclose(weak, strong) for weak, strong in begun)


def test_the_posterior_takes_any_number_of_looks_in_any_order():
    looks = tuple(np.asarray(x[0]) for x in LOOKS)
    found = posterior(PARAMS, MODEL, looks)
    mean, log_var = joint(looks)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.std, np.exp(0.5 * log_var), rtol=1e-5)
    turned = posterior(PARAMS, MODEL, (looks[0][::-1], looks[1][[1, 0]]))
    fewer = posterior(PARAMS, MODEL, (looks[0], looks[1][:2]))
    np.testing.assert_allclose(turned.mean, fewer.mean, rtol=1e-5, atol=1e-6)


def test_alpha_sets_in_late():
    config = JmvaeConfig(
        learns_from="scans", fusion="filter", hidden=(4,), steps=100, alpha=3.0, annealing=0.0,
    )  # fmt: skip
    problem = leave_one_out.problem(config, LOOKS, MODEL)
    rows, noise = problem.draw(KEY, 1)
    np.testing.assert_array_equal(np.unique(rows), range(POIS))
    drawn, loss = (rows[0], noise[0]), jax.jit(problem.loss)
    early, start, late, end = (
        float(loss(PARAMS, drawn, jnp.int32(step))) for step in (0, 40, 60, 99)
    )
    assert early == start
    assert late == pytest.approx(end, rel=1e-6)
    assert late > start


# Two labels on each axis of the latent space; the encoder reads the first number of a window.
CLASSES = Belief(jnp.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]), jnp.full((3, 2), 0.3))


def encoder_of(sharpness=1.0) -> Encoder:
    model = Jmvae(("camera",), (1,), latent_size=2, hidden=())
    kernel = jnp.array([[1.0, 0.0, 0.0, 0.0]])
    # q(z | x): first latent known, second that of either class.
    bias = jnp.array([0.0, 0.0, 2 * np.log(0.3), 2 * np.log(np.sqrt(1 + 0.09))])
    params = {"params": {"Dense_0": {"kernel": kernel, "bias": bias}}}
    prior = Belief(jnp.zeros(2), jnp.full(2, np.sqrt(20.0)))
    presence = detectors.init(KEY, jnp.ones((2, 1)), 1, DetectorConfig(hidden=(2,)))
    scaling = frames.Scaling(frames.Frame(), jnp.zeros(1), jnp.float32(1.0))
    return Encoder(
        params, scaling, presence, readout.make(CLASSES, [2, 2]), prior,
        jnp.float32(sharpness), model, label_of_class=(0, 0, 1),
    )  # fmt: skip


def test_features_are_probabilities_of_labels_read_from_the_posterior():
    encoder = encoder_of()
    assert encoder.num_labels == 2
    assert not encoder.presence.measures_distance  # unless it is told so
    left = features(encoder, jnp.array([-1.0]))
    np.testing.assert_allclose(left.sum(), 1.0, rtol=1e-6)
    assert left[0] > 0.99
    sharper = features(encoder_of(2.0), jnp.array([-0.6]))
    found = features(encoder, jnp.array([-0.6]))
    np.testing.assert_allclose(sharper, found**2 / np.sum(np.asarray(found) ** 2), rtol=1e-4)


def test_calibration_finds_how_sharp_labels_are():
    encoder = encoder_of()
    windows = np.full((100, 1), -0.4, np.float32)
    classes = np.repeat([0, 2], [90, 10])
    found = jax.jit(leave_one_out.calibrate)(encoder, windows, classes)
    # Nine of ten looks like this one show the first label.
    np.testing.assert_allclose(features(found, windows[0])[0], 0.9, atol=0.01)


# Clusters: found where points are apart, and named by most of their points.


def test_a_point_belongs_to_the_nearest_centre():
    centres = jnp.array([[0.0, 0.0], [4.0, 0.0]])
    points = jnp.array([[1.9, 5.0], [2.1, -5.0], [4.0, 0.0]])
    np.testing.assert_array_equal(leave_one_out.nearest(points, centres), [0, 1, 1])


def test_the_centres_of_several_tries_are_those_nearest_to_the_points():
    # Nine clusters of ten points each, of which a single try misses some.
    places = np.array([[x, y] for x in (0.0, 4.0, 8.0) for y in (0.0, 1.0, 9.0)])
    points = np.repeat(places, 10, axis=0) + 0.1 * RNG.normal(size=(90, 2))
    found = jax.jit(leave_one_out.centres, static_argnums=2)(KEY, jnp.float32(points), 9)
    means = points.reshape(9, 10, 2).mean(axis=1)
    apart = np.linalg.norm(means[:, None] - np.asarray(found)[None], axis=-1)
    np.testing.assert_allclose(apart.min(axis=1), 0.0, atol=1e-3)


def test_no_two_classes_are_one_cluster():
    members, classes = jnp.array([0, 0, 0, 0, 0, 1, 2]), jnp.array([0, 0, 0, 1, 1, 2, 2])
    # Most of both are in the first cluster; it has three points of the first class.
    found = np.asarray(leave_one_out.named(members, classes, 3))
    assert found[0] == 0
    assert sorted(found) == [0, 1, 2]

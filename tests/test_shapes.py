"""Wrong shapes given to functions of `vae` and `dqn`: errors while tracing that name the argument.

Those of `sim` are tested beside the functions.
"""

import jax
import jax.numpy as jnp
import pytest

import jaxsense
from jaxsense import dqn, vae
from jaxsense.core.types import Belief
from jaxsense.vae import jmvae, readout

CONFIG = jaxsense.PRESETS["smoke"]
MODEL = jaxsense.make_jmvae(CONFIG)
KEY = jax.random.key(0)


def zeros(*shape):
    return jnp.zeros(shape)


def belief(*shape):
    return Belief(jnp.zeros(shape), jnp.ones(shape))


def train_on(*bank):
    return vae.train(KEY, jmvae.init(KEY, MODEL), MODEL, bank, CONFIG.jmvae)


def encode(*features):
    return vae.encode(jmvae.init(KEY, MODEL), MODEL, features)


def update(old, seen, features):
    return jaxsense.init(KEY, CONFIG).fusion.update(old, seen, features, 0)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("log_var_p", lambda: vae.kl_divergence(zeros(2), zeros(1), zeros(2), zeros(2))),
        ("mean_q", lambda: vae.kl_divergence(zeros(2), zeros(2), zeros(1), zeros(2))),
        ("log_var_q", lambda: vae.kl_divergence(zeros(2), zeros(2), zeros(2), zeros(3))),
        ("mean", lambda: vae.moment_match(zeros(2), zeros(2))),
        ("std", lambda: vae.moment_match(zeros(4, 2), zeros(4, 3))),
        ("belief.mean", lambda: vae.plausible_classes(belief(4, 2), zeros(3, 2))),
        ("belief.std", lambda: vae.plausible_classes(Belief(zeros(2), zeros(3)), zeros(3, 2))),
        ("class_means", lambda: readout.nearest_class(belief(2), zeros(3, 4))),
        ("std", lambda: vae.sigma_norm(jnp.float32(1))),
        ("std", lambda: dqn.information(jnp.float32(1))),
        ("belief.mean", lambda: dqn.observation(belief(2))),
        ("belief.std", lambda: dqn.observation(Belief(zeros(3, 2), zeros(3, 1)))),
        ("features of lidar", lambda: encode(zeros(2), zeros(3))),
        ("z", lambda: vae.decode(jmvae.init(KEY, MODEL), MODEL, zeros(3))),
        ("seen", lambda: update(belief(2), zeros(3), zeros(2))),
        ("belief.std", lambda: update(belief(3), zeros(2), zeros(2))),
        ("features of camera", lambda: update(belief(2), zeros(2), zeros(5))),
    ],
)
def test_argument_is_named(name, call):
    with pytest.raises(ValueError, match=rf"(^|\W){name}\W"):
        jax.eval_shape(call)


def test_bank_of_another_size_is_named():
    with pytest.raises(ValueError, match=r"bank of lidar has the shape \(3, 8, 4\)"):
        jax.eval_shape(lambda: train_on(zeros(3, 8, 2), zeros(3, 8, 4)))


def test_bank_of_other_classes_is_named():
    with pytest.raises(ValueError, match="bank of lidar has 2 classes"):
        jax.eval_shape(lambda: train_on(zeros(3, 8, 2), zeros(2, 8, 2)))


def test_missing_features_are_named():
    params = jmvae.init(KEY, MODEL)
    weights = CONFIG.jmvae.reconstruction_weights
    with pytest.raises(ValueError, match="features"):
        vae.loss(
            KEY, params, MODEL, (zeros(2), None), alpha=1, beta=1, reconstruction_weights=weights
        )

"""Three classes, two sensors that tell their labels, and a filter that knows them exactly."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core.types import Belief
from jaxsense.vae import fusion
from jaxsense.vae.jmvae import Jmvae

# Red or green, cylinder or cube: classes are green cylinder, red cylinder, red cube.
MODEL = Jmvae(("camera", "lidar"), (2, 2), 2, (4,))
LABELS = np.array([[1, 0, 0], [0, 0, 1]])
CLASSES = Belief(jnp.array([[1.2, 0.9], [-0.8, 0.9], [-0.8, -1.3]]), jnp.full((3, 2), 0.4))
PRIOR = fusion.prior(MODEL, 20.0)


def untrained_filter(hidden=(1,)):
    init = lambda key: fusion.init_filter(key, MODEL, CLASSES, PRIOR, hidden)  # noqa: E731
    return jax.jit(init)(jax.random.key(0))


@functools.cache
def exact_filter():
    """A filter whose log-likelihoods are the logarithm of the label's feature."""
    found = untrained_filter()
    # With three classes in two dimensions, every log-likelihood is linear in the moments.
    of_moments = np.linalg.pinv(found.readout.of_classes)
    networks = {
        name: {"params": {"Dense_0": {"kernel": np.eye(2)[:, labels] @ of_moments.T}}}
        for name, labels in zip(MODEL.modalities, LABELS, strict=True)
    }
    for network in networks.values():
        network["params"]["Dense_0"]["bias"] = np.zeros(2)
    return dataclasses.replace(found, networks=jax.tree.map(jnp.float32, networks), hidden=())

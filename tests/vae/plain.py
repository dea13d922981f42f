"""Networks of the JMVAE in NumPy, with parameters that are drawn: nothing is compiled for them."""

import jax
import numpy as np


def random_params(init, model, scale=0.5):
    """Parameters of a model, all of them random: biases of zero would hide where they are added."""
    shapes = jax.eval_shape(lambda key: init(key, model), jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: rng.normal(0.0, scale, x.shape).astype(np.float32), shapes)


def looks(model):
    """Probabilities of labels for each modality."""
    rng = np.random.default_rng(0)
    return tuple(rng.dirichlet(np.ones(n)).astype(np.float32) for n in model.feature_sizes)


def dense(params, x):
    """Layers with ReLU between them, in double precision."""
    *hidden, last = params["params"].values()
    for layer in hidden:
        x = np.maximum(np.asarray(layer["kernel"], np.float64).T @ x + layer["bias"], 0)
    return np.asarray(last["kernel"], np.float64).T @ x + last["bias"]


def encode(params, model, features):
    """Mean and log-variance, by the encoder of the modalities that are there."""
    subset = tuple(m for m, x in enumerate(features) if x is not None)
    given = np.concatenate([features[m] for m in subset])
    return np.split(dense(params["encoders"][model.encoder_name(subset)], given), 2)


def decode(params, model, z):
    return [dense(params["decoders"][name], z) for name in model.modalities]

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


@pytest.mark.slow  # imports PyTorch
def test_every_term_is_that_of_multivae(example, monkeypatch):
    """On the same weights, with the same noise."""
    try:
        import torch
        from multivae.data.datasets import MultimodalBaseDataset
        from multivae.models import JMVAE, JMVAEConfig
    except (ImportError, RuntimeError) as error:  # the latter where torchvision does not fit torch
        pytest.skip(f"multivae cannot be imported: {error}")
    from benchmarks.peers import multivae as peer

    params, noise, features, (_, parts) = example
    of_each = dict(zip(MODEL.modalities, MODEL.feature_sizes, strict=True))
    network = JMVAE(
        JMVAEConfig(2, MODEL.latent_size, {n: (size,) for n, size in of_each.items()}, warmup=1),
        encoders={n: peer.Encoder(size, MODEL) for n, size in of_each.items()},
        decoders={n: peer.Decoder(size, MODEL) for n, size in of_each.items()},
        joint_encoder=peer.JointEncoder(MODEL),
    )
    copies = {
        "camera+lidar": network.joint_encoder,
        **{name: network.encoders[name] for name in MODEL.modalities},
    }
    for name, ours in params["encoders"].items():
        copy_into(copies[name].layers, ours)
    for name, ours in params["decoders"].items():
        copy_into(network.decoders[name].layers, ours)
    weights = OPTIONS["reconstruction_weights"]
    network.rescale_factors = dict(zip(MODEL.modalities, weights, strict=True))
    columns = torch.tensor(np.array(noise.T))
    monkeypatch.setattr(torch.distributions.normal, "_standard_normal", lambda *_, **__: columns)
    tensors = {n: torch.tensor(np.array(x.T)) for n, x in zip(of_each, features, strict=True)}

    def total(alpha, beta):
        network.alpha, network.beta = alpha, beta
        return network(MultimodalBaseDataset(tensors)).loss_sum.item()

    # MultiVae keeps the constant of the density of each feature: ln(2 pi) / 2.
    sizes = MODEL.feature_sizes
    constant = BATCH * sum(w * n for w, n in zip(weights, sizes, strict=True)) * np.log(2 * np.pi)
    reconstruction = total(0.0, 0.0) - constant / 2
    np.testing.assert_allclose(parts["reconstruction"].sum(), reconstruction, rtol=1e-5)
    np.testing.assert_allclose(parts["prior"].sum(), total(0.0, 1.0) - total(0.0, 0.0), rtol=1e-4)
    np.testing.assert_allclose(parts["subsets"].sum(), total(1.0, 0.0) - total(0.0, 0.0), rtol=1e-4)
    expected = reconstruction + 0.7 * parts["prior"].sum() + 0.3 * parts["subsets"].sum()
    np.testing.assert_allclose(total(0.3, 0.7) - constant / 2, expected, rtol=1e-5)


def copy_into(layers, ours):
    """Weights of ours into the linear layers of PyTorch, which holds them transposed."""
    import torch

    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for i, layer in enumerate(linear):
        dense = ours["params"][f"Dense_{i}"]
        layer.weight.data = torch.tensor(np.array(dense["kernel"]).T)
        layer.bias.data = torch.tensor(np.array(dense["bias"]))

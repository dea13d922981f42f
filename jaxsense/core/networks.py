"""Multi-layer perceptrons: dense layers with ReLU between them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, PyTree

from jaxsense.core.types import product

Params = PyTree
"""A pytree of network parameters."""


class Dense(nn.Module):
    """A dense layer for `[F]` features, or `[F, B]`: batch last is twice as fast on a CPU."""

    size: int
    kernel_init: nn.initializers.Initializer

    @nn.compact
    def __call__(self, x: Float[Array | np.ndarray, "F ..."]) -> Float[Array, "{self.size} ..."]:
        """Applies the layer to one example, or to a batch along the last axis."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[0], self.size))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.size,))
        return product(kernel.T, x) + bias.reshape(-1, *[1] * (x.ndim - 1))


class MLP(nn.Module):
    """Dense layers with ReLU, and a linear last layer of `outputs` units."""

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: Float[Array | np.ndarray, "F ..."]) -> Float[Array, "{self.outputs} ..."]:
        """Applies all layers to one example, or to a batch along the last axis."""
        for i, size in enumerate(self.hidden):
            x = nn.relu(Dense(size, nn.initializers.he_normal(), name=f"Dense_{i}")(x))
        last = nn.initializers.lecun_normal()
        return Dense(self.outputs, last, name=f"Dense_{len(self.hidden)}")(x)


@functools.partial(jax.jit, static_argnames=("network", "inputs"))
def init(key: jax.Array, network: nn.Module, inputs: int) -> Params:
    """Random parameters of a network for inputs of a size; compiled once for each shape."""
    return network.init(key, jnp.zeros(inputs))


def apply(
    network: nn.Module, params: Params, *x: Float[Array | np.ndarray, "F ..."]
) -> Float[Array, "A ..."]:
    """Applies a network to one example, or to a batch along the last axis."""
    return jnp.asarray(network.apply(params, *x))


def statistics(
    inputs: Float[Array, "S F"],
) -> tuple[Float[Array, " F"], Float[Array, ""]]:
    """Mean of inputs for training, and the overall standard deviation from it, never 0."""
    offset = jnp.mean(inputs, axis=0)
    # `jnp.std` would hold all of the differences.
    mean = jnp.mean(inputs - offset[None])
    deviation = inputs - (offset + mean)[None]
    return offset, jnp.sqrt(jnp.mean(jnp.square(deviation))) + 1e-6


def scale_last(network: MLP, params: Params, factor: Float[Array, "..."] | float) -> Params:
    """Multiplies the last layer of an `MLP`, so all outputs, or each of `[A]`."""
    layers, last = dict(params["params"]), f"Dense_{len(network.hidden)}"
    layers[last] = jax.tree.map(lambda x: jnp.broadcast_to(factor, x.shape) * x, layers[last])
    return {**params, "params": layers}

"""Multi-layer perceptrons: dense layers with ReLU between them."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

Params = Any
"""A pytree of network parameters."""


class Dense(nn.Module):
    """A layer for `[F]` features, or for `[F, B]`, with an example in each column.

    With the batch last, layers of this size and their gradients take half as long on a CPU.
    """

    size: int
    kernel_init: nn.initializers.Initializer

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[F]` to `[size]`, or `[F, B]` to `[size, B]`."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[0], self.size))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.size,))
        # In full precision, so that an accelerator agrees with a CPU.
        y = jnp.matmul(kernel.T, x, precision=jax.lax.Precision.HIGHEST)
        return y + bias.reshape(-1, *[1] * (x.ndim - 1))


class MLP(nn.Module):
    """Dense layers with ReLU, and a linear last layer.

    Attributes:
      hidden: sizes of the hidden layers.
      outputs: size of the last layer.
    """

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[F]` to `[outputs]`, or `[F, B]` to `[outputs, B]`."""
        for i, size in enumerate(self.hidden):
            x = nn.relu(Dense(size, nn.initializers.he_normal(), name=f"Dense_{i}")(x))
        last = nn.initializers.lecun_normal()
        return Dense(self.outputs, last, name=f"Dense_{len(self.hidden)}")(x)


@functools.partial(jax.jit, static_argnames=("network", "inputs"))
def init(key: jax.Array, network: nn.Module, inputs: int) -> Params:
    """Random parameters of a network for `[inputs]`, compiled once per shape."""
    return network.init(key, jnp.zeros(inputs))


def apply(network: nn.Module, params: Params, x: jax.Array) -> jax.Array:
    """The forward pass of a network, see `MLP.__call__`."""
    return jnp.asarray(network.apply(params, x))

"""The one network of jaxsense: dense layers with ReLU between them."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

Params = Any
"""A pytree of network parameters."""


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
        """`[..., F]` to `[..., outputs]`."""
        # In full precision, so that an accelerator gives what a CPU does.
        dense = functools.partial(nn.Dense, precision=jax.lax.Precision.HIGHEST)
        for size in self.hidden:
            x = nn.relu(dense(size, kernel_init=nn.initializers.he_normal())(x))
        return dense(self.outputs)(x)


@functools.partial(jax.jit, static_argnames=("network", "inputs"))
def init(key: jax.Array, network: MLP, inputs: int) -> Params:
    """Random parameters of a network for `[..., inputs]`, by one program for each of its shapes."""
    return network.init(key, jnp.zeros(inputs))


def apply_to_columns(params: Params, x: jax.Array) -> jax.Array:
    """What `MLP` gives for every column of `[F, B]`: `[outputs, B]`.

    For training: with the batch as last axis, layers of this size and their gradients take a CPU
    half as long.

    Args:
      params: of an `MLP`.
      x: inputs, one in each column.
    """
    layers = params["params"]
    for i in range(len(layers)):
        layer = layers[f"Dense_{i}"]
        x = jnp.matmul(layer["kernel"].T, x, precision=jax.lax.Precision.HIGHEST)
        x = x + layer["bias"][:, None]
        if i < len(layers) - 1:
            x = nn.relu(x)
    return x

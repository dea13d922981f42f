"""The one network of jaxsense: dense layers with ReLU between them."""

import functools

import jax
from flax import linen as nn


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

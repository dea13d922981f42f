"""The one network of jaxsense: dense layers with ReLU between them."""

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
        for size in self.hidden:
            x = nn.relu(nn.Dense(size, kernel_init=nn.initializers.he_normal())(x))
        return nn.Dense(self.outputs)(x)

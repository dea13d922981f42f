"""What crosses the border between `sim`, `vae`, `dqn` and the programs that join them."""

import jax
from flax import struct

Key = jax.Array
"""A typed or legacy JAX random key; consumed exactly once by the function that takes it."""

Features = tuple[jax.Array | None, ...]
"""For each modality its `[D_m]` features, or None where it is missing."""


@struct.dataclass
class Belief:
    """What is known of a point of interest: a diagonal Gaussian in the latent space.

    Any number of leading axes is allowed, for example `[N]` for a map of N points of interest.

    Attributes:
      mean: `[..., D]` float32, in latent units.
      std: `[..., D]` float32 positive standard deviations, in latent units.
    """

    mean: jax.Array
    std: jax.Array


@struct.dataclass
class Transition:
    """One step of the map MDP as a Q-network learns from it, or a batch of them as columns.

    Attributes:
      s_tm1: `[N * 2D, ...]` float32 map before the action, see `belief_mdp.as_state`.
      a_tm1: `[...]` int32 action, `N` being no operation.
      r_t: `[...]` float32 reward.
      discount_t: `[...]` float32, 0 where the episode ended and 1 elsewhere.
      s_t: `[N * 2D, ...]` float32 map after the action.
    """

    s_tm1: jax.Array
    a_tm1: jax.Array
    r_t: jax.Array
    discount_t: jax.Array
    s_t: jax.Array

"""Rewards of looks: the paper's, or nats. Another kind is a new class like `Reward`."""

from typing import Protocol, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.config import MdpConfig
from jaxsense.config.section import named_function
from jaxsense.core import checks
from jaxsense.core.types import Belief, pytree


class Reward(Protocol):
    """Protocol of the reward of a look; a frozen pytree."""

    @property
    def is_of_labels(self) -> bool:
        """Whether expected rewards depend only on the posterior over the own sensor's labels."""
        ...

    def information(self, belief: Belief, probabilities: Float[Array, " C"]) -> Float[Array, ""]:
        """Information of a belief."""
        ...

    def of_gain(self, gain: Float[Array, "..."]) -> Float[Array, "..."]:
        """Rewards of looks, by the information that they gain."""
        ...


@pytree
class Paper:
    """The paper's reward: the gain of `1 / ||std||_2`, or -1 if it is too small.

    Attributes:
      min_increase: `[]` gain up to which the reward is -1, in inverse latent units.
    """

    min_increase: jax.Array | float
    is_of_labels = False  # the width of a belief depends on all classes

    def information(self, belief: Belief, probabilities: Float[Array, " C"]) -> Float[Array, ""]:
        """Information of a belief, see the function `information`."""
        del probabilities
        return information(belief.std)

    def of_gain(self, gain: Float[Array, "..."]) -> Float[Array, "..."]:
        """The gain, or -1 where it is not above `min_increase`."""
        return jnp.where(gain <= self.min_increase, -1.0, gain)


@pytree
class Nats:
    """Reward in nats: the entropy that a look removes, minus the cost of the look.

    Attributes:
      look_cost: `[]` in nats.
    """

    look_cost: jax.Array | float
    is_of_labels = True  # see `dqn.optimum`

    def information(self, belief: Belief, probabilities: Float[Array, " C"]) -> Float[Array, ""]:
        """Negative entropy of the classes, in nats."""
        del belief
        return -entropy(probabilities)

    def of_gain(self, gain: Float[Array, "..."]) -> Float[Array, "..."]:
        """The gain minus the cost of a look."""
        return gain - self.look_cost


def make(config: MdpConfig) -> Reward:
    """Makes the reward that the settings name."""
    known = {"paper": Paper(config.min_increase), "nats": Nats(config.look_cost)}
    if config.reward in known:
        return known[config.reward]
    own = cast("Reward", named_function("mdp.reward", config.reward)(config))
    checks.require_members("mdp.reward", own, Reward)
    return own


def information(std: Float[Array, "... D"]) -> Float[Array, "..."]:
    """Computes the information of a belief, `I = 1 / ||std||_2`.

    Korthals et al. 2018, Sec. IV.
    """
    checks.require_positive("std", std)
    return 1.0 / jnp.linalg.norm(std, axis=-1)


def entropy(probabilities: Float[Array, "... C"]) -> Float[Array, "..."]:
    """Entropy of probabilities, in nats.

    Its gradient in a probability of 0, which is infinite, counts as 0, so that values of looks have
    gradients.
    """
    is_zero = probabilities == 0
    logs = jnp.log(jnp.where(is_zero, 1.0, probabilities))
    return -jnp.sum(jnp.where(is_zero, 0.0, probabilities * logs), axis=-1)

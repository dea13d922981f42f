"""Random histories of looks at one PoI, and how exactly beliefs hold what they tell."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.core.types import Belief, Key, Samples, call
from jaxsense.models import make_bayes
from jaxsense.vae import readout

LOOKS = 6
"""Looks in a history."""


def draw(
    key: Key, bank: Samples, true_class: Int[Array, ""]
) -> tuple[Int[Array, " T"], tuple[Float[Array, "T D_m"], ...]]:
    """Draws a history of looks at a PoI.

    Returns:
      `[T]` int32 modality of each look, and for each modality `[T, D_m]` features, of which only
      those of this modality count.
    """
    modality_key, *row_keys = jax.random.split(key, 1 + len(bank))
    modalities = jax.random.randint(modality_key, (LOOKS,), 0, len(bank))
    looks = tuple(
        x[true_class, jax.random.randint(k, (LOOKS,), 0, x.shape[1])]
        for x, k in zip(bank, row_keys, strict=True)
    )
    return modalities, looks


def readout_error(
    key: Key,
    config: Config,
    bank: Samples,
    classes: Belief,
    read: Callable[[Belief], Float[Array, " C"]],
    number: int = 1024,
) -> Float[Array, ""]:
    """Nats that class probabilities lose when a belief holds them.

    Mean divergence after the number of looks where it is largest. Exact Bayes gives the
    probabilities after each look of random histories; the belief with the moments of their mixture
    is as good as a belief can be.

    Args:
      key: random key.
      config: all settings.
      bank: features of looks at every class.
      classes: `[C, D]` mean joint posterior of each class.
      read: class probabilities of a belief.
      number: of histories; static.
    """
    exact = make_bayes(config)

    def history(key: Key, true_class: jax.Array) -> jax.Array:
        def look(log_posterior: jax.Array, drawn):
            modality, features = drawn
            update = lambda m: exact.update(log_posterior, features[m], m)  # noqa: E731
            after = call(update, modality, len(bank))
            held = readout.mixture(classes, jnp.exp(after))
            return after, readout.divergence(jnp.exp(after), read(held))

        return jax.lax.scan(look, exact.prior, draw(key, bank, true_class))[1]

    truth = jnp.arange(number) % len(classes.mean)
    lost = jax.vmap(history)(jax.random.split(key, number), truth)
    return jnp.max(jnp.mean(lost, axis=0))

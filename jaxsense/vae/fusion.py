"""Writing a detection into the map: fusion in place, or by a filter.

Korthals et al. 2018, Sec. III and Fig. 3.
"""

import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.core import checks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Features
from jaxsense.vae import filtering, jmvae, metrics
from jaxsense.vae.jmvae import Jmvae

FILTER = "filter"
"""Name of the filter among the parameters of a JMVAE."""


def fuse(
    params: Params,
    model: Jmvae,
    belief: Belief,
    seen: jax.Array | np.ndarray,
    features: Features,
) -> Belief:
    """Updates the map's entry of a PoI after a look by one sensor, or by several at once.

    The first look writes `q(z|x)`. The map does not keep the features of modalities that have seen
    the PoI before: they are decoded from the entry's mean and encoded together with the new ones.

    Args:
      params: of the JMVAE.
      model: its shape.
      belief: `[D]` current entry.
      seen: `[M]` bool, which modalities have seen the PoI before.
      features: for each modality `[D_m]` new detections, or None where it has not looked.

    Returns:
      The new entry. The old one enters it only through the decoder.

    Raises:
      ValueError: if `features` lacks an entry for a modality, all are None, or one holds no
        probabilities; if the belief is not finite or not positive.
    """
    chex.assert_shape(belief.std, (model.latent_size,), custom_message="belief.std")
    chex.assert_shape(belief.mean, (model.latent_size,), custom_message="belief.mean")
    chex.assert_shape(seen, (len(model.modalities),), custom_message="seen")
    checks.require_finite("belief.mean", belief.mean)
    checks.require_positive("belief.std", belief.std)
    jmvae.check_features(model, features)
    for name, new in zip(model.modalities, features, strict=True):
        if new is not None:
            checks.require_probabilities(f"features of {name}", new)
    generated = jmvae.decode(params, model, belief.mean)
    others = [m for m, new in enumerate(features) if new is None]
    entry = belief
    # One encoder for each set of modalities that may have looked before; `seen` picks among them.
    for size in range(len(others) + 1):
        for subset in itertools.combinations(others, size):
            inputs = tuple(generated[m] if m in subset else new for m, new in enumerate(features))
            candidate = jmvae.posterior(params, model, inputs)
            is_subset = jnp.array([m in subset for m in others], bool)
            applies = jnp.all(jnp.asarray(seen)[jnp.array(others, int)] == is_subset)
            entry = jax.tree.map(lambda new, old: jnp.where(applies, new, old), candidate, entry)  # noqa: B023
    return entry


def write(
    params: Params,
    model: Jmvae,
    belief: Belief,
    seen: jax.Array,
    features: jax.Array,
    modality: int,
) -> Belief:
    """Writes a look by one sensor, `modality` its index, with its `[D_m]` features.

    In place, or by the filter if `params` has one: it needs no `seen`.

    Raises:
      ValueError: if there is no such modality; see also `fuse`.
    """
    if FILTER in params:
        return filtering.update(params[FILTER], model, belief, features, modality)
    checks.require_index("modality", modality, len(model.modalities))
    of_all = tuple(features if m == modality else None for m in range(len(model.modalities)))
    return fuse(params, model, belief, seen, of_all)


def most_likely_class(params: Params, class_means: jax.Array, belief: Belief) -> jax.Array:
    """Class that an entry of the map shows, `[]` int32.

    Args:
      params: of the JMVAE, with those of the filter if there is one.
      class_means: `[C, D]` mean of the joint posterior of each class.
      belief: `[D]`.

    Returns:
      The nearest class; of a map that a filter writes, that of the highest weight.
    """
    if FILTER in params:
        return jnp.argmax(filtering.weights(params[FILTER], belief))
    return metrics.nearest_class(belief, class_means)


def unseen(model: Jmvae, variance: float) -> Belief:
    """Entry of an unseen PoI: mean 0 and the given variance in each dimension."""
    checks.require_positive("variance", variance)
    return Belief(
        jnp.zeros(model.latent_size), jnp.full(model.latent_size, jnp.sqrt(jnp.float32(variance)))
    )

"""Fusion in place, the paper's (Korthals et al. 2018, Sec. III and Fig. 3); see also `filter`."""

import itertools
from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import JmvaeConfig
from jaxsense.core import checks, supervised
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Features, Key, Samples, pytree
from jaxsense.vae import jmvae
from jaxsense.vae.jmvae import Jmvae
from jaxsense.vae.readout import Readout


@pytree
class InPlace:
    """The paper's fusion: a look replaces the belief.

    The map does not keep features of earlier looks. Those of the other modalities are decoded from
    the mean of the belief, and encoded together with the new ones. For the attributes see `Filter`.
    """

    params: Params
    classes: Belief
    prior: Belief
    readout: Readout
    model: Jmvae = struct.field(pytree_node=False)

    @property
    def accumulates(self) -> bool:
        """False: a look replaces the sensor's look before."""
        return False

    def update(
        self,
        belief: Belief,
        seen: Bool[Array | np.ndarray, " M"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Belief:
        """Belief after one more look, see `Fusion.update` and `fuse`; `weight` is not used.

        Raises:
          ValueError: if there is no such modality; see also `fuse`.
        """
        del weight
        checks.require_modality(modality, self.model.modalities)
        number = len(self.model.modalities)
        of_all = tuple(features if m == modality else None for m in range(number))
        return fuse(self.params, self.model, belief, seen, of_all)

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Posterior `q(z|x)`, see `Fusion.together`."""
        for modality in looks:
            checks.require_modality(modality, self.model.modalities)
        features = tuple(looks.get(m) for m in range(len(self.model.modalities)))
        return jmvae.posterior(self.params, self.model, features)

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class according to a `[D]` belief."""
        return self.readout.class_probabilities(belief, self.prior)

    def most_likely_class(self, belief: Belief) -> Int[Array, ""]:
        """Most likely class according to a `[D]` belief, int32."""
        return jnp.argmax(self.class_probabilities(belief))


@checks.typed
def fuse(
    params: Params,
    model: Jmvae,
    belief: Belief,
    seen: Bool[Array | np.ndarray, " M"],
    features: Features,
) -> Belief:
    """Fuses looks by one sensor, or by several together, in place.

    The first look yields `q(z|x)`. The old belief enters the new one only through the decoder.

    Args:
      params: of the JMVAE.
      model: shape of the JMVAE.
      belief: `[D]` before the looks.
      seen: `[M]` bool, which modalities have looked before.
      features: for each modality `[D_m]` new features, or None where it has not looked.

    Raises:
      ValueError: if `features` has another length than `model.modalities`, all are None, or one
        does not hold probabilities; if the belief is not finite or its width not positive.
    """
    chex.assert_shape(seen, (len(model.modalities),))
    checks.require_belief("belief", belief, model.latent_size)
    generated = jmvae.decode(params, model, belief.mean)
    is_new = np.array([new is not None for new in features])
    others = np.flatnonzero(~is_new).tolist()
    fused = belief
    # One encoder for each set of modalities that may have looked before; `seen` selects one.
    for size in range(len(others) + 1):
        for subset in itertools.combinations(others, size):
            inputs = tuple(generated[m] if m in subset else new for m, new in enumerate(features))
            candidate = jmvae.posterior(params, model, inputs)
            is_subset = np.array([m in subset for m in range(len(features))])
            applies = jnp.all(is_new | (jnp.asarray(seen) == is_subset))
            fused = jax.tree.map(lambda new, old: jnp.where(applies, new, old), candidate, fused)  # noqa: B023
    for name, new in zip(model.modalities, features, strict=True):
        if new is not None:
            checks.require_probabilities(f"features of {name}", new)
    return fused


@pytree
class Decoding:
    """Problem of fitting the decoders to what fusion in place decodes: means of posteriors.

    The JMVAE decodes draws from `q(z|all)`, few of which lie near the mean of `q(z|s)` for a subset
    s of the modalities. The encoders stay as they are.
    """

    config: JmvaeConfig
    params: Params
    bank: Samples
    model: Jmvae = struct.field(pytree_node=False)

    def draw(self, key: Key, number: int) -> jmvae.Drawn:
        """Features from the bank, see `jmvae.Fitting`."""
        return jmvae.Fitting(self.config, self.bank, self.model).draw(key, number)

    def loss(self, params: Params, drawn: jmvae.Drawn, step: Int[Array, ""]) -> Float[Array, ""]:
        """Mean of `sum_s sum_{m in s} w_m |x_m - decode_m(E q(z|s))|^2 / 2` over a batch."""
        del step
        _, features = drawn
        whole, weights = {**self.params, "decoders": params}, self.config.reconstruction_weights
        total = jnp.float32(0.0)
        for subset in self.model.subsets:
            given = tuple(x if m in subset else None for m, x in enumerate(features))
            decoded = jax.vmap(self._decoded, (None, -1), -1)(whole, given)
            for m in subset:
                squares = jnp.sum((features[m] - decoded[m]) ** 2, axis=0)
                total += weights[m] * 0.5 * jnp.mean(squares)
        return total

    def _decoded(self, params: Params, features: Features) -> tuple[Array, ...]:
        """`[D_m]` features decoded from the mean of the posterior of some."""
        mean, _ = jmvae.encode(params, self.model, features)
        return jmvae.decode(params, self.model, mean)


def train_decoders(
    key: Key, params: Params, model: Jmvae, bank: Samples, config: JmvaeConfig
) -> Params:
    """Parameters of a JMVAE whose decoders have learned what fusion in place decodes."""
    state = supervised.start(params["decoders"], config)
    state, _ = supervised.fit(key, state, Decoding(config, params, bank, model), config.steps)
    return {**params, "decoders": state.params}


@checks.typed
def prior(model: Jmvae, variance: float) -> Belief:
    """The belief before any look, with mean 0 and the `variance` in each latent dimension."""
    checks.require_positive("variance", variance)
    return Belief(
        jnp.zeros(model.latent_size), jnp.full(model.latent_size, jnp.sqrt(jnp.float32(variance)))
    )

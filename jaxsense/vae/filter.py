"""Fusion by a filter: one update per look, for any number of looks in any order.

The JMVAE's alpha term draws the posterior of each subset of the modalities to the joint one. For
histories of looks instead of subsets, it is `E[sum_t KL(q*_c || q_t)]`: q*_c is the joint
posterior of the true class c, and q_t the belief after t looks. Among Gaussians, q_t minimises this
divergence if it has the moments of the mixture `sum_c w_c q*_c`, weighted by the probabilities of
the classes after the looks. So the mean shows which classes are plausible, and the width how
uncertain the belief is. Log-likelihoods that are linear in the moments of the classes keep the
weights among those that `readout` reads without error: a belief is a sufficient memory.
"""

from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.learning import FilterConfig
from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Belief, Key, Samples, product, pytree
from jaxsense.vae import gaussian, readout
from jaxsense.vae.jmvae import Jmvae
from jaxsense.vae.readout import Readout

_MIN_FEATURE = 1e-6
_LOOKS, _BATCH = 6, 256  # of each history, histories of each step

Drawn = tuple[jax.Array, jax.Array, tuple[jax.Array, ...]]
"""Classes `[steps, B]`, sensors `[steps, T, B]`, and for each modality `[steps, D_m, T, B]`."""


@pytree
class Filter:
    """Fusion by a learned Bayes filter, which accumulates looks in the belief.

    Attributes:
      networks: for each modality, from features to K coefficients of the classes' moments in the
        log-likelihood.
      classes: `[C, D]` mean joint posterior of each class.
      prior: `[D]` belief before any look.
      readout: reads class probabilities from beliefs.
      model: shape of the JMVAE.
      hidden: sizes of the networks' hidden layers.
    """

    networks: dict[str, Params]
    classes: Belief
    prior: Belief
    readout: Readout
    model: Jmvae = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def accumulates(self) -> bool:
        """True: looks add up."""
        return True

    def update(
        self,
        belief: Belief,
        seen: Bool[Array | np.ndarray, " M"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Belief:
        """Belief after one more look, see `Fusion.update`; `seen` is not used.

        Raises:
          ValueError: if there is no such modality, `features` are not probabilities, the belief is
            not finite or its width not positive, or the weight is not from 0 to 1.
        """
        del seen
        model = self.model
        checks.require_modality(modality, model.modalities)
        name = f"features of {model.modalities[modality]}"
        checks.require_shape(name, features, (model.feature_sizes[modality],))
        checks.require_probabilities("features", features)
        checks.require("weight", weight, lambda x: (x >= 0) & (x <= 1), "must be from 0 to 1")
        found = self.log_likelihood(self.networks, features, modality)
        before = jnp.log(self.class_probabilities(belief))
        return readout.mixture(self.classes, jax.nn.softmax(before + weight * found))

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """See `Fusion.together`."""
        belief, nobody = self.prior, jnp.zeros(len(self.model.modalities), bool)
        for modality, features in looks.items():
            belief = self.update(belief, nobody, features, modality)
        return belief

    def log_likelihood(
        self, params: dict[str, Params], features: Float[Array, "D_m *B"], modality: int
    ) -> Float[Array, "C *B"]:
        """Log-likelihood of each class given one look, linear in the classes' whitened moments.

        Args:
          params: of the networks, by modality.
          features: `[D_m]` probabilities of the labels, or `[D_m, B]`.
          modality: index of the sensor; static.
        """
        moments = self.readout.of_classes
        network = MLP(self.hidden, moments.shape[1])
        logarithm = jnp.log(jnp.maximum(features, _MIN_FEATURE))
        found = networks.apply(network, params[self.model.modalities[modality]], logarithm)
        return product(moments, found)

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class according to a `[D]` belief."""
        return self.readout.class_probabilities(belief, self.prior)

    def most_likely_class(self, belief: Belief) -> Int[Array, ""]:
        """Most likely class according to a `[D]` belief, int32."""
        return jnp.argmax(self.class_probabilities(belief))


def init(
    key: Key, model: Jmvae, classes: Belief, prior: Belief, hidden: tuple[int, ...] = (32,)
) -> Filter:
    """Untrained filter, which looks do not update; see `Filter`."""
    chex.assert_shape([classes.mean, prior.mean], (..., model.latent_size))
    read = readout.make(classes, readout.directions(model.feature_sizes))
    network = MLP(hidden, read.of_classes.shape[1])
    keys = jax.random.split(key, len(model.modalities))
    of_each = zip(keys, model.modalities, model.feature_sizes, strict=True)
    # From zero: probabilities that random log-likelihoods have saturated would hardly learn.
    silent = {
        name: networks.scale_last(network, networks.init(k, network, size), 0.0)
        for k, name, size in of_each
    }
    return Filter(silent, classes, prior, read, model, hidden)


@pytree
class Fitting:
    """Problem of fitting a filter's networks to random histories of looks from a bank."""

    config: FilterConfig
    filter: Filter
    bank: Samples

    def draw(self, key: Key, number: int) -> Drawn:
        """Histories of looks, see `Problem.draw`."""
        bank, shape = self.bank, (number, _LOOKS, _BATCH)
        class_key, sensor_key, *row_keys = jax.random.split(key, 2 + len(bank))
        classes = jax.random.randint(class_key, (number, _BATCH), 0, len(bank[0]))
        sensors = jax.random.randint(sensor_key, shape, 0, len(bank))
        looks = tuple(
            jnp.moveaxis(x[classes[:, None], jax.random.randint(k, shape, 0, x.shape[1])], -1, 1)
            for x, k in zip(bank, row_keys, strict=True)
        )
        return classes, sensors, looks

    def loss(
        self, params: dict[str, Params], drawn: Drawn, step: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Mean divergence from the joint posterior of the true class to the beliefs."""
        del step
        true_class, sensor, looks = drawn
        number, classes = len(self.bank), self.filter.classes
        flat = [
            self.filter.log_likelihood(params, x.reshape(len(x), -1), m)
            for m, x in enumerate(looks)
        ]
        found = jnp.stack(flat).reshape(number, -1, sensor.shape[0], sensor.shape[1])
        is_used = sensor[None, None] == jnp.arange(number)[:, None, None, None]
        added = jnp.sum(jnp.where(is_used, found, 0.0), axis=0)
        probabilities = jax.nn.softmax(jnp.cumsum(added, axis=1), axis=0)
        mix = jax.vmap(jax.vmap(lambda p: readout.mixture(classes, p), -1, -1), -1, -1)
        truth = jax.tree.map(lambda x: x[true_class].T[:, None], classes)  # [D, 1, B]
        beliefs = mix(probabilities)  # [D, T, B]
        p, q = ((x.mean, 2 * jnp.log(x.std)) for x in (truth, beliefs))
        return jnp.mean(gaussian.kl_divergence(*p, *q))

"""Fusion of looks: in place, as in the paper, or by a filter.

In place (Korthals et al. 2018, Sec. III and Fig. 3), a look replaces the belief: features of the
other modalities are decoded from its mean, and encoded together with the new ones.

The filter takes one update per look, for any number of looks in any order. The JMVAE's alpha term
draws the posterior of each subset of the modalities to the joint one. For histories of looks
instead of subsets, it is `E[sum_t KL(q*_c || q_t)]`: q*_c is the joint posterior of the true class
c, and q_t the belief after t looks. Among Gaussians, q_t minimises this divergence if it has the
moments of the mixture `sum_c w_c q*_c`, weighted by the probabilities of the classes after the
looks. So the mean shows which classes are plausible, and the width how uncertain the belief is.
Log-likelihoods that are linear in the moments of the classes keep the weights among those that
`readout` reads without error: a belief is a sufficient memory.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config.learning import FilterConfig, JmvaeConfig
from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.supervised import Problem
from jaxsense.core.types import Belief, Features, Key, Samples, product, pytree
from jaxsense.vae import gaussian, jmvae, readout
from jaxsense.vae.jmvae import Jmvae
from jaxsense.vae.readout import Readout

_MIN_FEATURE = 1e-6
_LOOKS, _BATCH = 6, 256  # of each history, histories of each step
_LEARNING_RATE = 5e-3  # of the filter, in the first step

Drawn = tuple[jax.Array, jax.Array, tuple[jax.Array, ...]]
"""Classes `[steps, B]`, sensors `[steps, T, B]`, and for each modality `[steps, D_m, T, B]`."""


@pytree
class Reader:
    """What fusions read classes from beliefs with.

    Attributes:
      classes: `[C, D]` mean joint posterior of each class.
      prior: `[D]` belief before any look.
      readout: reads class probabilities from beliefs.
    """

    classes: Belief
    prior: Belief
    readout: Readout
    model: Jmvae = struct.field(pytree_node=False)

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class according to a belief."""
        return self.readout.class_probabilities(belief, self.prior)


@pytree
class InPlace(Reader):
    """The paper's fusion: a look replaces the belief, and the map keeps no earlier features."""

    params: Params
    accumulates = False

    def update(
        self,
        belief: Belief,
        seen: Bool[Array | np.ndarray, " M"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Belief:
        """Belief after one more look, see `Fusion.update`; `weight` is not used.

        The first look yields `q(z|x)`. The old belief enters the new one only through the decoder.
        """
        del weight
        model = self.model
        checks.require_modality(modality, model.modalities)
        chex.assert_shape(seen, (len(model.modalities),))
        checks.require_belief("belief", belief, model.latent_size)
        checks.require_probabilities(f"features of {model.modalities[modality]}", features)
        generated, fused = jmvae.decode(self.params, model, belief.mean), belief
        others = [m for m in range(len(model.modalities)) if m != modality]
        has_looked = jnp.asarray(seen)[np.array(others, int)]
        sizes = range(len(others) + 1)
        # One encoder for each set of the others that may have looked; `seen` selects one.
        for subset in itertools.chain(*(itertools.combinations(others, n) for n in sizes)):
            candidate = self.together({**{m: generated[m] for m in subset}, modality: features})
            applies = jnp.all(has_looked == np.isin(others, subset))
            fused = jax.tree.map(functools.partial(jnp.where, applies), candidate, fused)
        return fused

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Posterior `q(z|x)`, see `Fusion.together`."""
        for modality in looks:
            checks.require_modality(modality, self.model.modalities)
        features = tuple(looks.get(m) for m in range(len(self.model.modalities)))
        return jmvae.posterior(self.params, self.model, features)


def decoding(
    config: JmvaeConfig, bank: Samples, model: Jmvae, params: Params
) -> Problem[jmvae.Drawn]:
    """The fit of the decoders to what fusion in place decodes: means of posteriors.

    The JMVAE decodes draws from `q(z|all)`, few of which lie near the mean of `q(z|s)` for a subset
    s of the modalities. The encoders, of `params`, stay as they are. The loss is the mean of
    `sum_s sum_{m in s} w_m |x_m - decode_m(E q(z|s))|^2 / 2`.
    """

    def decoded(params: Params, features: Features) -> tuple[Array, ...]:
        mean, _ = jmvae.encode(params, model, features)
        return jmvae.decode(params, model, mean)

    def loss(decoders: Params, drawn: jmvae.Drawn, step: Int[Array, ""]) -> Float[Array, ""]:
        del step
        _, features = drawn
        whole, total = {**params, "decoders": decoders}, jnp.float32(0.0)
        for subset in model.subsets:
            given = tuple(x if m in subset else None for m, x in enumerate(features))
            found = jax.vmap(decoded, (None, -1), -1)(whole, given)
            for m in subset:
                squares = jnp.sum((features[m] - found[m]) ** 2, axis=0)
                total += config.reconstruction_weights[m] * 0.5 * jnp.mean(squares)
        return total

    return dataclasses.replace(jmvae.problem(config, bank, model), loss=loss)


@checks.typed
def prior(model: Jmvae, variance: float) -> Belief:
    """The belief before any look, with mean 0 and the `variance` in each latent dimension."""
    checks.require_positive("variance", variance)
    return Belief(
        jnp.zeros(model.latent_size), jnp.full(model.latent_size, jnp.sqrt(jnp.float32(variance)))
    )


@pytree
class Filter(Reader):
    """A learned Bayes filter, which accumulates looks in the belief.

    Attributes:
      networks: for each modality, from features to K coefficients of the classes' moments in the
        log-likelihood.
      hidden: sizes of the networks' hidden layers.
    """

    networks: dict[str, Params]
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    accumulates = True

    def update(
        self,
        belief: Belief,
        seen: Bool[Array | np.ndarray, " M"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Belief:
        """Belief after one more look, see `Fusion.update`; `seen` is not used."""
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
          features: probabilities of the labels.
        """
        moments = self.readout.of_classes
        network = MLP(self.hidden, moments.shape[1])
        logarithm = jnp.log(jnp.maximum(features, _MIN_FEATURE))
        found = networks.apply(network, params[self.model.modalities[modality]], logarithm)
        return product(moments, found)


def init_filter(
    key: Key, model: Jmvae, classes: Belief, prior: Belief, hidden: tuple[int, ...] = (32,)
) -> Filter:
    """Untrained filter, which looks do not update."""
    chex.assert_shape([classes.mean, prior.mean], (..., model.latent_size))
    read = readout.make(classes, model.feature_sizes)
    network = MLP(hidden, read.of_classes.shape[1])
    keys = jax.random.split(key, len(model.modalities))
    of_each = zip(keys, model.modalities, model.feature_sizes, strict=True)
    # From zero: probabilities that random log-likelihoods have saturated would hardly learn.
    silent = {
        name: networks.scale_last(network, networks.init(k, network, size), 0.0)
        for k, name, size in of_each
    }
    return Filter(classes, prior, read, model, silent, hidden)


def filtering(config: FilterConfig, untrained: Filter, bank: Samples) -> Problem[Drawn]:
    """The fit of a filter's networks to random histories of looks from a bank.

    The loss is the mean divergence from the joint posterior of the true class to the beliefs.
    """
    classes = untrained.classes

    def draw(key: Key, number: int) -> Drawn:
        shape = number, _LOOKS, _BATCH
        class_key, sensor_key, *row_keys = jax.random.split(key, 2 + len(bank))
        true_class = jax.random.randint(class_key, (number, _BATCH), 0, len(bank[0]))
        sensors = jax.random.randint(sensor_key, shape, 0, len(bank))
        looks = tuple(
            jnp.moveaxis(x[true_class[:, None], jax.random.randint(k, shape, 0, x.shape[1])], -1, 1)
            for x, k in zip(bank, row_keys, strict=True)
        )
        return true_class, sensors, looks

    def loss(params: dict[str, Params], drawn: Drawn, step: Int[Array, ""]) -> Float[Array, ""]:
        del step
        true_class, sensor, looks = drawn
        flat = [
            untrained.log_likelihood(params, x.reshape(len(x), -1), m) for m, x in enumerate(looks)
        ]
        found = jnp.stack(flat).reshape(len(bank), -1, *sensor.shape)
        is_used = sensor[None, None] == jnp.arange(len(bank))[:, None, None, None]
        added = jnp.sum(jnp.where(is_used, found, 0.0), axis=0)
        probabilities = jax.nn.softmax(jnp.cumsum(added, axis=1), axis=0)
        mix = jax.vmap(jax.vmap(lambda p: readout.mixture(classes, p), -1, -1), -1, -1)
        truth = jax.tree.map(lambda x: x[true_class].T[:, None], classes)  # [D, 1, B]
        beliefs = mix(probabilities)  # [D, T, B]
        p, q = ((x.mean, 2 * jnp.log(x.std)) for x in (truth, beliefs))
        return jnp.mean(gaussian.kl_divergence(*p, *q))

    return Problem(config.steps, _LEARNING_RATE, draw, loss)

"""Ways of fusing looks that are not in the package, and what measures all of them alike.

The package's own are `vae.InPlace` and `vae.Filter`.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense import Belief, Fusion, pytree, vae
from jaxsense.dqn import rewards
from jaxsense.dqn.map_agent import MapAgent
from jaxsense.dqn.team_mdp import Team
from jaxsense.vae.bayes import Bayes
from jaxsense.vae.readout import MIN_PROBABILITY

_Seen = Bool[Array | np.ndarray, " M"]
_Weight = Float[Array, ""] | float


@pytree
class LogOdds:
    """Exact Bayes without a latent space: a belief holds C - 1 log-odds against the last class.

    Its standard deviations are 1 and carry nothing.

    Attributes:
      bayes: the exact Bayes filter over the classes.
    """

    bayes: Bayes

    @property
    def accumulates(self) -> bool:
        """True: looks add up."""
        return True

    @property
    def classes(self) -> Belief:
        """Log-odds `[C, C - 1]` of classes that are as certain as a map can read them."""
        certain = jnp.eye(self.bayes.labels.shape[1])
        return _of_log_odds(-jnp.log(MIN_PROBABILITY) * (certain[:, :-1] - certain[:, -1:]))

    @property
    def prior(self) -> Belief:
        """Log-odds `[C - 1]` of equally likely classes."""
        return _of_log_odds(jnp.zeros(self.bayes.labels.shape[1] - 1))

    def update(
        self,
        belief: Belief,
        seen: _Seen,
        features: Float[Array, " D_m"],
        modality: int,
        weight: _Weight = 1.0,
    ) -> Belief:
        """Belief after one more look.

        Args:
          belief: `[C - 1]` before the look.
          seen: not used.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: see `Fusion.update`.
        """
        del seen
        found = self.bayes.log_likelihoods(features, modality)
        return _of_log_odds(belief.mean + weight * (found[:-1] - found[-1]))

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Belief after looks by several sensors, `[D_m]` features by modality."""
        return _one_after_the_other(self, looks, len(self.bayes.labels))

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class, each at least about `readout.MIN_PROBABILITY`."""
        exact = jax.nn.softmax(jnp.append(belief.mean, 0.0))
        found = jnp.maximum(exact, MIN_PROBABILITY)
        return found / jnp.sum(found)

    def most_likely_class(self, belief: Belief) -> Int[Array, ""]:
        """Most likely class, int32."""
        return jnp.argmax(jnp.append(belief.mean, 0.0))


@pytree
class Product(vae.InPlace):
    """A look multiplies the belief by the posterior that it yields alone (Hinton 2002).

    Attributes:
      prior: `[D]` belief before any look, which all posteriors contain and which counts once.
    """

    @property
    def accumulates(self) -> bool:
        """True: looks add up."""
        return True

    def update(
        self,
        belief: Belief,
        seen: _Seen,
        features: Float[Array, " D_m"],
        modality: int,
        weight: _Weight = 1.0,
    ) -> Belief:
        """Belief after one more look, see `vae.product_of_experts`.

        Args:
          belief: `[D]` before the look.
          seen: not used.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: not used.
        """
        del seen, weight
        return vae.product_of_experts(belief, self.together({modality: features}), self.prior)


@pytree
class Mixture:
    """The equal mixture of the posteriors of all looks (Shi et al. 2019), as one Gaussian.

    A belief holds the mixture's moments, updated by a running mean, and after its mean the number
    of looks, `[D + 1]`. The last standard deviation is 1 and carries nothing.

    Attributes:
      experts: yields the posterior of each look alone.
    """

    experts: vae.InPlace

    @property
    def accumulates(self) -> bool:
        """True: looks add up."""
        return True

    @property
    def classes(self) -> Belief:
        """Mean joint posterior of each class, `[C, D + 1]`, as if after one look."""
        return _counted(self.experts.classes, 1.0)

    @property
    def prior(self) -> Belief:
        """Belief before any look, `[D + 1]`."""
        return _counted(self.experts.prior, 0.0)

    def update(
        self,
        belief: Belief,
        seen: _Seen,
        features: Float[Array, " D_m"],
        modality: int,
        weight: _Weight = 1.0,
    ) -> Belief:
        """Belief after one more look.

        Args:
          belief: `[D + 1]` before the look.
          seen: not used.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: not used.
        """
        del seen, weight
        old, new = _uncounted(belief), self.experts.together({modality: features})
        count = belief.mean[-1] + 1
        mean = old.mean + (new.mean - old.mean) / count
        of_old, of_new = ((x.std**2 + (x.mean - mean) ** 2) / count for x in (old, new))
        return _counted(Belief(mean, jnp.sqrt((count - 1) * of_old + of_new)), count)

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Belief after looks by several sensors, `[D_m]` features by modality."""
        return _one_after_the_other(self, looks, len(self.experts.model.modalities))

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class, read as from the beliefs of the package."""
        return self.experts.class_probabilities(_uncounted(belief))

    def most_likely_class(self, belief: Belief) -> Int[Array, ""]:
        """Class whose joint posterior is nearest, int32."""
        return self.experts.most_likely_class(_uncounted(belief))


@pytree
class Audited:
    """Another fusion, with the exact posterior kept next to it.

    The mean of a belief holds the other fusion's mean and standard deviation, the class
    probabilities read from these, and the logarithms of the exact posterior; its standard
    deviations are 1. So the policy sees the map, and the reward knows the truth about the looks.

    Attributes:
      fusion: the other fusion.
      bayes: the exact Bayes filter over the classes.
    """

    fusion: Fusion
    bayes: Bayes

    @property
    def accumulates(self) -> bool:
        """Whether looks add up in the other fusion."""
        return self.fusion.accumulates

    @property
    def classes(self) -> Belief:
        """Each class with certainty."""
        certain = jnp.log(jnp.maximum(jnp.eye(self._num_classes), MIN_PROBABILITY))
        return jax.vmap(self._joined)(self.fusion.classes, certain)

    @property
    def prior(self) -> Belief:
        """Belief before any look."""
        return self._joined(self.fusion.prior, self.bayes.prior)

    def update(
        self,
        belief: Belief,
        seen: _Seen,
        features: Float[Array, " D_m"],
        modality: int,
        weight: _Weight = 1.0,
    ) -> Belief:
        """Belief after one more look, of both.

        Args:
          belief: before the look.
          seen: `[M]` bool, which modalities have looked before.
          features: `[D_m]` probabilities of the labels.
          modality: index of the sensor; static.
          weight: see `Fusion.update`.
        """
        mean, std = jnp.split(belief.mean[: -2 * self._num_classes], 2)
        after = self.fusion.update(Belief(mean, std), seen, features, modality, weight)
        exact = self.bayes.update(self.log_posterior(belief), features, modality, weight)
        return self._joined(after, exact)

    def together(self, looks: Mapping[int, Float[Array, "_"]]) -> Belief:
        """Belief after looks by several sensors, `[D_m]` features by modality."""
        return _one_after_the_other(self, looks, len(self.bayes.labels))

    def class_probabilities(self, belief: Belief) -> Float[Array, " C"]:
        """Probability of each class according to the other fusion."""
        return belief.mean[-2 * self._num_classes : -self._num_classes]

    def most_likely_class(self, belief: Belief) -> Int[Array, ""]:
        """Most likely class according to the other fusion, int32."""
        return jnp.argmax(self.class_probabilities(belief))

    def log_posterior(self, belief: Belief) -> Float[Array, " C"]:
        """Logarithms of the exact posterior."""
        return belief.mean[-self._num_classes :]

    @property
    def _num_classes(self) -> int:
        return self.bayes.labels.shape[1]

    def _joined(self, belief: Belief, log_posterior: Float[Array, " C"]) -> Belief:
        probabilities = self.fusion.class_probabilities(belief)
        mean = jnp.concatenate([belief.mean, belief.std, probabilities, log_posterior])
        return Belief(mean, jnp.ones_like(mean))


@pytree
class ExactNats(rewards.Nats):
    """The entropy that a look removes from the exact posterior, minus the cost of the look.

    For beliefs of `Audited`.
    """

    def information(self, belief: Belief, probabilities: Float[Array, " C"]) -> Float[Array, ""]:
        """Negative entropy of the exact posterior, in nats.

        Args:
          belief: of `Audited`.
          probabilities: `[C]` class probabilities of the map, of which only the number matters.
        """
        exact = jnp.exp(belief.mean[-len(probabilities) :])
        return super().information(belief, exact)


@pytree
class ProbabilityAgent(MapAgent):
    """An agent of the map MDP whose network reads class probabilities, for any fusion.

    Attributes:
      fusion: reads them from beliefs.
    """

    fusion: Fusion

    @property
    def num_inputs(self) -> int:
        """N * C."""
        return self.num_pois * len(self.fusion.classes.mean)

    def observe(self, belief: Belief, team: Team, robot: Int[Array, ""]) -> Float[Array, " S"]:
        """Class probabilities of all PoIs, `[N * C]`.

        Args:
          belief: `[N, D]` the map.
          team: not used.
          robot: not used.
        """
        del team, robot
        return jax.vmap(self.fusion.class_probabilities)(belief).reshape(-1)


def _of_log_odds(log_odds: Float[Array, "... K"]) -> Belief:
    return Belief(log_odds, jnp.ones_like(log_odds))


def _counted(belief: Belief, count: jax.Array | float) -> Belief:
    """A belief with the number of looks after its mean."""
    shape = (*belief.mean.shape[:-1], 1)
    mean = jnp.concatenate([belief.mean, jnp.full(shape, count)], axis=-1)
    return Belief(mean, jnp.concatenate([belief.std, jnp.ones(shape)], axis=-1))


def _uncounted(belief: Belief) -> Belief:
    return jax.tree.map(lambda x: x[:-1], belief)


def _one_after_the_other(
    fusion: Fusion, looks: Mapping[int, Float[Array, "_"]], number: int
) -> Belief:
    """Belief after looks by several of a number of sensors."""
    belief, nobody = fusion.prior, jnp.zeros(number, bool)
    for modality, features in looks.items():
        belief = fusion.update(belief, nobody, features, modality)
    return belief

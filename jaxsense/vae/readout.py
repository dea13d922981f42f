"""Class probabilities: exact Bayes, held as a belief, and read from a belief.

The Gaussian with the moments of the mixture `sum_c w_c q*_c` of the classes' joint posteriors holds
the probabilities `w_c`: its mean and mean square are linear in them. Of all probabilities with
these moments, those of maximum entropy are read (Jaynes 1957, Physical Review 106(4), Sec. 2):
`w_c ~ exp(theta . T(c))`, where `T(c)` holds the mean and mean square of `q*_c`. They are exact if
the log-posterior of the looks is linear in `T`, as it is where the labels of each sensor have
latent directions of their own.
"""

from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Belief, Index, product, pytree

_MIN_FEATURE = 1e-12  # that a class is not excluded by
_MIN_PROBABILITY = 1e-6  # that can be read; float32 moments hold no smaller ones
_PLAUSIBLE_DISTANCE = 2.0  # standard deviations
_STEPS = 25  # of Newton's method
_LONGEST = 2.0  # step, in whitened coordinates; with longer ones it diverges near certainty
_DAMPING = 1e-5
_MAX_UNROLLED = 4  # eliminations; a program with many takes minutes to compile
_THRESHOLD = 0.05  # of the largest singular value; smaller differences of moments are noise


@pytree
class Bayes:
    """Exact Bayes over the classes; `labels` `[M, C]` int32 of each class in each modality."""

    labels: Int[Array, "M C"]

    @property
    def prior(self) -> Float[Array, " C"]:
        """Logarithms of equal probabilities."""
        number = self.labels.shape[1]
        return jnp.full(number, -jnp.log(number), jnp.float32)

    def log_likelihoods(self, features: Float[Array, " D_m"], modality: int) -> Float[Array, " C"]:
        """Log-likelihood of each class given one look, up to a constant.

        In the detector's training each label was as frequent as the classes that have it, so
        `p(x | class) ~ p(label | x) / p(label)`.
        """
        chex.assert_rank(features, 1)
        checks.require_probabilities("features", features)
        labels = self.labels[modality]
        checks.require_index("labels", labels, len(features))
        prior = jnp.zeros(len(features)).at[labels].add(1 / len(labels))
        return jnp.log(jnp.maximum(features[labels], _MIN_FEATURE) / prior[labels])

    def update(
        self,
        log_posterior: Float[Array, " C"],
        features: Float[Array, " D_m"],
        modality: int,
        weight: Float[Array, ""] | float = 1.0,
    ) -> Float[Array, " C"]:
        """Normalised logarithms of the classes' probabilities after one more look.

        `weight` is the share of the look that is new evidence, see `core.novelty`.
        """
        chex.assert_shape(log_posterior, self.labels.shape[1:])
        # Rejects -inf (all classes excluded) and NaN.
        checks.require_finite("largest of log_posterior", jnp.max(log_posterior))
        found = self.log_likelihoods(features, modality)
        return jax.nn.log_softmax(log_posterior + weight * found)


@checks.typed
def mixture(classes: Belief, probabilities: Float[Array, " C"]) -> Belief:
    """The `[D]` belief with the moments of a mixture of the classes.

    Args:
      classes: `[C, D]` joint posterior of each class.
      probabilities: of sum 1.
    """
    chex.assert_shape(probabilities, classes.mean.shape[:1])
    checks.require_probabilities("probabilities", probabilities)
    mean = product(probabilities, classes.mean)
    spread = classes.std**2 + (classes.mean - mean[None]) ** 2
    return Belief(mean, jnp.sqrt(product(probabilities, spread)))


def divergence(held: Float[Array, " C"], read: Float[Array, " C"]) -> Float[Array, ""]:
    """Divergence in nats of the class probabilities read from a belief from those held by it."""
    return jnp.sum(held * (jnp.log(jnp.maximum(held, _MIN_PROBABILITY)) - jnp.log(read)))


@pytree
class Readout:
    """Reads class probabilities from beliefs, see `make`.

    Attributes:
      of_classes: `[C, K]` whitened moments of the classes.
      offset: `[2D]` mean of the classes' moments.
      whitening: `[2D, K]` from moments minus `offset` to whitened ones.
    """

    of_classes: Float[Array, "C K"]
    offset: Float[Array, " 2*D"]
    whitening: Float[Array, "2*D K"]

    def class_probabilities(self, belief: Belief, prior: Belief) -> Float[Array, " C"]:
        """Probabilities of the classes, each at least about 1e-6.

        In the `prior`, the belief before any look, all classes are equally likely.
        """
        checks.require_belief("belief", belief, len(prior.mean))
        found = jnp.maximum(self._of_maximum_entropy(belief), _MIN_PROBABILITY)
        apart = jnp.maximum(jnp.abs(belief.mean - prior.mean), jnp.abs(belief.std - prior.std))
        # Tolerates rounding between compiled programs.
        is_prior = jnp.all(apart <= 1e-5 * prior.std)
        return jnp.where(is_prior, 1 / len(found), found / jnp.sum(found))

    def _of_maximum_entropy(self, belief: Belief) -> jax.Array:
        """`[C]` probabilities whose moments are the belief's, by a damped Newton iteration."""
        target = product(_moments(belief) - self.offset, self.whitening)

        def step(_: int, theta: jax.Array) -> jax.Array:
            probabilities = jax.nn.softmax(product(self.of_classes, theta))
            expected = product(probabilities, self.of_classes)
            apart = self.of_classes - expected[None]
            hessian = product((apart * probabilities[:, None]).T, apart)
            move = _solve(hessian + _DAMPING * jnp.eye(len(theta)), target - expected)
            length = jnp.sqrt(jnp.sum(move**2) + 1e-12)
            return theta + move * jnp.minimum(1.0, _LONGEST / length)

        theta = jax.lax.fori_loop(0, _STEPS, step, jnp.zeros_like(target))
        return jax.nn.softmax(product(self.of_classes, theta))


def make(classes: Belief, numbers: Sequence[int] | None = None) -> Readout:
    """The readout of beliefs in `[C, D]` joint posteriors of classes.

    Args:
      numbers: of labels of each sensor, if log-posteriors depend on the labels alone: these have
        one direction fewer for each sensor. By default, K is the rank of the moments.
    """
    chex.assert_rank(classes.mean, 2)
    moments = _moments(classes)
    offset = jnp.mean(moments, axis=0)
    _, singular, axes = jnp.linalg.svd(moments - offset[None], full_matrices=False)
    # Centred moments span one direction fewer than there are classes.
    rank = min(len(moments) - 1, moments.shape[1])
    if numbers is not None:
        rank = max(1, min(rank, sum(number - 1 for number in numbers)))
    singular, axes = singular[:rank], axes[:rank]
    is_kept = singular > _THRESHOLD * singular[0]
    length = jnp.where(is_kept, jnp.sqrt(len(moments)) / jnp.where(is_kept, singular, 1.0), 0.0)
    whitening = axes.T * length[None]
    return Readout(product(moments - offset[None], whitening), offset, whitening)


def sigma_norm(std: Float[Array, "*S D"]) -> Float[Array, "*S"]:
    """Norm `||sigma||_2` of positive standard deviations, the colour of the paper's Fig. 4."""
    checks.require_positive("std", std)
    return jnp.linalg.norm(std, axis=-1)


def plausible_classes(belief: Belief, class_means: Float[Array, "C D"]) -> Bool[Array, " C"]:
    """Classes whose mean is within two standard deviations of a belief's.

    The nearest one always is plausible.
    """
    checks.require_belief("belief", belief)
    chex.assert_shape(class_means, (None, *belief.mean.shape))
    checks.require_finite("class_means", class_means)
    distance = jnp.linalg.norm((class_means - belief.mean[None]) / belief.std[None], axis=-1)
    return (distance <= _PLAUSIBLE_DISTANCE) | (distance <= jnp.min(distance))


def _moments(belief: Belief) -> Float[Array, "... K"]:
    """Means, then mean squares: linear in the weights of a mixture."""
    return jnp.concatenate([belief.mean, belief.std**2 + belief.mean**2], axis=-1)


def _solve(matrix: Float[Array, "K K"], vector: Float[Array, " K"]) -> Float[Array, " K"]:
    """Solves a positive definite system by elimination.

    `jnp.linalg.solve` calls a library for each of a batch of small systems.
    """

    def eliminate(k: Index, system: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        matrix, vector = system
        factor = matrix[:, k] / matrix[k, k]
        factor = factor.at[k].set(1 - 1 / matrix[k, k])
        return matrix - factor[:, None] * matrix[k][None, :], vector - factor * vector[k]

    system = matrix, vector
    if len(vector) > _MAX_UNROLLED:
        return jax.lax.fori_loop(0, len(vector), eliminate, system)[1]
    for k in range(len(vector)):
        system = eliminate(k, system)
    return system[1]

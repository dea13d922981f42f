"""Stages that measure detectors, the latent space and beliefs."""

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.core.types import Belief, Fusion, Key, Reliability, Samples, call
from jaxsense.models import make_bayes
from jaxsense.training.detections import Detections
from jaxsense.vae import gaussian, readout

_BINS = 15
_LOOKS = 6  # in a history of looks at one PoI
_HISTORIES = 1024  # to measure what a readout loses
_HISTORIES_AT_ONCE = 512
_ACTIVE_VARIANCE = 0.01
_UNAMBIGUOUS = 0.9  # share of looks that leave only the true class


def detector_metrics(
    key: Key, config: Config, *, detections: Detections
) -> tuple[dict[str, dict[str, Float[Array, ""]]], dict[str, Reliability]]:
    """Accuracy, expected calibration error `ece` and `nll` in nats, of held-out scans.

    Returns:
      These of each modality, and the points of its reliability diagram.
    """
    del key
    found, diagrams = {}, {}
    for name, looks in zip(config.modalities, detections.held_out, strict=True):
        labels = jnp.repeat(jnp.array(config.label_of_class(name)), looks.shape[1])
        probabilities = looks.reshape(-1, looks.shape[-1])
        diagrams[name] = diagram(probabilities, labels)
        found[name] = {
            "accuracy": jnp.mean(probabilities.argmax(axis=-1) == labels),
            "ece": calibration_error(diagrams[name]),
            "nll": negative_log_likelihood(probabilities, labels),
        }
    return found, diagrams


def negative_log_likelihood(
    probabilities: Float[Array, "S L"], labels: Int[Array, " S"]
) -> Float[Array, ""]:
    """Mean of `-log p(label)` in nats."""
    chex.assert_shape(probabilities, (len(labels), None))
    right = jnp.take_along_axis(probabilities, labels[:, None], axis=1)[:, 0]
    return -jnp.mean(jnp.log(jnp.maximum(right, 1e-12)))


def calibration_error(found: Reliability) -> Float[Array, ""]:
    """Expected calibration error of the most likely labels (Guo et al. 2017, Sec. 2).

    The difference between mean confidence and accuracy in a bin, averaged over all looks.
    """
    share = found.looks / jnp.sum(found.looks)
    return jnp.sum(share * jnp.abs(found.confidence - found.accuracy))


def diagram(probabilities: Float[Array, "S L"], labels: Int[Array, " S"]) -> Reliability:
    """Points of a reliability diagram with fifteen bins of equal width."""
    chex.assert_shape(probabilities, (len(labels), None))
    confidence = jnp.max(probabilities, axis=1)
    is_right = jnp.argmax(probabilities, axis=1) == labels
    bins = jnp.clip(jnp.ceil(confidence * _BINS).astype(jnp.int32) - 1, 0, _BINS - 1)
    of_looks = jnp.stack([confidence, is_right, jnp.ones(len(labels))])
    sums = jnp.zeros((3, _BINS)).at[:, bins].add(of_looks)
    confidence, accuracy = sums[:2] / jnp.maximum(sums[2], 1)[None]
    return Reliability(confidence, accuracy, sums[2])


def latent_space(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> tuple[dict[str, Belief], dict[str, Any]]:
    """Fuses held-out looks, alone and together, and measures the latent space.

    The s-th look at a class by one modality is paired with the s-th by another. Non-finite
    parameters and features raise no error: check the beliefs.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality alone, and metrics of them: `[C]` means
      of `sigma_norm`, `[C]` whether after most looks only the true class is plausible
      (`unambiguous`), and shares of looks after which just those are that the sensor cannot
      distinguish from it (`consistent`);
      the others are `[]`.
    """
    bank, class_means = detections.held_out, fusion.classes.mean
    joint = _beliefs(fusion, bank, range(len(bank)))
    alone = [_beliefs(fusion, bank, [m]) for m in range(len(bank))]
    found = {"joint": joint, **dict(zip(config.modalities, alone, strict=True))}
    same = np.eye(len(class_means), dtype=bool)
    consistent = {
        "joint": same,
        **{m: consistent_classes(config.label_of_class(m)) for m in config.modalities},
    }
    plausible = jax.vmap(jax.vmap(lambda b: readout.plausible_classes(b, class_means)))
    open_classes = {name: plausible(belief) for name, belief in found.items()}

    def share(
        is_open: Bool[Array, "C S K"], expected: Bool[np.ndarray, "C K"]
    ) -> Float[Array, " C"]:
        return jnp.all(is_open == expected[:, None], axis=-1).mean(axis=1)

    read = fusion.class_probabilities
    return found, {
        "active_units": active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        "sigma_norm": {n: readout.sigma_norm(b.std).mean(axis=1) for n, b in found.items()},
        "unambiguous": {n: share(x, same) > _UNAMBIGUOUS for n, x in open_classes.items()},
        "consistent": {n: share(x, consistent[n]) for n, x in open_classes.items()},
        "moment_matching_error": _mean_error(joint, alone, config),
        "readout_error": readout_error(key, config, bank, fusion.classes, read),
        "fusion": _fusion_metrics(fusion, bank, alone),
    }


def _beliefs(fusion: Fusion, bank: Samples, members: Iterable[int]) -> Belief:
    """`[C, S, D]` beliefs after looks by some of the modalities together."""
    order = tuple(members)  # that of a dictionary would be lost in `vmap`
    together = lambda features: fusion.together({m: features[m] for m in order})  # noqa: E731
    return jax.vmap(jax.vmap(together))(bank)


def active_units(mean: Float[Array, "S D"]) -> Int[Array, ""]:
    """Number of latent dimensions whose posterior means vary (Burda et al. 2016, Sec. 5.2)."""
    return jnp.sum(jnp.var(mean, axis=0) > _ACTIVE_VARIANCE)


def consistent_classes(label_of_class: tuple[int, ...]) -> Bool[np.ndarray, "C C"]:
    """Pairs of classes that a modality with these labels of the classes cannot distinguish."""
    labels = np.array(label_of_class)
    return labels[:, None] == labels[None, :]


def moment_matching_error(belief: Belief, components: Belief) -> Float[Array, ""]:
    """Distance of a `[D]` uni-modal posterior from the moment-matched `[K, D]` joint posteriors.

    Mean over the dimensions of `|mean difference|`, in matched standard deviations, plus
    `|log(std ratio)|`.
    """
    target = gaussian.moment_match(components)
    shift = jnp.abs(belief.mean - target.mean) / target.std
    return jnp.mean(shift + jnp.abs(jnp.log(belief.std / target.std)))


def _mean_error(joint: Belief, alone: list[Belief], config: Config) -> Float[Array, ""]:
    """Mean distance of uni-modal posteriors from their moment-matched targets."""
    errors = []
    for modality, belief in zip(config.modalities, alone, strict=True):
        labels = config.label_of_class(modality)
        for c, consistent in enumerate(consistent_classes(labels)):
            members = jnp.array(np.flatnonzero(consistent))
            parts = jax.tree.map(lambda x: x[members].reshape(-1, x.shape[-1]), joint)  # noqa: B023
            of_class = jax.tree.map(lambda x: x[c], belief)  # noqa: B023
            errors.append(jax.vmap(moment_matching_error, (0, None))(of_class, parts))
    return jnp.mean(jnp.stack(errors))


def _fusion_metrics(
    fusion: Fusion, bank: Samples, alone: list[Belief]
) -> dict[str, Float[Array, ""] | None]:
    """Quality of beliefs after a look by one modality and then by another."""
    found: dict[str, list[jax.Array]] = {"accuracy": [], "mean_error": [], "std_error": []}
    means = fusion.classes.mean
    for first, second in itertools.permutations(range(len(bank)), 2):
        seen = jnp.arange(len(bank)) == first
        update = lambda old, new: fusion.update(old, seen, new, second)  # noqa: B023, E731
        fused = jax.vmap(jax.vmap(update))(alone[first], bank[second])
        both = _beliefs(fusion, bank, (first, second))
        distances = jnp.linalg.norm(means[None, None] - fused.mean[:, :, None], axis=-1)
        found["accuracy"].append(distances.argmin(-1) == jnp.arange(len(means))[:, None])
        off = jnp.linalg.norm((fused.mean - both.mean) / both.std, axis=-1)
        found["mean_error"].append(off)
        found["std_error"].append(jnp.mean(jnp.abs(jnp.log(fused.std / both.std)), axis=-1))
    # A single modality has nothing to fuse.
    return {name: jnp.mean(jnp.array(values)) if values else None for name, values in found.items()}


def beliefs(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> dict[str, Array]:
    """Compares beliefs after random histories of looks with exact Bayes.

    All looks of a history are at one PoI, each by a random modality.

    Returns:
      The block `belief` of the summary as arrays. After 1 to K `looks`: `[K]` negative
      log-likelihoods of the true class and accuracies, of the map (`nll`, `accuracy`) and of exact
      Bayes on the same looks (`bayes_nll`, `bayes_accuracy`); and `doubt_correlation`, Pearson's
      correlation of `||sigma||` with the entropy of the exact posterior.
    """
    bank, exact = detections.held_out, make_bayes(config)
    number, num_histories = len(fusion.classes.mean), config.evaluation.num_histories

    def look(carry, drawn):
        belief, log_posterior, seen = carry
        modality, features = drawn

        def update(m: int):
            after = fusion.update(belief, seen, features[m], m)
            return after, exact.update(log_posterior, features[m], m)

        belief, log_posterior = call(update, modality, len(bank))
        seen = seen.at[modality].set(True)
        found = jnp.log(fusion.class_probabilities(belief))
        return (belief, log_posterior, seen), (found, log_posterior, jnp.linalg.norm(belief.std))

    def history(drawn: tuple[Key, jax.Array]):
        start = fusion.prior, exact.prior, jnp.zeros(len(bank), bool)
        return jax.lax.scan(look, start, draw_history(drawn[0], bank, drawn[1]))[1]

    truth = jnp.arange(num_histories) % number
    # All at once would take a third of a run's memory. Groups of one size are traced once.
    sizes = [s for s in range(1, _HISTORIES_AT_ONCE + 1) if num_histories % s == 0]
    found, log_posterior, norms = jax.lax.map(
        history, (jax.random.split(key, num_histories), truth), batch_size=sizes[-1]
    )
    right = jnp.arange(number)[None, None] == truth[:, None, None]
    entropy = -jnp.sum(jnp.exp(log_posterior) * log_posterior, axis=-1)

    def measured(logarithms: jax.Array) -> tuple[jax.Array, jax.Array]:
        nll = -jnp.mean(jnp.sum(jnp.where(right, logarithms, 0.0), axis=-1), axis=0)
        return nll, jnp.mean(jnp.argmax(logarithms, axis=-1) == truth[:, None], axis=0)

    (nll, accuracy), (bayes_nll, bayes_accuracy) = measured(found), measured(log_posterior)
    return {
        "looks": 1 + jnp.arange(_LOOKS),
        "nll": nll,
        "bayes_nll": bayes_nll,
        "accuracy": accuracy,
        "bayes_accuracy": bayes_accuracy,
        "doubt_correlation": jnp.corrcoef(norms.reshape(-1), entropy.reshape(-1))[0, 1],
    }


def draw_history(
    key: Key, bank: Samples, true_class: Int[Array, ""]
) -> tuple[Int[Array, " T"], tuple[Float[Array, "T D_m"], ...]]:
    """Draws a history of looks at a PoI.

    Returns:
      Modality of each look, and for each modality features of as many looks, of which only those by
      this modality count.
    """
    modality_key, *row_keys = jax.random.split(key, 1 + len(bank))
    modalities = jax.random.randint(modality_key, (_LOOKS,), 0, len(bank))
    looks = tuple(
        x[true_class, jax.random.randint(k, (_LOOKS,), 0, x.shape[1])]
        for x, k in zip(bank, row_keys, strict=True)
    )
    return modalities, looks


def readout_error(
    key: Key,
    config: Config,
    bank: Samples,
    classes: Belief,
    read: Callable[[Belief], Float[Array, " C"]],
) -> Float[Array, ""]:
    """Nats that class probabilities lose when a belief holds them.

    Mean divergence after the number of looks where it is largest. Exact Bayes gives the
    probabilities after each look of random histories; the belief with the moments of their mixture
    is as good as a belief can be.

    Args:
      bank: looks at every class.
      classes: `[C, D]` mean joint posterior of each class.
      read: class probabilities of a belief.
    """
    exact = make_bayes(config)

    def history(key: Key, true_class: jax.Array) -> jax.Array:
        def look(log_posterior: jax.Array, drawn):
            modality, features = drawn
            update = lambda m: exact.update(log_posterior, features[m], m)  # noqa: E731
            after = call(update, modality, len(bank))
            held = readout.mixture(classes, jnp.exp(after))
            return after, readout.divergence(jnp.exp(after), read(held))

        return jax.lax.scan(look, exact.prior, draw_history(key, bank, true_class))[1]

    truth = jnp.arange(_HISTORIES) % len(classes.mean)
    lost = jax.vmap(history)(jax.random.split(key, _HISTORIES), truth)
    return jnp.max(jnp.mean(lost, axis=0))

"""Stages that measure detectors, the latent space and beliefs."""

import itertools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.core.types import Belief, Fusion, Key, Reliability, Samples, call, pytree
from jaxsense.models import make_bayes
from jaxsense.training import histories
from jaxsense.training.detections import Detections
from jaxsense.vae import detectors, gaussian, readout

_HISTORIES_AT_ONCE = 512
_ACTIVE_VARIANCE = 0.01


def detector_metrics(
    key: Key, config: Config, *, detections: Detections
) -> dict[str, dict[str, Float[Array, ""]]]:
    """Accuracy, expected calibration error `ece` and `nll` in nats, of held-out scans."""
    del key

    def measure(looks: jax.Array, label_of_class: jax.Array) -> dict[str, jax.Array]:
        labels = jnp.repeat(label_of_class, looks.shape[1])
        flat = looks.reshape(-1, looks.shape[-1])
        return {
            "accuracy": jnp.mean(looks.argmax(axis=-1) == label_of_class[:, None]),
            "ece": detectors.calibration_error(flat, labels),
            "nll": detectors.negative_log_likelihood(flat, labels),
        }

    return {
        name: measure(looks, jnp.array(config.label_of_class(name)))
        for name, looks in zip(config.modalities, detections.held_out, strict=True)
    }


def reliability(config: Config, held_out: Samples) -> dict[str, Reliability]:
    """Reliability diagrams of all detectors, from `[C, S, D_m]` features of held-out looks."""
    found = {}
    for name, looks in zip(config.modalities, held_out, strict=True):
        labels = jnp.repeat(jnp.array(config.label_of_class(name)), looks.shape[1])
        flat = jnp.asarray(looks).reshape(-1, looks.shape[-1])
        found[name] = jax.tree.map(np.asarray, detectors.reliability(flat, labels))
    return found


@pytree
class LatentSpace:
    """Metrics of a latent space, from held-out looks.

    Attributes:
      active_units: `[]` int32 number of latent dimensions in use.
      sigma_norm: for `joint` and each modality `[C]` mean `||sigma||_2`.
      unambiguous: for `joint` and each modality `[C]` share of looks after which only the true
        class is plausible.
      consistent: for `joint` and each modality `[C]` share of looks after which exactly the classes
        are plausible that the sensor cannot distinguish from the true one.
      moment_matching_error: `[]` mean of `moment_matching_error`.
      readout_error: `[]` nats lost between writing a belief and reading it, see
        `histories.readout_error`.
      fusion: `accuracy`, `mean_error` and `std_error` of beliefs after a look by one modality and
        then by another, `[]` each; None with a single modality.
    """

    active_units: Int[Array, ""]
    sigma_norm: dict[str, Float[Array, " C"]]
    unambiguous: dict[str, Float[Array, " C"]]
    consistent: dict[str, Float[Array, " C"]]
    moment_matching_error: Float[Array, ""]
    readout_error: Float[Array, ""]
    fusion: dict[str, Float[Array, ""] | None]


def latent_space(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> tuple[dict[str, Belief], LatentSpace]:
    """Fuses held-out looks, alone and together, and measures the latent space.

    The s-th look at a class by one modality is paired with the s-th by another. Non-finite
    parameters and features raise no error: check the beliefs.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality alone, and the metrics.
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

    return found, LatentSpace(
        active_units=active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        sigma_norm={n: readout.sigma_norm(b.std).mean(axis=1) for n, b in found.items()},
        unambiguous={n: share(x, same) for n, x in open_classes.items()},
        consistent={n: share(x, consistent[n]) for n, x in open_classes.items()},
        moment_matching_error=_mean_error(joint, alone, config),
        readout_error=histories.readout_error(
            key, config, bank, fusion.classes, fusion.class_probabilities
        ),
        fusion=_fusion_metrics(fusion, bank, alone),
    )


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
    mean, std = gaussian.moment_match(components.mean, components.std)
    shift = jnp.abs(belief.mean - mean) / std
    return jnp.mean(shift + jnp.abs(jnp.log(belief.std / std)))


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
    is_right, distances, widths = [], [], []
    shown = jax.vmap(jax.vmap(lambda b: readout.nearest_class(b, fusion.classes.mean)))
    for first, second in itertools.permutations(range(len(bank)), 2):
        seen = jnp.arange(len(bank)) == first
        update = lambda old, new: fusion.update(old, seen, new, second)  # noqa: B023, E731
        fused = jax.vmap(jax.vmap(update))(alone[first], bank[second])
        both = _beliefs(fusion, bank, (first, second))
        is_right.append(shown(fused) == jnp.arange(len(bank[0]))[:, None])
        distances.append(jnp.linalg.norm((fused.mean - both.mean) / both.std, axis=-1))
        widths.append(jnp.mean(jnp.abs(jnp.log(fused.std / both.std)), axis=-1))
    # A single modality has nothing to fuse.
    return {
        "accuracy": jnp.mean(jnp.array(is_right)) if is_right else None,
        "mean_error": jnp.mean(jnp.array(distances)) if distances else None,
        "std_error": jnp.mean(jnp.array(widths)) if widths else None,
    }


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
        return jax.lax.scan(look, start, histories.draw(drawn[0], bank, drawn[1]))[1]

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
        "looks": 1 + jnp.arange(histories.LOOKS),
        "nll": nll,
        "bayes_nll": bayes_nll,
        "accuracy": accuracy,
        "bayes_accuracy": bayes_accuracy,
        "doubt_correlation": jnp.corrcoef(norms.reshape(-1), entropy.reshape(-1))[0, 1],
    }

"""Stages that measure detectors, the latent space, beliefs and policies."""

import dataclasses
import functools
import itertools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Fusion, Key, Samples, call, pytree
from jaxsense.dqn import episodes, policies
from jaxsense.dqn.map_mdp import MapMdp, random_start
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.policies import Known
from jaxsense.models import Models, make_agent, make_bayes
from jaxsense.training.mdp import held_out_mdp, models_of
from jaxsense.training.perception import Detections
from jaxsense.vae import calibration, latent

COMPARED = ("latent", "optimal", "naive", "random")
"""Policies that are compared in the map MDP, from `dqn.policies.POLICIES`."""

_LOOKS = 6  # of a random history at one PoI


def detector_metrics(
    key: Key, config: Config, *, detections: Detections
) -> dict[str, dict[str, jax.Array]]:
    """Measures the detectors on held-out scans.

    Args:
      key: not used.
      config: all settings.
      detections: of all sensors.

    Returns:
      For each modality `accuracy`, `ece` and `nll`, `[]` each: the share of right labels, the
      expected calibration error and the negative log-likelihood in nats.
    """
    del key

    def measure(looks: jax.Array, label_of_class: jax.Array) -> dict[str, jax.Array]:
        labels = jnp.repeat(label_of_class, looks.shape[1])
        flat = looks.reshape(-1, looks.shape[-1])
        return {
            "accuracy": jnp.mean(looks.argmax(axis=-1) == label_of_class[:, None]),
            "ece": calibration.calibration_error(flat, labels),
            "nll": calibration.negative_log_likelihood(flat, labels),
        }

    return {
        name: measure(looks, jnp.array(config.label_of_class(name)))
        for name, looks in zip(config.modalities, detections.held_out, strict=True)
    }


@pytree
class LatentSpace:
    """Metrics of a latent space. C classes, S held-out looks at each.

    Attributes:
      active_units: `[]` int32 latent dimensions in use.
      sigma_norm: for `joint` and each modality `[C]` mean `||sigma||_2`.
      unambiguous: for `joint` and each modality `[C]` share of looks that leave one class open.
      consistent: the same for the classes that the sensor cannot tell apart.
      moment_matching_error: `[]` see `latent.moment_matching_error`.
      fusion: quality of beliefs after one modality's look and then another's: `accuracy`,
        `mean_error` and `std_error`, `[]` each; None with a single modality.
    """

    active_units: jax.Array
    sigma_norm: dict[str, jax.Array]
    unambiguous: dict[str, jax.Array]
    consistent: dict[str, jax.Array]
    moment_matching_error: jax.Array
    fusion: dict[str, jax.Array | None]


def latent_space(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> tuple[dict[str, Belief], LatentSpace]:
    """Fuses held-out looks, alone and together, and measures the latent space.

    The s-th look at a class in one modality goes with the s-th in another. Parameters and features
    that are not finite are not caught: check the beliefs.

    Args:
      key: not used.
      config: all settings.
      fusion: how looks update the map.
      detections: of all sensors.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality alone, and the metrics.
    """
    del key
    bank, class_means = detections.held_out, fusion.classes.mean
    joint = _beliefs(fusion, bank, range(len(bank)))
    alone = [_beliefs(fusion, bank, [m]) for m in range(len(bank))]
    found = {"joint": joint, **dict(zip(config.modalities, alone, strict=True))}
    same = np.eye(len(class_means), dtype=bool)
    consistent = {
        "joint": same,
        **{m: latent.consistent_classes(config.label_of_class(m)) for m in config.modalities},
    }
    plausible = jax.vmap(jax.vmap(lambda b: latent.plausible_classes(b, class_means)))
    open_classes = {name: plausible(belief) for name, belief in found.items()}

    def share(is_open: jax.Array, expected: np.ndarray) -> jax.Array:
        return jnp.all(is_open == expected[:, None], axis=-1).mean(axis=1)

    return found, LatentSpace(
        active_units=latent.active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        sigma_norm={n: latent.sigma_norm(b.std).mean(axis=1) for n, b in found.items()},
        unambiguous={n: share(x, same) for n, x in open_classes.items()},
        consistent={n: share(x, consistent[n]) for n, x in open_classes.items()},
        moment_matching_error=_moment_matching_error(joint, alone, config),
        fusion=_fusion_metrics(fusion, bank, alone),
    )


def _beliefs(fusion: Fusion, bank: Samples, members: Iterable[int]) -> Belief:
    """`[C, S, D]` beliefs after looks by some of the modalities together."""
    order = tuple(members)  # that of a dictionary would be lost in `vmap`
    together = lambda features: fusion.together({m: features[m] for m in order})  # noqa: E731
    return jax.vmap(jax.vmap(together))(bank)


def _moment_matching_error(joint: Belief, alone: list[Belief], config: Config) -> jax.Array:
    """`[]` mean distance of single modalities' posteriors from their moment-matched targets."""
    errors = []
    for modality, belief in zip(config.modalities, alone, strict=True):
        labels = config.label_of_class(modality)
        for c, consistent in enumerate(latent.consistent_classes(labels)):
            members = jnp.array(np.flatnonzero(consistent))
            parts = jax.tree.map(lambda x: x[members].reshape(-1, x.shape[-1]), joint)  # noqa: B023
            of_class = jax.tree.map(lambda x: x[c], belief)  # noqa: B023
            errors.append(jax.vmap(latent.moment_matching_error, (0, None))(of_class, parts))
    return jnp.mean(jnp.stack(errors))


def _fusion_metrics(
    fusion: Fusion, bank: Samples, alone: list[Belief]
) -> dict[str, jax.Array | None]:
    """Quality of beliefs after one modality's look and then another's."""
    is_right, distances, widths = [], [], []
    shown = jax.vmap(jax.vmap(fusion.most_likely_class))
    for first, second in itertools.permutations(range(len(bank)), 2):
        seen = jnp.arange(len(bank)) == first
        update = lambda old, new: fusion.update(old, seen, new, second)  # noqa: B023, E731
        fused = jax.vmap(jax.vmap(update))(alone[first], bank[second])
        both = _beliefs(fusion, bank, (first, second))
        is_right.append(shown(fused) == jnp.arange(len(bank[0]))[:, None])
        distances.append(jnp.linalg.norm((fused.mean - both.mean) / both.std, axis=-1))
        widths.append(jnp.mean(jnp.abs(jnp.log(fused.std / both.std)), axis=-1))
    # One modality fuses nothing.
    return {
        "accuracy": jnp.mean(jnp.array(is_right)) if is_right else None,
        "mean_error": jnp.mean(jnp.array(distances)) if distances else None,
        "std_error": jnp.mean(jnp.array(widths)) if widths else None,
    }


def beliefs(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> dict[str, jax.Array]:
    """Reads the map after random histories of looks, and compares it with exact Bayes.

    A history looks at one PoI, each time with a random modality.

    Args:
      key: random key.
      config: all settings.
      fusion: how looks update the map.
      detections: of all sensors.

    Returns:
      The block `belief` of the summary as arrays: `[K]` negative log-likelihood of the true class
      and accuracy after 1 to K looks, of the map and of the exact Bayes filter on the same
      detections; and Pearson's correlation of `||sigma||` with the entropy of the exact posterior.
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

    def history(key: Key, true_class: jax.Array):
        modality_key, *row_keys = jax.random.split(key, 1 + len(bank))
        modalities = jax.random.randint(modality_key, (_LOOKS,), 0, len(bank))
        looks = tuple(
            x[true_class, jax.random.randint(k, (_LOOKS,), 0, x.shape[1])]
            for x, k in zip(bank, row_keys, strict=True)
        )
        start = fusion.prior, exact.prior, jnp.zeros(len(bank), bool)
        return jax.lax.scan(look, start, (modalities, looks))[1]

    truth = jnp.arange(num_histories) % number
    found, log_posterior, norms = jax.vmap(history)(jax.random.split(key, num_histories), truth)
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


def learned_return(
    key: Key, modality: jax.Array, q_network: Params, mdp: MapMdp, config: Config
) -> jax.Array:
    """`[]` mean total reward of a Q-network's policy, in one episode from each of random starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of its Q-network.
      mdp: from `held_out_mdp`.
      config: all settings.
    """
    agent, exact = make_agent(config), make_bayes(config)

    def act(key: Key, known: Known) -> jax.Array:
        del key
        classes = mdp.fusion.classes
        values = agent.decide(q_network, None, classes, known.belief, known.team, known.robot)
        return policies.best(values)

    def episode(key: Key) -> jax.Array:
        reset_key, episode_key = jax.random.split(key)
        start = episodes.reset(reset_key, mdp, exact)
        return episodes.run_episode(episode_key, mdp, exact, act, start, modality)[0]

    return jnp.mean(jax.vmap(episode)(jax.random.split(key, config.evaluation.num_starts)))


def compare_policies(
    key: Key, modality: jax.Array, models: Models, mdp: MapMdp, config: Config
) -> tuple[jax.Array, jax.Array]:
    """Plays episodes with each of `COMPARED`, on the same looks from the same starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      models: trained models, whose `q_networks` are all those of this modality.
      mdp: from `held_out_mdp`.
      config: all settings.

    Returns:
      `[P, S]` total reward and reward of the first action, means over the noise of looks; NaN where
      a value or a reward was. The starts are every state of the map, then
      `config.evaluation.num_starts` random ones.
    """
    settings = config.evaluation
    # The second key drew the looks of a table that is no longer needed.
    start_key, _, play_key = jax.random.split(key, 3)
    starts = _every_start(start_key, mdp, config)
    compared = [policies.POLICIES[name] for name in COMPARED]

    # One policy after the other, by a switch: the program is compiled once for all of them.
    def with_policy(which: jax.Array) -> tuple[jax.Array, jax.Array]:
        def act(key: Key, known: Known) -> jax.Array:
            branches = [functools.partial(p.values, key, models, known) for p in compared]
            return policies.best(jax.lax.switch(which, branches))

        # Only the first two are compared state by state.
        number = jnp.where(which < 2, settings.num_repeats, -(-settings.num_repeats // 8))

        def episode(key: Key, classes: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
            reset_key, episode_key = jax.random.split(key)
            start = episodes.reset(reset_key, mdp, models.bayes, classes, seen)
            return episodes.run_episode(episode_key, mdp, models.bayes, act, start, modality)

        def repeat(i: jax.Array, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            keys = jax.random.split(jax.random.fold_in(play_key, i), len(starts[0]))
            return jax.tree.map(jnp.add, sums, jax.vmap(episode)(keys, starts[0], starts[1]))

        zero = jnp.zeros(len(starts[0]))
        total, first = jax.lax.fori_loop(0, number, repeat, (zero, zero))
        return total / number, first / number

    return jax.lax.map(with_policy, jnp.arange(len(compared)))


def _every_start(key: Key, mdp: MapMdp, config: Config) -> tuple[jax.Array, jax.Array]:
    """`[S, N]` classes and `[S, N, M]` looks of every state of the map, then of random starts."""
    keys = jax.random.split(key, config.evaluation.num_starts)
    random_classes, random_seen = jax.vmap(lambda key: random_start(key, mdp))(keys)
    classes, seen = episodes.every_state(
        mdp.num_pois, mdp.num_classes, mdp.num_modalities, config.evaluation.num_states
    )
    return (
        jnp.concatenate([jnp.asarray(classes), random_classes]),
        jnp.concatenate([jnp.asarray(seen), random_seen]),
    )


def play_policies(
    key: Key,
    config: Config,
    *,
    modality: jax.Array,
    q_network: Params,
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    detections: Detections,
    num_pois: int | None = None,
) -> tuple[jax.Array, jax.Array]:
    """See `compare_policies`.

    Args:
      key: random key.
      config: all settings.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of its Q-network.
      fusion: how looks update the map.
      look_values: of each modality.
      detections: of all sensors.
      num_pois: N; by default that of the arena.
    """
    q_networks = (q_network,) * len(config.modalities)
    models = models_of(config, fusion, look_values, q_networks)
    mdp = held_out_mdp(config, fusion, detections, num_pois)
    return compare_policies(key, modality, models, mdp, config)


def play_numbers(key: Key, config: Config, **inputs: Params) -> list[tuple[jax.Array, jax.Array]]:
    """The results of `compare_policies` for each of `evaluation.num_pois`.

    Args:
      key: random key.
      config: all settings.
      **inputs: see `play_policies`.
    """
    settings = config.evaluation
    fewer = dataclasses.replace(settings, num_states=1, num_repeats=-(-settings.num_repeats // 8))
    there = dataclasses.replace(config, evaluation=fewer)
    return [
        play_policies(jax.random.fold_in(key, number), there, num_pois=number, **inputs)
        for number in settings.num_pois
    ]

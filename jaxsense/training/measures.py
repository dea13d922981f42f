"""Stages that measure detectors, the latent space, beliefs and policies."""

import dataclasses
import functools
import itertools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Fusion, Key, Samples, call, pytree
from jaxsense.dqn import episodes, policies
from jaxsense.dqn.map_mdp import MapMdp, random_start
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.policies import Known
from jaxsense.dqn.reference import reference
from jaxsense.models import Models, make_agent, make_bayes
from jaxsense.training.mdp import held_out_mdp, models_of
from jaxsense.training.perception import Detections
from jaxsense.training.stage import Output
from jaxsense.vae import calibration, latent

COMPARED = ("latent", "optimal", "naive", "random")
"""Names of the policies to compare in the map MDP, from `dqn.policies.POLICIES`."""

_LOOKS = 6  # in a random history


def detector_metrics(
    key: Key, config: Config, *, detections: Detections
) -> dict[str, dict[str, Float[Array, ""]]]:
    """Measures the detectors on held-out scans.

    Args:
      key: not used.
      config: all settings.
      detections: of all sensors.

    Returns:
      For each modality `accuracy`, the expected calibration error `ece`, and the negative
      log-likelihood `nll` in nats.
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
    """Metrics of a latent space, from held-out looks.

    Attributes:
      active_units: `[]` int32 number of latent dimensions in use.
      sigma_norm: for `joint` and each modality `[C]` mean `||sigma||_2`.
      unambiguous: for `joint` and each modality `[C]` share of looks after which only the true
        class is plausible.
      consistent: for `joint` and each modality `[C]` share of looks after which exactly the classes
        are plausible that the sensor cannot distinguish from the true one.
      moment_matching_error: `[]` mean of `latent.moment_matching_error`.
      fusion: `accuracy`, `mean_error` and `std_error` of beliefs after a look by one modality and
        then by another, `[]` each; None with a single modality.
    """

    active_units: Int[Array, ""]
    sigma_norm: dict[str, Float[Array, " C"]]
    unambiguous: dict[str, Float[Array, " C"]]
    consistent: dict[str, Float[Array, " C"]]
    moment_matching_error: Float[Array, ""]
    fusion: dict[str, Float[Array, ""] | None]


def latent_space(
    key: Key, config: Config, *, fusion: Fusion, detections: Detections
) -> tuple[dict[str, Belief], LatentSpace]:
    """Fuses held-out looks, alone and together, and measures the latent space.

    The s-th look at a class by one modality is paired with the s-th by another. Non-finite
    parameters and features raise no error: check the beliefs.

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

    def share(
        is_open: Bool[Array, "C S K"], expected: Bool[np.ndarray, "C K"]
    ) -> Float[Array, " C"]:
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


def _moment_matching_error(joint: Belief, alone: list[Belief], config: Config) -> Float[Array, ""]:
    """Mean distance of uni-modal posteriors from their moment-matched targets."""
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
) -> dict[str, Float[Array, ""] | None]:
    """Quality of beliefs after a look by one modality and then by another."""
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

    Args:
      key: random key.
      config: all settings.
      fusion: how looks update the map.
      detections: of all sensors.

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
    key: Key, modality: Int[Array, ""], q_network: Params, mdp: MapMdp, config: Config
) -> Float[Array, ""]:
    """Mean total reward of a Q-network's policy, in one episode from each of random starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of the Q-network.
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
    key: Key, modality: Int[Array, ""], models: Models, mdp: MapMdp, config: Config
) -> tuple[Float[Array, "P S"], Float[Array, "P S"]]:
    """Plays episodes with each of `COMPARED`, with the same looks and starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      models: trained models, in whose `q_networks` all are of this modality.
      mdp: from `held_out_mdp`.
      config: all settings.

    Returns:
      `[P, S]` total reward and `[P, S]` reward of the first action, averaged over the noise of
      looks; NaN where a value or a reward is NaN. The starts are the states of
      `episodes.every_state`, then `config.evaluation.num_starts` random ones.
    """
    settings = config.evaluation
    start_key, table_key, play_key = jax.random.split(key, 3)
    starts = _every_start(start_key, mdp, config)
    optimal = reference(table_key, mdp, modality, models, models.bayes.labels)

    # By a switch, so that one program is compiled for all policies.
    def with_policy(which: Int[Array, ""]) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
        # Only the first two policies are compared state by state.
        number = jnp.where(which < 2, settings.num_repeats, -(-settings.num_repeats // 8))

        def episode(key: Key, classes: jax.Array, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
            reset_key, episode_key = jax.random.split(key)
            start = episodes.reset(reset_key, mdp, models.bayes, classes, seen)

            def act(key: Key, known: Known) -> jax.Array:
                of_table = {
                    name: functools.partial(policies.POLICIES[name].values, key, models, known)
                    for name in ("latent", "naive", "random")
                }
                by_name = {**of_table, "optimal": lambda: optimal(known, classes)}
                return policies.best(jax.lax.switch(which, [by_name[name] for name in COMPARED]))

            return episodes.run_episode(episode_key, mdp, models.bayes, act, start, modality)

        def repeat(i: jax.Array, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            keys = jax.random.split(jax.random.fold_in(play_key, i), len(starts[0]))
            return jax.tree.map(jnp.add, sums, jax.vmap(episode)(keys, starts[0], starts[1]))

        zero = jnp.zeros(len(starts[0]))
        total, first = jax.lax.fori_loop(0, number, repeat, (zero, zero))
        return total / number, first / number

    return jax.lax.map(with_policy, jnp.arange(len(COMPARED)))


def _every_start(
    key: Key, mdp: MapMdp, config: Config
) -> tuple[Int[Array, "S N"], Bool[Array, "S N M"]]:
    """Classes and looks of every state of the map, then of random starts."""
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
    modality: Int[Array, ""],
    q_network: Params,
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    detections: Detections,
    num_pois: int | None = None,
) -> tuple[Float[Array, "P S"], Float[Array, "P S"]]:
    """Runs `compare_policies` for one modality.

    Args:
      key: random key.
      config: all settings.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of the Q-network.
      fusion: how looks update the map.
      look_values: for each modality, the values of looks.
      detections: of all sensors.
      num_pois: N; as in the arena by default.
    """
    q_networks = (q_network,) * len(config.modalities)
    models = models_of(config, fusion, look_values, q_networks)
    mdp = held_out_mdp(config, fusion, detections, num_pois)
    return compare_policies(key, modality, models, mdp, config)


def play_numbers(
    key: Key, config: Config, **inputs: Output
) -> list[tuple[Float[Array, "P S"], Float[Array, "P S"]]]:
    """Runs `compare_policies` with each number of PoIs in `evaluation.num_pois`.

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

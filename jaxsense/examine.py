"""Measures a trained JMVAE and trained policies: the metrics of `summary.json`."""

import functools
import itertools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import observe
from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key, call
from jaxsense.dqn import episodes, policies
from jaxsense.dqn.belief_mdp import MapMdp, MapState, random_start, reset
from jaxsense.dqn.optimum import LookValues
from jaxsense.models import make_jmvae, readout
from jaxsense.observe import Bank
from jaxsense.vae import filtering, fusion, jmvae, metrics, peers
from jaxsense.vae.jmvae import Jmvae

MDP_POLICIES = ("return", "optimal", "naive", "random")
"""The greedy policy of a Q-network, and its baselines, in the map MDP."""
_EXPECTATION_DRAWS = 1024
_LOOKS = 6  # of a random history at one PoI


def detector(looks: jax.Array, label_of_class: jax.Array) -> dict[str, jax.Array]:
    """Measures a detector.

    Args:
      looks: `[C, S, D_m]` held-out detections.
      label_of_class: `[C]` int32 the right label of each class.

    Returns:
      `accuracy`, `ece` and `nll`, `[]` each: the share of right labels, the expected calibration
      error and the negative log-likelihood in nats.
    """
    labels = jnp.repeat(label_of_class, looks.shape[1])
    flat = looks.reshape(-1, looks.shape[-1])
    return {
        "accuracy": jnp.mean(looks.argmax(axis=-1) == label_of_class[:, None]),
        "ece": metrics.calibration_error(flat, labels),
        "nll": metrics.negative_log_likelihood(flat, labels),
    }


def class_beliefs(params: Params, bank: Bank, config: Config) -> Belief:
    """`[C, D]` mean joint posterior of each class, from detections for training."""
    joint = _encode(params, make_jmvae(config), bank, range(len(bank)))
    return jax.tree.map(lambda x: x.mean(axis=1), joint)


def latent_space(
    params: Params, class_means: jax.Array, bank: Bank, config: Config
) -> tuple[dict[str, Belief], dict[str, Any]]:
    """Writes detections into the map, alone and together, and measures the latent space.

    Args:
      params: of the JMVAE, with those of the filter if there is one.
      class_means: `[C, D]` of `class_beliefs`.
      bank: for each modality `[C, S, D_m]` held-out detections; the s-th of a class in one modality
        goes with the s-th in another.
      config: all settings.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality alone, and the block `jmvae` of the
      summary as arrays. Parameters and detections that are not finite are not caught: check the
      beliefs.
    """
    model, num_modalities = make_jmvae(config), len(bank)
    joint = _entries(params, bank, range(num_modalities), config)
    alone = [_entries(params, bank, [m], config) for m in range(num_modalities)]
    posteriors = {"joint": joint, **dict(zip(model.modalities, alone, strict=True))}
    classes = jnp.arange(bank[0].shape[0])
    consistent = {
        "joint": np.eye(len(classes), dtype=bool),
        **{m: metrics.consistent_classes(config.label_of_class(m)) for m in config.modalities},
    }
    plausible = {
        n: jax.vmap(jax.vmap(metrics.plausible_classes, (0, None)), (0, None))(b, class_means)
        for n, b in posteriors.items()
    }
    return posteriors, {
        "active_units": metrics.active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        "sigma_norm": {n: metrics.sigma_norm(b.std).mean(axis=1) for n, b in posteriors.items()},
        "unambiguous": {
            n: jnp.all(p == np.eye(len(classes), dtype=bool)[:, None], axis=-1).mean(axis=1)
            for n, p in plausible.items()
        },
        "consistent": {
            n: jnp.all(p == consistent[n][:, None], axis=-1).mean(axis=1)
            for n, p in plausible.items()
        },
        "moment_matching_error": _moment_matching_error(joint, alone, config),
        "fusion": _fusion(params, bank, alone, class_means, config),
    }


def _entries(params: Params, bank: Bank, members: Iterable[int], config: Config) -> Belief:
    """`[C, S, D]` entries of the map after looks by some of the modalities."""
    model = make_jmvae(config)
    if fusion.FILTER not in params:
        return _encode(params, model, bank, members)
    unseen = fusion.unseen(model, config.mdp.unseen_variance)

    def write(*features: jax.Array) -> Belief:
        entry = unseen
        for m in members:
            entry = filtering.update(params[fusion.FILTER], model, entry, features[m], m)
        return entry

    return jax.vmap(jax.vmap(write))(*bank)


def _encode(params: Params, model: Jmvae, bank: Bank, members: Iterable[int]) -> Belief:
    """`[C, S, D]` posteriors from some of the modalities."""
    chosen = set(members)

    def encode(*features: jax.Array) -> Belief:
        kept = tuple(f if m in chosen else None for m, f in enumerate(features))
        return jmvae.posterior(params, model, kept)

    return jax.vmap(jax.vmap(encode))(*bank)


def _moment_matching_error(joint: Belief, alone: list[Belief], config: Config) -> jax.Array:
    """`[]` mean distance of single modalities' posteriors from their moment-matched targets."""
    errors = []
    for modality, belief in zip(config.modalities, alone, strict=True):
        labels = config.label_of_class(modality)
        for c, consistent in enumerate(metrics.consistent_classes(labels)):
            members = jnp.array(np.flatnonzero(consistent))
            parts = jax.tree.map(lambda x: x[members].reshape(-1, x.shape[-1]), joint)  # noqa: B023
            of_class = jax.tree.map(lambda x: x[c], belief)  # noqa: B023
            errors.append(jax.vmap(metrics.moment_matching_error, (0, None))(of_class, parts))
    return jnp.mean(jnp.stack(errors))


def _fusion(
    params: Params, bank: Bank, alone: list[Belief], class_means: jax.Array, config: Config
) -> dict[str, jax.Array | None]:
    """Quality of map entries after one modality's look and then another's."""
    model = make_jmvae(config)
    is_right, distances, widths = [], [], []
    shown = jax.vmap(jax.vmap(lambda b: fusion.most_likely_class(params, class_means, b)))
    for first, second in itertools.permutations(range(len(bank)), 2):
        seen = jnp.arange(len(bank)) == first
        write = lambda old, new: fusion.write(params, model, old, seen, new, second)  # noqa: B023, E731
        fused = jax.vmap(jax.vmap(write))(alone[first], bank[second])
        both = _entries(params, bank, (first, second), config)
        is_right.append(shown(fused) == jnp.arange(len(class_means))[:, None])
        distances.append(jnp.linalg.norm((fused.mean - both.mean) / both.std, axis=-1))
        widths.append(jnp.mean(jnp.abs(jnp.log(fused.std / both.std)), axis=-1))
    # One modality fuses nothing.
    return {
        "accuracy": jnp.mean(jnp.array(is_right)) if is_right else None,
        "mean_error": jnp.mean(jnp.array(distances)) if distances else None,
        "std_error": jnp.mean(jnp.array(widths)) if widths else None,
    }


def beliefs(
    key: Key, params: Params, classes: Belief, bank: Bank, config: Config
) -> dict[str, jax.Array]:
    """Reads the map after random histories of looks, and compares it with exact Bayes.

    A history looks at one PoI, each time with a random modality.

    Args:
      key: random key.
      params: of the JMVAE, with those of the filter if there is one.
      classes: `[C, D]` mean joint posterior of each class.
      bank: for each modality `[C, S, D_m]` held-out detections.
      config: all settings.

    Returns:
      The block `belief` of the summary as arrays: `[K]` negative log-likelihood of the true class
      and accuracy after 1 to K looks, of the map and of the exact Bayes filter on the same
      detections; and Pearson's correlation of `||sigma||` with the entropy of the exact posterior.
    """
    model, number = make_jmvae(config), len(classes.mean)
    labels = [jnp.array(config.label_of_class(m)) for m in config.modalities]
    unseen = fusion.unseen(model, config.mdp.unseen_variance)
    read = readout(filtering.moments_inverse(classes), unseen)

    def look(carry, drawn):
        belief, exact, seen = carry
        modality, features = drawn

        def write(m: int):
            update = fusion.write(params, model, belief, seen, features[m], m)
            return update, peers.bayes_update(exact, features[m], labels[m])

        belief, exact = call(write, modality, len(bank))
        seen = seen.at[modality].set(True)
        shares = jnp.log(filtering.weights(read, belief))
        return (belief, exact, seen), (shares, exact, jnp.linalg.norm(belief.std))

    def history(key: Key, true_class: jax.Array):
        modality_key, *row_keys = jax.random.split(key, 1 + len(bank))
        modalities = jax.random.randint(modality_key, (_LOOKS,), 0, len(bank))
        looks = tuple(
            x[true_class, jax.random.randint(k, (_LOOKS,), 0, x.shape[1])]
            for x, k in zip(bank, row_keys, strict=True)
        )
        start = unseen, jnp.full(number, -jnp.log(number)), jnp.zeros(len(bank), bool)
        return jax.lax.scan(look, start, (modalities, looks))[1]

    num_histories = config.evaluation.num_histories
    truth = jnp.arange(num_histories) % number
    shares, exact, norms = jax.vmap(history)(jax.random.split(key, num_histories), truth)
    right = jnp.arange(number)[None, None] == truth[:, None, None]
    entropy = -jnp.sum(jnp.exp(exact) * exact, axis=-1)

    def measured(logarithms: jax.Array) -> tuple[jax.Array, jax.Array]:
        nll = -jnp.mean(jnp.sum(jnp.where(right, logarithms, 0.0), axis=-1), axis=0)
        return nll, jnp.mean(jnp.argmax(logarithms, axis=-1) == truth[:, None], axis=0)

    (nll, accuracy), (bayes_nll, bayes_accuracy) = measured(shares), measured(exact)
    return {
        "looks": 1 + jnp.arange(_LOOKS),
        "nll": nll,
        "bayes_nll": bayes_nll,
        "accuracy": accuracy,
        "bayes_accuracy": bayes_accuracy,
        "doubt_correlation": jnp.corrcoef(norms.reshape(-1), entropy.reshape(-1))[0, 1],
    }


def greedy_return(
    key: Key,
    modality: jax.Array,
    q_network: Params,
    params: Params,
    bank: Bank,
    config: Config,
) -> jax.Array:
    """`[]` mean total reward of the greedy policy, in one episode from each of random starts.

    See `compare_policies` for the arguments.
    """
    mdp = observe.bank_mdp(config, bank, params, make_jmvae(config))
    act = _greedy(mdp, q_network, modality, config)

    def episode(key: Key) -> jax.Array:
        reset_key, episode_key = jax.random.split(key)
        start = reset(reset_key, mdp)
        return episodes.run_episode(episode_key, mdp, act, start, modality)[0]

    return jnp.mean(jax.vmap(episode)(jax.random.split(key, config.evaluation.num_starts)))


def _greedy(mdp: MapMdp, q_network: Params, modality: jax.Array, config: Config) -> policies.Policy:
    """The greedy policy of a Q-network, of a team's for a robot that is alone."""
    if config.dqn.task == "team":
        return policies.greedy_alone(mdp, q_network, modality, config.team, config.dqn)
    return policies.greedy(mdp, q_network, config.dqn.hidden)


def compare_policies(
    key: Key,
    modality: jax.Array,
    q_network: Params,
    params: Params,
    look_values: tuple[LookValues, ...],
    bank: Bank,
    config: Config,
) -> tuple[jax.Array, jax.Array]:
    """Plays episodes with each of `MDP_POLICIES`, on the same detections from the same starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of its Q-network.
      params: of the JMVAE, with those of the filter if there is one.
      look_values: of each modality, from detections for training.
      bank: held-out detections.
      config: all settings.

    Returns:
      `[P, S]` total reward and reward of the first action, means over the noise of detections; NaN
      where a value or a reward was. The starts are every state of the map, then
      `config.evaluation.num_starts` random ones.
    """
    settings = config.evaluation
    mdp = observe.bank_mdp(config, bank, params, make_jmvae(config))
    start_key, table_key, play_key = jax.random.split(key, 3)
    starts = _every_start(start_key, mdp, config)
    if config.jmvae.fusion == "filter":
        own = jax.tree.map(lambda *x: jnp.stack(x)[modality], *look_values)
        weights = functools.partial(filtering.weights, params[fusion.FILTER])
        optimal = policies.by_posterior(own.total, own.first_total, weights)
    else:
        # A second look by the same sensor replaces the first, so that it never pays.
        labels = jnp.array([config.label_of_class(m) for m in config.modalities])
        expected = policies.expected_rewards(table_key, mdp, modality, _EXPECTATION_DRAWS)
        optimal = policies.optimal(mdp, expected, labels)
    compared = (
        _greedy(mdp, q_network, modality, config),
        optimal,
        policies.naive(mdp, modality),
        policies.random(mdp),
    )

    # One policy after the other, by a switch: the program is compiled once for all of them.
    def with_policy(which: jax.Array) -> tuple[jax.Array, jax.Array]:
        def act(key: Key, state: MapState) -> jax.Array:
            branches = [functools.partial(policy, key, state) for policy in compared]
            return jax.lax.switch(which, [lambda b=b: b().astype(jnp.int32) for b in branches])

        # Only the first two are compared state by state.
        number = jnp.where(which < 2, settings.num_repeats, -(-settings.num_repeats // 8))
        return _mean_rewards(play_key, mdp, act, modality, starts, number)

    return jax.lax.map(with_policy, jnp.arange(len(compared)))


def _mean_rewards(
    key: Key,
    mdp: MapMdp,
    act: Callable[[Key, MapState], jax.Array],
    modality: jax.Array,
    starts: tuple[jax.Array, jax.Array],
    number: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """`[S]` total and first reward of `number` episodes from each start, on average."""

    def episode(key: Key, classes: jax.Array, seen: jax.Array):
        reset_key, episode_key = jax.random.split(key)
        start = reset(reset_key, mdp, classes, seen)
        return episodes.run_episode(episode_key, mdp, act, start, modality)

    def repeat(i: jax.Array, sums: tuple[jax.Array, jax.Array]):
        keys = jax.random.split(jax.random.fold_in(key, i), len(starts[0]))
        return jax.tree.map(jnp.add, sums, jax.vmap(episode)(keys, *starts))

    zero = jnp.zeros(len(starts[0]))
    total, first = jax.lax.fori_loop(0, number, repeat, (zero, zero))
    return total / number, first / number


def _every_start(key: Key, mdp: MapMdp, config: Config) -> tuple[jax.Array, jax.Array]:
    """`[S, N]` classes and `[S, N, M]` looks of every state of the map, then of random starts."""
    keys = jax.random.split(key, config.evaluation.num_starts)
    drawn = jax.vmap(lambda key: random_start(key, mdp))(keys)
    classes, seen = (
        jnp.concatenate([jnp.asarray(every), some])
        for every, some in zip(_states(config), drawn, strict=True)
    )
    return classes, seen


def _states(config: Config) -> tuple[np.ndarray, np.ndarray]:
    sizes = config.arena.num_pois, len(config.arena.classes), len(config.modalities)
    return episodes.every_state(*sizes, config.evaluation.num_states)


def returns(total: np.ndarray, config: Config) -> dict[str, float | None]:
    """Mean return of each of `MDP_POLICIES` from random starts, and the share of the optimal one.

    Args:
      total: `[P, S]` from `compare_policies`.
      config: all settings.
    """
    of_starts = total[:, -config.evaluation.num_starts :].mean(axis=1).tolist()
    whole = dict(zip(MDP_POLICIES, of_starts, strict=True))
    # Where no look pays, the optimum is 0.
    fraction = whole["return"] / whole["optimal"] if whole["optimal"] else None
    return {**whole, "fraction_of_optimal": fraction}


def policy_metrics(total: np.ndarray, first: np.ndarray, config: Config) -> dict[str, Any]:
    """One modality's block in the summary's `dqn`, without the speed.

    Args:
      total: `[P, S]` from `compare_policies`.
      first: `[P, S]` from `compare_policies`.
      config: all settings.
    """
    num_states = total.shape[1] - config.evaluation.num_starts
    one_step = dict(zip(MDP_POLICIES, first[:, num_states:].mean(axis=1).tolist(), strict=True))
    missed = total[MDP_POLICIES.index("optimal"), :num_states] - total[0, :num_states]
    is_optimal = missed <= 0.01
    is_permutation = episodes.are_different(_states(config)[0])
    return {
        **returns(total, config),
        "one_step": {
            "policy": one_step["return"],
            "optimal": one_step["optimal"],
            "random": one_step["random"],
        },
        "optimal_states": int(np.sum(is_optimal)),
        "num_states": num_states,
        "optimal_permutations": int(np.sum(is_optimal & is_permutation)),
        "num_permutations": int(np.sum(is_permutation)),
    }

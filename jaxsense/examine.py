"""What a trained JMVAE and trained policies are worth: the figures of `summary.json`."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import observe
from jaxsense.config import Config
from jaxsense.dqn import episodes, policies
from jaxsense.dqn.belief_mdp import MapState, random_start, reset
from jaxsense.models import jmvae_shape
from jaxsense.networks import Params
from jaxsense.observe import Bank
from jaxsense.types import Belief, Key
from jaxsense.vae import fusion, jmvae, metrics

POLICIES = ("return", "optimal", "naive", "random")
"""The greedy policy of a Q-network, and those to compare it with."""
_EXPECTATION_DRAWS = 1024


def latent_space(
    params: Params, bank: Bank, config: Config
) -> tuple[dict[str, Belief], dict[str, Any]]:
    """Encodes detections, alone and together, and measures the latent space.

    Args:
      params: of the JMVAE.
      bank: for each modality `[C, S, D_m]` held-out detections; the s-th of a class in one modality
        goes with the s-th in another.
      config: all settings.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality, and the block `jmvae` of the summary as
      arrays. Parameters or detections that are not finite are not caught here: look at the beliefs.
    """
    model = jmvae_shape(config)
    labels = [config.label_of_class(m) for m in config.modalities]
    num_modalities, num_classes = len(bank), bank[0].shape[0]

    def encode_all(*keep: bool) -> Belief:
        def encode(*features: jax.Array) -> Belief:
            kept = tuple(f if k else None for f, k in zip(features, keep, strict=True))
            return jmvae.posterior(params, model, kept)

        return jax.vmap(jax.vmap(encode))(*bank)

    joint = encode_all(*[True] * num_modalities)
    alone = [encode_all(*(i == m for i in range(num_modalities))) for m in range(num_modalities)]
    posteriors = {"joint": joint, **dict(zip(model.modalities, alone, strict=True))}
    class_means = joint.mean.mean(axis=1)
    classes = jnp.arange(num_classes)

    is_unambiguous = jax.vmap(
        jax.vmap(metrics.unambiguous, in_axes=(0, None, None)), in_axes=(0, None, 0)
    )
    errors = []
    for belief, label_of_class in zip(alone, labels, strict=True):
        for c, consistent in enumerate(metrics.consistent_classes(label_of_class)):
            members = jnp.array(np.flatnonzero(consistent))
            parts = jax.tree.map(lambda x: x[members].reshape(-1, x.shape[-1]), joint)  # noqa: B023
            of_class = jax.tree.map(lambda x: x[c], belief)  # noqa: B023
            error = jax.vmap(metrics.moment_matching_error, in_axes=(0, None))(of_class, parts)
            errors.append(error.mean())

    is_right, distances = [], []
    for first in range(num_modalities):
        seen = jnp.arange(num_modalities) == first
        for second in set(range(num_modalities)) - {first}:
            write = lambda old, new: fusion.write(params, model, old, seen, new, second)  # noqa: B023, E731
            fused = jax.vmap(jax.vmap(write))(alone[first], bank[second])
            both = encode_all(*(m in (first, second) for m in range(num_modalities)))
            nearest = jax.vmap(jax.vmap(lambda b: metrics.nearest_class(b, class_means)))(fused)
            is_right.append(nearest == classes[:, None])
            offset = (fused.mean - both.mean) / both.std
            distances.append(jnp.linalg.norm(offset, axis=-1))

    figures = {
        "active_units": metrics.active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        "sigma_norm": {n: metrics.sigma_norm(b.std).mean(axis=1) for n, b in posteriors.items()},
        "unambiguous": {
            n: is_unambiguous(b, class_means, classes).mean(axis=1) for n, b in posteriors.items()
        },
        "moment_matching_error": jnp.mean(jnp.array(errors)),
        # With one modality there is nothing to fuse.
        "fusion": {
            "accuracy": jnp.mean(jnp.array(is_right)) if is_right else None,
            "mean_error": jnp.mean(jnp.array(distances)) if distances else None,
        },
    }
    return posteriors, figures


def play(
    key: Key,
    modality: jax.Array,
    q_network: Params,
    params: Params,
    bank: Bank,
    config: Config,
) -> tuple[jax.Array, jax.Array]:
    """Plays whole episodes with each of `POLICIES`, on the same detections from the same starts.

    Args:
      key: random key.
      modality: `[]` int32 index of the agent's own sensor.
      q_network: parameters of its Q-network.
      params: of the JMVAE.
      bank: held-out detections.
      config: all settings.

    Returns:
      `[P, S]` total reward and reward of the first action, means over the noise of detections; NaN
      where a value or a reward was. The starts are every state of the map, then
      `episodes.num_starts` random ones.
    """
    settings = config.evaluation
    mdp = observe.bank_mdp(config, bank, params, jmvae_shape(config))
    labels = jnp.array([config.label_of_class(m) for m in config.modalities])
    start_key, table_key, play_key = jax.random.split(key, 3)
    start_keys = jax.random.split(start_key, settings.num_starts)
    random_starts = jax.vmap(lambda key: random_start(key, mdp))(start_keys)
    classes, seen = (
        jnp.concatenate([jnp.asarray(every), drawn])
        for every, drawn in zip(episodes.every_state(mdp), random_starts, strict=True)
    )
    expected = policies.expected_rewards(table_key, mdp, modality, _EXPECTATION_DRAWS)
    compared = (
        policies.greedy(mdp, q_network, config.dqn.hidden),
        policies.optimal(mdp, expected, labels),
        policies.naive(mdp, modality),
        policies.uniform(mdp),
    )

    # One policy after the other, by a switch: the program is compiled once for all of them.
    def with_policy(which: jax.Array) -> tuple[jax.Array, jax.Array]:
        def act(key: Key, state: MapState) -> jax.Array:
            branches = [functools.partial(policy, key, state) for policy in compared]
            return jax.lax.switch(which, [lambda b=b: b().astype(jnp.int32) for b in branches])

        def episode(key: Key, classes: jax.Array, seen: jax.Array):
            reset_key, episode_key = jax.random.split(key)
            start = reset(reset_key, mdp, classes, seen)
            return episodes.play(episode_key, mdp, act, start, modality)

        def repeat(i: jax.Array, sums: tuple[jax.Array, jax.Array]):
            keys = jax.random.split(jax.random.fold_in(play_key, i), len(classes))
            found = jax.vmap(episode)(keys, classes, seen)
            return jax.tree.map(jnp.add, sums, found)

        # Only the first two are compared state by state.
        number = jnp.where(which < 2, settings.num_repeats, -(-settings.num_repeats // 8))
        zero = jnp.zeros(len(classes))
        total, first = jax.lax.fori_loop(0, number, repeat, (zero, zero))
        return total / number, first / number

    return jax.lax.map(with_policy, jnp.arange(len(compared)))


def policy_figures(total: np.ndarray, first: np.ndarray, num_random: int) -> dict[str, Any]:
    """The block of one modality in the summary's `dqn`, without the speed.

    Args:
      total: `[P, S]` from `play`.
      first: `[P, S]` from `play`.
      num_random: how many of the starts, the last ones, are random; the others are every state.
    """
    num_states = total.shape[1] - num_random
    whole = dict(zip(POLICIES, total[:, num_states:].mean(axis=1).tolist(), strict=True))
    one_step = dict(zip(POLICIES, first[:, num_states:].mean(axis=1).tolist(), strict=True))
    missed = total[POLICIES.index("optimal"), :num_states] - total[0, :num_states]
    return {
        **whole,
        # Where no look pays, no policy has anything to reach.
        "fraction_of_optimal": whole["return"] / whole["optimal"] if whole["optimal"] else None,
        "one_step": {
            "policy": one_step["return"],
            "optimal": one_step["optimal"],
            "random": one_step["random"],
        },
        "optimal_states": int(np.sum(missed <= 0.01)),
        "num_states": num_states,
    }

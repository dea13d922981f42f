"""The MDPs of a training, and stages that compare policies in them."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import Config
from jaxsense.core.networks import Params
from jaxsense.core.types import Fusion, Key
from jaxsense.dqn import episodes, policies
from jaxsense.dqn import training as dqn
from jaxsense.dqn.agent import Underway
from jaxsense.dqn.episodes import Start, reference
from jaxsense.dqn.mdp import Mdp
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.policies import Known
from jaxsense.dqn.starts import random_start
from jaxsense.looks import Bank, mdp_of_one
from jaxsense.models import Models, make_models
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Output

COMPARED = ("latent", "optimal", "greedy", "naive", "random")
"""Names of the policies to compare in the map MDP, from `dqn.policies.POLICIES`; `optimal` is the
reference of the MDP, see `dqn.episodes`."""

Rewards = dict[str, tuple[Float[Array, " S"], Float[Array, " S"]]]
"""By policy, `[S]` total reward and `[S]` reward of the first action from each start, averaged over
the noise of looks; NaN where a value or a reward is NaN."""

_STATE_BY_STATE = ("latent", "optimal")
_LEAST_GROUP = 1152  # episodes: smaller groups cost more than they save


def evaluation(mdp: Mdp, config: Config, starts: Start) -> dqn.Evaluate:
    """The mean total reward of a Q-network's policy, in one episode from each start."""

    def evaluate(key: Key, q_network: Params) -> Float[Array, ""]:
        models = make_models(config, fusion=mdp.fusion, q_networks=(q_network,))

        def act(key: Key, known: Known, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
            return policies.best(policies.latent(key, models, known)), memory

        def episode(key: Key, start: Start) -> jax.Array:
            return episodes.run_episode(key, mdp, models.bayes, act, start)[0]

        keys = jax.random.split(key, config.evaluation.num_starts)
        return jnp.mean(jax.vmap(episode)(keys, starts))

    return evaluate


def compare_policies(
    key: Key,
    models: Models,
    mdp: Mdp,
    config: Config,
    random: tuple[Int[Array, "E N"], Bool[Array, "E N M"]],
) -> Rewards:
    """Plays episodes with `COMPARED`, with the same looks and starts.

    Args:
      models: whose only Q-network is that of the robot's modality.
      mdp: of one robot, with held-out features.
      random: classes and earlier looks of random starts.

    Returns:
      Rewards from the states of `episodes.every_state`, then from the random starts.
    """
    settings = config.evaluation
    table_key, play_key = jax.random.split(key)
    starts = jax.tree.map(lambda *x: jnp.concatenate(x), _every_state(mdp.num_pois, config), random)
    optimal = reference(table_key, mdp, models, models.bayes.labels)
    looks = jnp.sum(starts[1][..., mdp.robots[0]], axis=-1)
    often, seldom = settings.num_repeats, -(-settings.num_repeats // 8)
    numbers = jnp.stack([often if name in _STATE_BY_STATE else seldom for name in COMPARED])

    def begin(key: Key, classes: jax.Array, seen: jax.Array) -> tuple[Key, Start]:
        reset_key, episode_key = jax.random.split(key)
        return episode_key, episodes.reset(reset_key, mdp, models.bayes, classes, seen)

    def episode(which: Int[Array, ""], key: Key, start: Start) -> tuple[jax.Array, jax.Array]:
        def act(key: Key, known: Known, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
            of_each = [
                functools.partial(optimal, known, start.state.classes)
                if name == "optimal"
                else functools.partial(policies.POLICIES[name], key, models, known)
                for name in COMPARED
            ]
            # By a switch, so that one program is compiled for all policies.
            return policies.best(jax.lax.switch(which, of_each)), memory

        return episodes.run_episode(key, mdp, models.bayes, act, start)

    def repeat(i: jax.Array, sums: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        keys = jax.random.split(jax.random.fold_in(play_key, i), len(starts[0]))
        begun = jax.vmap(begin)(keys, *starts)

        def with_policy(
            given: tuple[jax.Array, tuple[jax.Array, jax.Array]],
        ) -> tuple[jax.Array, jax.Array]:
            which, sums = given

            def play() -> tuple[jax.Array, jax.Array]:
                found = _in_groups(jax.vmap(functools.partial(episode, which)), looks, begun)
                return jax.tree.map(jnp.add, sums, found)

            return jax.lax.cond(i < numbers[which], play, lambda: sums)

        return jax.lax.map(with_policy, (jnp.arange(len(COMPARED)), sums))

    zero = jnp.zeros((len(COMPARED), len(starts[0])))
    sums = jax.lax.fori_loop(0, often, repeat, (zero, zero))
    total, first = (x / numbers[:, None] for x in sums)
    return {name: (total[i], first[i]) for i, name in enumerate(COMPARED)}


def _in_groups(
    play: Callable[..., tuple[jax.Array, jax.Array]],
    looks: Int[Array, " S"],
    begun: tuple[Key, Start],
) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
    """Plays episodes on a CPU group by group, so that short ones need not wait for long ones.

    The more looks of the own sensor came before, the shorter is the episode.
    """
    number = len(looks) // _LEAST_GROUP if jax.default_backend() == "cpu" else 1
    if number <= 1:
        return play(*begun)
    # Some episodes are played twice where the groups do not divide them.
    rows = jnp.resize(jnp.argsort(looks), (number, -(-len(looks) // number)))
    found = jax.lax.map(lambda of: play(*jax.tree.map(lambda x: x[of], begun)), rows)
    return jax.tree.map(jnp.zeros(len(looks)).at[rows].set, found)


def _every_state(
    num_pois: int, config: Config
) -> tuple[Int[np.ndarray, "S N"], Bool[np.ndarray, "S N M"]]:
    """The states of the map in which policies are compared, see `episodes.every_state`."""
    num_classes, num_modalities = len(config.arena.classes), len(config.modalities)
    limit = config.evaluation.num_states
    return episodes.every_state(num_pois, num_classes, num_modalities, limit)


def permutations(config: Config) -> Bool[np.ndarray, " S"]:
    """Whether all classes of each compared state of the map differ.

    These are the `N! 2^(N M)` states of the paper.
    """
    classes, _ = _every_state(config.arena.num_pois, config)
    return np.all(np.diff(np.sort(classes, axis=1), axis=1) > 0, axis=1)


def play_policies(
    key: Key,
    config: Config,
    *,
    modality: Int[Array, ""],
    q_network: Params,
    fusion: Fusion,
    look_values: tuple[LookValues, ...],
    detections: Detections,
    starts: tuple[Underway, Start],
    num_pois: int | None = None,
) -> Rewards:
    """Runs `compare_policies` for one modality, from the starts of evaluations.

    With another number of PoIs than in the arena, other starts are drawn.
    """
    models = make_models(config, fusion=fusion, look_values=look_values, q_networks=(q_network,))
    mdp = mdp_of_one(config, fusion, Bank(detections.held_out), modality, num_pois)
    start = starts[1].state.classes, starts[1].state.seen
    if num_pois is not None:
        start_key, key = jax.random.split(key)
        keys = jax.random.split(start_key, config.evaluation.num_starts)
        start = jax.vmap(lambda key: random_start(key, mdp))(keys)
    return compare_policies(key, models, mdp, config, start)


def play_numbers(key: Key, config: Config, **inputs: Output) -> list[Rewards]:
    """Runs `play_policies` with each number of PoIs in `evaluation.num_pois`."""
    settings = config.evaluation
    fewer = dataclasses.replace(settings, num_states=1, num_repeats=-(-settings.num_repeats // 8))
    there = dataclasses.replace(config, evaluation=fewer)
    return [
        play_policies(jax.random.fold_in(key, number), there, num_pois=number, **inputs)
        for number in settings.num_pois
    ]

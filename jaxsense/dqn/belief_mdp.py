"""The shared map as a Markov decision process.

Korthals et al. 2018, Sec. III and IV. The map holds a Gaussian belief for each of N points of
interest. Action n < N looks at PoI n with the agent's own sensor and writes the detection into the
map; action N is no operation (NOP) and ends the episode. The caller supplies the functions that
look and write.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import MdpConfig
from jaxsense.core import checks
from jaxsense.core.types import Belief, Index, Key, call, pytree

Scene = Any
"""Pytree that `observe` looks at; the MDP only carries it."""


@dataclasses.dataclass(frozen=True, eq=False)
class MapMdp:
    """The MDP of one team.

    Attributes:
      config: rewards and episode length.
      num_pois: N.
      num_classes: classes that a PoI can have.
      num_modalities: M.
      unseen: `[D]` entry of an unseen PoI.
      new_scene: `(key, classes [N]) -> scene`.
      observe: `(key, scene, poi, modality) -> (features [D_m], scene)`.
      write: `(belief [D], seen [M], features [D_m], modality) -> belief [D]`.
      information: `belief [D] -> []`, what a look is rewarded for; by default the paper's.
    """

    config: MdpConfig
    num_pois: int
    num_classes: int
    num_modalities: int
    unseen: Belief
    new_scene: Callable[[Key, jax.Array], Scene]
    observe: Callable[[Key, Scene, jax.Array, int], tuple[jax.Array, Scene]]
    write: Callable[[Belief, jax.Array, jax.Array, int], Belief]
    information: Callable[[Belief], jax.Array] = lambda belief: information(belief.std)


@pytree
class MapState:
    """The map, and the scene that it describes.

    Attributes:
      belief: `[N, D]` the map.
      seen: `[N, M]` bool, which modalities have seen which PoI; hidden from the policies.
      classes: `[N]` int32 true classes; hidden from the policies.
      scene: what `observe` looks at; hidden from the policies.
      steps: `[]` int32 actions so far.
    """

    belief: Belief
    seen: jax.Array
    classes: jax.Array
    scene: Scene
    steps: jax.Array


@pytree
class Outcome:
    """Outcome of an action.

    Attributes:
      reward: `[]` float32.
      terminated: `[]` bool, NOP has ended the episode.
      truncated: `[]` bool, the episode has reached its limit of steps.
      seconds: `[]` that the action took, or None if actions take no time: each then counts as one.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    seconds: jax.Array | None = None


def information(std: jax.Array) -> jax.Array:
    """Information of a belief, `I = 1 / ||std||_2` (Korthals et al. 2018, Sec. IV).

    Args:
      std: `[..., D]` positive standard deviations.

    Returns:
      `[...]` information in inverse latent units; grows without bound as `std` -> 0.
    """
    chex.assert_shape(std, (..., None), custom_message="std")
    checks.require_positive("std", std)
    return 1.0 / jnp.linalg.norm(std, axis=-1)


def reward(gain: jax.Array, config: MdpConfig) -> jax.Array:
    """Reward of a look.

    Args:
      gain: `[...]` of information.
      config: which reward, and its numbers.

    Returns:
      `[...]` the gain, with the paper's reward -1 in place of one that is not above `min_increase`,
      and in nats less the cost of a look.
    """
    if config.reward == "nats":
        return gain - config.look_cost
    return jnp.where(gain <= config.min_increase, -1.0, gain)


def observation(belief: Belief) -> jax.Array:
    """Mean and standard deviation of each PoI's belief, `[N * 2D]`, as a Q-network reads them."""
    chex.assert_rank(belief.mean, 2, custom_message="belief.mean")
    chex.assert_shape(belief.std, belief.mean.shape, custom_message="belief.std")
    checks.require_positive("belief.std", belief.std)
    return jnp.concatenate([belief.mean, belief.std], axis=-1).reshape(-1)


def random_start(key: Key, mdp: MapMdp) -> tuple[jax.Array, jax.Array]:
    """Independent `[N]` int32 classes, and `[N, M]` bool, which modality has seen which PoI."""
    class_key, seen_key = jax.random.split(key)
    classes = jax.random.randint(class_key, (mdp.num_pois,), 0, mdp.num_classes)
    shape = (mdp.num_pois, mdp.num_modalities)
    return classes, _random_seen(seen_key, shape, mdp.config.partly_seen_starts)


def reset(
    key: Key, mdp: MapMdp, classes: jax.Array | None = None, seen: jax.Array | None = None
) -> MapState:
    """Starts an episode, in which some modalities have seen some of the PoIs.

    Args:
      key: random key.
      mdp: the MDP.
      classes: `[N]` int32 true classes; independent for each PoI by default.
      seen: `[N, M]` bool, which modality has seen which PoI; random by default.

    Returns:
      The state, whose map holds real detections. The looks at a PoI are written in the order of the
      modalities, from a random one on.
    """
    start_key, scene_key, begin_key, look_key = jax.random.split(key, 4)
    if classes is None or seen is None:
        random_classes, random_seen = random_start(start_key, mdp)
        classes = random_classes if classes is None else classes
        seen = random_seen if seen is None else seen
    chex.assert_shape(classes, (mdp.num_pois,), custom_message="classes")
    checks.require_index("classes", classes, mdp.num_classes)
    scene = mdp.new_scene(scene_key, classes)
    pois = jnp.arange(mdp.num_pois)
    looks = tuple(
        jax.vmap(lambda key, poi: mdp.observe(key, scene, poi, m)[0])(keys, pois)  # noqa: B023
        for m, keys in enumerate(jax.random.split(look_key, (mdp.num_modalities, mdp.num_pois)))
    )
    return begin(begin_key, mdp, scene, classes, seen, looks)


def begin(
    key: Key,
    mdp: MapMdp,
    scene: Scene,
    classes: jax.Array,
    seen: jax.Array,
    looks: tuple[jax.Array, ...],
) -> MapState:
    """Starts an episode in a given scene; `reset` explains how the map is written.

    Args:
      key: random key.
      mdp: the MDP.
      scene: what `observe` will look at.
      classes: `[N]` int32 true classes.
      seen: `[N, M]` bool, which modality has seen which PoI.
      looks: for each modality `[N, D_m]` features of a look at each PoI; ignored where `seen` is
        False.
    """
    chex.assert_shape(seen, (mdp.num_pois, mdp.num_modalities), custom_message="seen")
    if seen.dtype != bool:
        raise ValueError(f"seen of dtype {seen.dtype}: must be bool")
    first = jax.random.randint(key, (mdp.num_pois,), 0, mdp.num_modalities)
    entries = jax.vmap(lambda *poi: _looked_at(mdp, *poi))(looks, seen, first)
    return MapState(entries, seen, classes, scene, jnp.int32(0))


def step(
    key: Key, mdp: MapMdp, state: MapState, action: jax.Array, modality: Index
) -> tuple[MapState, Outcome]:
    """Looks at a PoI with one modality's sensor, or ends the episode.

    Args:
      key: random key.
      mdp: the MDP.
      state: the current state.
      action: `[]` int32, a PoI or N for NOP.
      modality: index of the agent's own sensor. As a `[]` int32 array one program serves all
        modalities, and its range is not checked.

    Returns:
      The next state and the outcome. The reward is that of the look, see `reward`; 0 for NOP; NaN
      if the gain is NaN or the action does not exist.

    Raises:
      ValueError: if there is no such modality.
    """
    _check_step(mdp, state, action, modality)
    is_nop = action == mdp.num_pois
    poi = jnp.minimum(action, mdp.num_pois - 1)
    old = jax.tree.map(lambda x: x[poi], state.belief)

    def look(modality: int) -> tuple[Belief, Scene]:
        features, scene = mdp.observe(key, state.scene, poi, modality)
        return mdp.write(old, state.seen[poi], features, modality), scene

    new, scene = call(look, modality, mdp.num_modalities)
    of_look = reward(mdp.information(new) - mdp.information(old), mdp.config)
    exists = (action >= 0) & (action <= mdp.num_pois)

    looked = dataclasses.replace(
        state,
        belief=jax.tree.map(lambda x, y: x.at[poi].set(y), state.belief, new),
        seen=state.seen.at[poi, modality].set(True),
        scene=scene,
    )
    after = jax.tree.map(lambda x, y: jnp.where(is_nop, x, y), state, looked)
    after = dataclasses.replace(after, steps=state.steps + 1)
    outcome = Outcome(
        reward=jnp.where(exists, jnp.where(is_nop, 0.0, of_look), jnp.nan),
        terminated=is_nop,
        truncated=~is_nop & (after.steps >= mdp.config.max_steps),
    )
    return after, outcome


def _check_step(mdp: MapMdp, state: MapState, action: jax.Array, modality: Index) -> None:
    """Raises an error that names an argument of `step` that does not fit the MDP."""
    checks.require_index("modality", modality, mdp.num_modalities)
    chex.assert_rank(action, 0, custom_message="action")
    checks.require_index("action", action, mdp.num_pois + 1)
    shape = (mdp.num_pois, *mdp.unseen.mean.shape)
    for part in (state.belief.mean, state.belief.std):
        chex.assert_shape(part, shape, custom_message="state.belief")


def _random_seen(key: Key, shape: tuple[int, int], is_partial: bool) -> jax.Array:
    """Fair coins; with `is_partial`, on condition that they differ."""
    if not is_partial:
        return jax.random.bernoulli(key, 0.5, shape)
    num_bits = shape[0] * shape[1]
    code = jax.random.randint(key, (), 1, 2**num_bits - 1)
    return (code >> jnp.arange(num_bits) & 1).astype(bool).reshape(shape)


def _looked_at(mdp: MapMdp, looks: tuple[jax.Array, ...], seen, first) -> Belief:
    """Entry of one PoI after the looks for which `[M]` `seen` is True, in rotated order."""
    entry = mdp.unseen
    for start in range(mdp.num_modalities):
        order = [(start + i) % mdp.num_modalities for i in range(mdp.num_modalities)]
        written, seen_so_far = mdp.unseen, jnp.zeros(mdp.num_modalities, bool)
        for m in order:
            new = mdp.write(written, seen_so_far, looks[m], m)
            written = jax.tree.map(lambda n, o: jnp.where(seen[m], n, o), new, written)  # noqa: B023
            seen_so_far = seen_so_far.at[m].set(seen[m])
        entry = jax.tree.map(lambda n, o: jnp.where(first == start, n, o), written, entry)  # noqa: B023
    return entry

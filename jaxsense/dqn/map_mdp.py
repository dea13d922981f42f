"""The shared map as a Markov decision process.

Korthals et al. 2018, Sec. III and IV. The map holds a Gaussian belief for each of N points of
interest. Action n < N looks at PoI n with the agent's own sensor and updates its belief; action N
is no operation (NOP) and ends the episode.
"""

import dataclasses
import functools
from typing import Protocol

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import MdpConfig
from jaxsense.core import checks
from jaxsense.core.types import Belief, Fusion, Index, Key, Scene, call, pytree
from jaxsense.dqn.rewards import Reward


class Looks(Protocol):
    """Protocol of the source of an MDP's looks, for example `Bank` or `Live`; a frozen pytree."""

    @property
    def num_modalities(self) -> int:
        """M."""
        ...

    def scene(self, key: Key, classes: Int[Array, " N"]) -> Scene:
        """A random scene with PoIs of the given classes."""
        ...

    def observe(
        self, key: Key, scene: Scene, poi: Int[Array, ""], modality: int
    ) -> tuple[Float[Array, " L"], Scene]:
        """Looks at a PoI.

        Returns:
          `[D_m]` features, and the scene after the look.
        """
        ...


@pytree
class MapMdp:
    """The map MDP of one agent.

    Attributes:
      config: length and starts of episodes.
    """

    looks: Looks
    fusion: Fusion
    reward: Reward
    config: MdpConfig
    num_pois: int = struct.field(pytree_node=False)

    @property
    def map(self) -> "MapMdp":
        """The map MDP itself; of a `TeamMdp`, the one beneath it."""
        return self

    @property
    def modalities(self) -> tuple[str, ...]:
        """None: robots and their sensors are those of a `TeamMdp`."""
        return ()

    @property
    def max_steps(self) -> Int[Array, ""] | int:
        """Maximum length of an episode, in actions."""
        return self.config.max_steps

    @property
    def num_modalities(self) -> int:
        """M, the number of sensors."""
        return self.looks.num_modalities

    @property
    def num_features(self) -> int:
        """Numbers that an agent knows of each PoI: mean and standard deviation of its belief."""
        return 2 * self.fusion.prior.mean.size

    @property
    def num_classes(self) -> int:
        """C, the number of classes that a PoI can have."""
        return len(self.fusion.classes.mean)

    def information(self, belief: Belief) -> Float[Array, ""]:
        """`[]` information of a `[D]` belief, in units of the reward."""
        return self.reward.information(belief, self.fusion.class_probabilities(belief))


@pytree
class MapState:
    """State of the map MDP: the map, and the scene that it describes.

    Attributes:
      seen: `[N, M]` bool, which modalities have looked at which PoI; hidden from the policies.
      classes: `[N]` int32 true classes; hidden from the policies.
      scene: what the looks see; hidden from the policies.
      steps: `[]` int32 actions so far.
    """

    belief: Belief
    seen: jax.Array
    classes: jax.Array
    scene: Scene
    steps: jax.Array

    @property
    def map(self) -> "MapState":
        """The state itself; of a `TeamState`, that of the map."""
        return self

    @property
    def teams(self) -> tuple[()]:
        """States of teams in it: none; a `TeamState` is one."""
        return ()


@pytree
class Outcome:
    """Outcome of an action: reward, duration, and whether the episode has ended.

    Attributes:
      terminated: `[]` bool, NOP has ended the episode.
      truncated: `[]` bool, the episode has reached its limit of steps.
      seconds: `[]` that the action took; None in the map MDP, whose actions take no time.
    """

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    seconds: jax.Array | None = None


def random_start(key: Key, mdp: MapMdp) -> tuple[Int[Array, " N"], Bool[Array, "N M"]]:
    """Random classes and earlier looks.

    Returns:
      Independent `[N]` int32 classes, and `[N, M]` bool, which modality has looked at which PoI.
    """
    class_key, seen_key = jax.random.split(key)
    classes = jax.random.randint(class_key, (mdp.num_pois,), 0, mdp.num_classes)
    shape = mdp.num_pois, mdp.num_modalities
    if not mdp.config.partly_seen_starts:
        return classes, jax.random.bernoulli(seen_key, 0.5, shape)
    # Neither all zero nor all one.
    num_bits = mdp.num_pois * mdp.num_modalities
    code = jax.random.randint(seen_key, (), 1, 2**num_bits - 1)
    return classes, (code >> jnp.arange(num_bits) & 1).astype(bool).reshape(shape)


def reset(
    key: Key,
    mdp: MapMdp,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> MapState:
    """Starts an episode in which some modalities have looked at some of the PoIs.

    Args:
      seen: `[N, M]` bool, which modality has looked at which PoI; random by default.

    Returns:
      The state, whose map holds real looks. Those at a PoI are fused in the order of the
      modalities, starting from a random one.

    Raises:
      ValueError: if a class does not exist.
    """
    checks.require_key(key)
    return reset_with_looks(key, mdp, classes, seen)[0]


def reset_with_looks(
    key: Key,
    mdp: MapMdp,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> tuple[MapState, tuple[jax.Array, ...]]:
    """Starts an episode as `reset` does, and also returns the features of its looks.

    Returns:
      The state, and for each modality `[N, D_m]` features of a look at each PoI; those that `seen`
      marks have updated the map.
    """
    start_key, scene_key, begin_key, look_key = jax.random.split(key, 4)
    if classes is None or seen is None:
        random_classes, random_seen = random_start(start_key, mdp)
        classes = random_classes if classes is None else classes
        seen = random_seen if seen is None else seen
    chex.assert_shape(classes, (mdp.num_pois,))
    checks.require_index("classes", classes, mdp.num_classes)
    scene = mdp.looks.scene(scene_key, classes)
    pois = jnp.arange(mdp.num_pois)
    looks = tuple(
        jax.vmap(lambda key, poi: mdp.looks.observe(key, scene, poi, m)[0])(keys, pois)  # noqa: B023
        for m, keys in enumerate(jax.random.split(look_key, (mdp.num_modalities, mdp.num_pois)))
    )
    return begin(begin_key, mdp, scene, classes, seen, looks), looks


def begin(
    key: Key,
    mdp: MapMdp,
    scene: Scene,
    classes: Int[Array, " N"],
    seen: Bool[Array, "N M"],
    looks: tuple[jax.Array, ...],
) -> MapState:
    """Starts an episode in a given scene, see `reset`.

    Args:
      looks: for each modality `[N, D_m]` features of a look at each PoI; ignored where `seen` is
        False.
    """
    chex.assert_shape(seen, (mdp.num_pois, mdp.num_modalities))
    if seen.dtype != bool:
        raise ValueError(f"seen of dtype {seen.dtype}: must be bool")
    first = jax.random.randint(key, (mdp.num_pois,), 0, mdp.num_modalities)
    beliefs = jax.vmap(functools.partial(_looked_at, mdp))(looks, seen, first)
    return MapState(beliefs, seen, classes, scene, jnp.int32(0))


@checks.typed
def step(
    key: Key, mdp: MapMdp, state: MapState, action: Int[Array, ""], modality: Index
) -> tuple[MapState, Outcome]:
    """Looks at a PoI with one modality's sensor, or ends the episode.

    Returns:
      The next state and the outcome. The reward is that of the look, see `Reward`; 0 for NOP; NaN
      if the gain is NaN or a traced action does not exist.

    Raises:
      ValueError: if there is no such modality or action, or if the reward is not one number.
    """
    checks.require_index("modality", modality, mdp.num_modalities)
    chex.assert_rank(action, 0)
    checks.require_index("action", action, mdp.num_pois + 1)
    is_nop = action == mdp.num_pois
    poi = jnp.minimum(action, mdp.num_pois - 1)
    old = jax.tree.map(lambda x: x[poi], state.belief)

    def look(modality: int) -> tuple[Belief, Scene]:
        features, scene = mdp.looks.observe(key, state.scene, poi, modality)
        return mdp.fusion.update(old, state.seen[poi], features, modality), scene

    new, scene = call(look, modality, mdp.num_modalities)
    of_look = mdp.reward.of_gain(mdp.information(new) - mdp.information(old))
    checks.require_shape("reward of a look", of_look, ())
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


def _looked_at(mdp: MapMdp, looks: tuple[jax.Array, ...], seen, first) -> Belief:
    """Belief after the looks marked in `seen`, taken in modality order starting from `first`."""
    belief = mdp.fusion.prior
    for start in range(mdp.num_modalities):
        order = [(start + i) % mdp.num_modalities for i in range(mdp.num_modalities)]
        written, seen_so_far = mdp.fusion.prior, jnp.zeros(mdp.num_modalities, bool)
        for m in order:
            new = mdp.fusion.update(written, seen_so_far, looks[m], m)
            written = jax.tree.map(lambda n, o: jnp.where(seen[m], n, o), new, written)  # noqa: B023
            seen_so_far = seen_so_far.at[m].set(seen[m])
        belief = jax.tree.map(lambda n, o: jnp.where(first == start, n, o), written, belief)  # noqa: B023
    return belief

"""First states of episodes."""

import functools

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.core import checks
from jaxsense.core.types import Belief, Key, Scene
from jaxsense.dqn.mdp import NEVER, RECENT, Mdp, State
from jaxsense.dqn.team import Team, Travel, alone


def random_start(key: Key, mdp: Mdp) -> tuple[Int[Array, " N"], Bool[Array, "N M"]]:
    """Random classes and earlier looks of one robot.

    Returns:
      Independent classes, and which modality has looked at which PoI.
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
    mdp: Mdp,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> State:
    """Starts an episode in which some modalities have looked at some of the PoIs.

    Args:
      seen: which modality has looked at which PoI; random by default.

    Returns:
      The state, whose map holds real looks. Those at a PoI are fused in the order of the
      modalities, starting from a random one.

    Raises:
      ValueError: if a class or a sensor does not exist.
    """
    checks.require_key(key)
    return reset_with_looks(key, mdp, classes, seen)[0]


def reset_with_looks(
    key: Key,
    mdp: Mdp,
    classes: Int[Array, " N"] | None = None,
    seen: Bool[Array, "N M"] | None = None,
) -> tuple[State, tuple[jax.Array, ...]]:
    """Starts an episode as `reset` does, and also returns the features of its looks.

    Returns:
      The state, and for each modality `[N, D_m]` features of a look at each PoI; those that `seen`
      marks have updated the map.
    """
    robots = jnp.asarray(mdp.robots, jnp.int32)
    checks.require_number("number of robots", len(robots))
    checks.require_index("robots", robots, mdp.num_modalities)
    if mdp.teams is None:
        team = alone(mdp.num_pois, robots)
    else:
        key, *keys = jax.random.split(key, 6)
        team, drawn = mdp.teams.draw(keys, mdp.num_pois, robots)
        seen = drawn if seen is None else seen
    start_key, scene_key, begin_key, look_key = jax.random.split(key, 4)
    if classes is None or seen is None:
        random_classes, random_seen = random_start(start_key, mdp)
        classes = random_classes if classes is None else classes
        seen = random_seen if seen is None else seen
    chex.assert_shape(classes, (mdp.num_pois,))
    checks.require_index("classes", classes, mdp.num_classes)
    scene = mdp.looks.scene(scene_key, classes)
    far = 0.0 if mdp.teams is None else _view_distance(mdp.teams.travel, team)
    pois = jnp.arange(mdp.num_pois)
    looks = tuple(
        jax.vmap(lambda key, poi: mdp.looks.observe(key, scene, poi, m, far)[0])(keys, pois)  # noqa: B023
        for m, keys in enumerate(jax.random.split(look_key, (mdp.num_modalities, mdp.num_pois)))
    )
    return begin(begin_key, mdp, team, scene, classes, seen, looks), looks


def begin(
    key: Key,
    mdp: Mdp,
    team: Team,
    scene: Scene,
    classes: Int[Array, " N"],
    seen: Bool[Array, "N M"],
    looks: tuple[jax.Array, ...],
) -> State:
    """Starts an episode of a team in a given scene, see `reset`.

    Args:
      looks: for each modality `[N, D_m]` features of a look at each PoI; ignored where `seen` is
        False.
    """
    chex.assert_shape(seen, (mdp.num_pois, mdp.num_modalities))
    if seen.dtype != bool:
        raise ValueError(f"seen of dtype {seen.dtype}: must be bool")
    looked_from = None
    if mdp.teams is not None and mdp.novelty is not None:
        place_key, key = jax.random.split(key)
        looked_from = _earlier(place_key, mdp.teams.travel, team, seen)
    first = jax.random.randint(key, (mdp.num_pois,), 0, mdp.num_modalities)
    beliefs = jax.vmap(functools.partial(_looked_at, mdp))(looks, seen, first)
    return State(
        belief=beliefs,
        seen=seen,
        classes=classes,
        scene=scene,
        steps=jnp.int32(0),
        team=team,
        asks=team.works,
        agent=jnp.argmax(team.works).astype(jnp.int32),
        looked=jnp.zeros(len(team.works)),
        looked_from=looked_from,
        seconds=jnp.float32(0.0),
    )


def _earlier(
    key: Key, travel: Travel, team: Team, seen: Bool[Array, "N M"]
) -> Float[Array, "N M K 2"]:
    """Places of the looks before the start: random ones in view of their PoIs."""
    angle = jax.random.uniform(key, seen.shape, maxval=2 * jnp.pi)
    around = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    far = _view_distance(travel, team)
    places = team.positions[:, None] + far * around
    # Looks of a robot that is where the PoIs are do not repeat each other.
    last = jnp.where((seen & (far > 0))[..., None], places, NEVER)
    return jnp.full((*seen.shape, RECENT, 2), NEVER).at[:, :, 0].set(last)


def _view_distance(travel: Travel, team: Team) -> Float[Array, ""]:
    """Metres from which robots have looked at PoIs; 0 if they are where the PoIs are."""
    is_there = jnp.all(team.positions == team.poses[0, :2][None])
    return jnp.where(is_there, 0.0, travel.view_distance)


def _looked_at(mdp: Mdp, looks: tuple[jax.Array, ...], seen, first) -> Belief:
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

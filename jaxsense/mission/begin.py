"""The start of missions."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import Config
from jaxsense.config.mission import PLANNING_RADIUS
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.mission import maps, roadmap
from jaxsense.mission.roadmap import Roadmap
from jaxsense.mission.state import (
    IDLE,
    RECENT_LOOKS,
    Faults,
    Mission,
    MissionState,
    Robots,
    no_faults,
)
from jaxsense.models import Models
from jaxsense.sim import arena as arenas
from jaxsense.sim import localisation
from jaxsense.sim.light import random_light
from jaxsense.sim.world import Scene

_NUM_CANDIDATES = 32  # positions drawn for each robot
_CHECKED_AT_ONCE = 4  # of them, since one of the first has room nearly always


@checks.typed
def reset(
    key: Key,
    mission: Mission,
    models: Models,
    policy: Int[Array, ""] | int = 0,
    faults: Faults | None = None,
    classes: Int[Array, " N"] | None = None,
) -> MissionState:
    """Starts a mission in a random arena with an empty map.

    Args:
      policy: index into `Mission.policies`; by default `latent`, the trained one.
      faults: which robots will fail; none by default.
      classes: of the PoIs; independent by default.

    Returns:
      The state. Robots stand at random positions with room around them.

    Raises:
      ValueError: if a class, the policy or a time is out of range.
    """
    config = mission.config
    class_key, layout_key, light_key, pose_key, error_key = jax.random.split(key, 5)
    num_pois = config.arena.num_pois
    if classes is None:
        classes = jax.random.randint(class_key, (num_pois,), 0, len(config.arena.classes))
    layout = arenas.random_layout(layout_key, config.arena, classes)
    paths = roadmap.build(config, layout)
    poses = _random_poses(pose_key, config, layout, paths)
    light = random_light(light_key, mission.world.reads_conditions)
    scene = Scene(layout, light, poses)
    faults = no_faults(config) if faults is None else faults
    error = localisation.draw(error_key, config.mission.localisation, len(config.carried))
    policy = jnp.asarray(policy, jnp.int32)
    return start(mission, models, scene, classes, policy, faults, paths, error)


@checks.typed
def start(
    mission: Mission,
    models: Models,
    scene: Scene,
    classes: Int[Array, " N"],
    policy: Int[Array, ""],
    faults: Faults,
    paths: Roadmap,
    pose_error: Float[Array, "R 3"],
) -> MissionState:
    """Starts a mission in a given arena with an empty map.

    Args:
      paths: roadmap of the layout.
      pose_error: errors of localisation, see `localisation.draw`.
    """
    config = mission.config
    num_robots, num_pois = len(config.carried), config.arena.num_pois
    num_classes = len(config.arena.classes)
    chex.assert_shape(classes, (num_pois,))
    chex.assert_shape([scene.poses, pose_error], (num_robots, 3))
    chex.assert_shape([faults.stops_at, faults.blind_at], (num_robots,))
    checks.require_index("classes", classes, num_classes)
    checks.require_index("policy", policy, len(mission.policies))
    for name, times in vars(faults).items():
        expected = "must be seconds, infinite for never"
        checks.require(f"faults.{name}", times, lambda x: x >= 0, expected)
    own_maps = config.mission.communication.own_maps
    return MissionState(
        scene=scene,
        pose_error=pose_error,
        classes=classes,
        roadmap=paths,
        faults=faults,
        policy=policy,
        velocity=jnp.zeros((num_robots, 3)),
        warmstart=jnp.zeros(3 * num_robots),
        belief=jax.tree.map(lambda x: jnp.tile(x, (num_pois, 1)), models.fusion.prior),
        log_posterior=jnp.tile(models.bayes.prior, (num_pois, 1)),
        times_seen=jnp.zeros((num_pois, len(config.modalities)), jnp.int32),
        looked_from=jnp.full(
            (num_pois, len(config.modalities), RECENT_LOOKS, 2), jnp.inf, jnp.float32
        ),
        memory=maps.empty(mission.modalities, num_classes) if own_maps else None,
        robots=_idle_robots(num_robots, paths),
        steps=jnp.int32(0),
        contacts=jnp.int32(0),
        done=jnp.bool_(False),
    )


def _idle_robots(num_robots: int, paths: Roadmap) -> Robots:
    """Robots before their first decision."""
    num_pois, num_views, num_nodes = paths.is_next.shape
    number = jnp.zeros(num_robots, jnp.int32)
    seconds = jnp.zeros(num_robots)
    return Robots(
        phase=jnp.full(num_robots, IDLE, jnp.int32),
        target=number + num_pois,
        view=number,
        to_view=jnp.zeros((num_robots, num_nodes)),
        command=jnp.zeros((num_robots, 2)),
        decided_on=number,
        excluded=jnp.zeros((num_robots, num_views + 1), bool),
        attempts=number,
        path_left=seconds,
        progress_at=seconds,
        backs_off_until=seconds,
        unreachable=jnp.zeros((num_robots, num_pois), bool),
        undetected=jnp.zeros((num_robots, num_pois), bool),
        exhausted=jnp.zeros((num_robots, num_pois), bool),
        tried_again=jnp.zeros(num_robots, bool),
        goals=number,
        reached=number,
        looks=number,
        detections=number,
    )


def _random_poses(
    key: Key, config: Config, layout: arenas.Layout, paths: Roadmap
) -> Float[Array, "R 3"]:
    """Random poses with room around the robots and, where possible, paths to all PoIs."""
    num_robots = len(config.carried)
    draws = jax.random.uniform(key, (num_robots, 3, _NUM_CANDIDATES), minval=-1.0)
    reach = config.arena.side / 2 - PLANNING_RADIUS
    candidates = reach * jnp.swapaxes(draws[:, :2], 1, 2)

    def room_at(position: jax.Array) -> jax.Array:
        to_pois = jnp.linalg.norm(layout.position - position[None], axis=-1)
        room = jnp.min(to_pois) - config.arena.poi_extent - PLANNING_RADIUS
        # A corner behind a PoI may have no way out.
        has_paths = jnp.all(paths.reaches(position, leads))
        return jnp.where(has_paths, room, room - config.arena.side)

    def place_robot(taken: jax.Array, robot: jax.Array) -> tuple[jax.Array, jax.Array]:
        def check(found: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            """How much room there is around the next candidates."""
            first, free = found
            some = jax.lax.dynamic_slice_in_dim(candidates[robot], first, _CHECKED_AT_ONCE)
            apart = jnp.linalg.norm(some[:, None] - taken[None], axis=-1)
            beside = jnp.min(apart, axis=-1) - 3 * PLANNING_RADIUS
            room = jnp.minimum(jax.vmap(room_at)(some), beside)
            free = jax.lax.dynamic_update_slice_in_dim(free, room, first, 0)
            return first + _CHECKED_AT_ONCE, free

        none_yet = lambda found: (found[0] < _NUM_CANDIDATES) & ~jnp.any(found[1] > 0)  # noqa: E731
        unknown = jnp.full(_NUM_CANDIDATES, -jnp.inf)
        _, free = jax.lax.while_loop(none_yet, check, (jnp.int32(0), unknown))
        chosen = jnp.where(jnp.any(free > 0), jnp.argmax(free > 0), jnp.argmax(free))
        position, yaw = candidates[robot, chosen], jnp.pi * draws[robot, 2, chosen]
        return taken.at[robot].set(position), jnp.append(position, yaw)

    leads = paths.leads
    nowhere = jnp.full((num_robots, 2), jnp.inf)
    return jax.lax.scan(place_robot, nowhere, jnp.arange(num_robots))[1]

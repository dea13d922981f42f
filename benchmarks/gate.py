"""`python -m benchmarks.gate RUN`: how often looks at nothing are answered with a class."""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import rich.console
import rich.table

import jaxsense
from jaxsense.config import ConfigError, SearchConfig
from jaxsense.sim import absence, amiro, search, viewpoints
from jaxsense.sim import arena as arenas
from jaxsense.sim import world as worlds
from jaxsense.sim.absence import View
from jaxsense.sim.world import Scene, World

SITUATIONS = ("PoI", "empty", "wall", "behind robot", "behind wall", "robot", "off", "failed")
"""`PoI`: a look at one. `empty`: its place is empty. `wall`: 0.5 to 5 m away, at any expected
distance. `behind robot`, `behind wall`: all of the PoI is covered. `robot`: one in its place.
`off`: the bearing is wrong by 30 to 180 degrees. `failed`: the sensor has failed."""
_WALLS = (0.5, 5.0)  # m
_MIN_SIDE = 11.0  # m, of an arena with room for such walls
_AT_ONCE = 500
_SEED = 29


def view_of(key: jax.Array, world: World, scene: Scene, robot: int, name: str) -> View:
    """A look of a robot at the first PoI.

    Args:
      key: random key.
      world: the simulation.
      scene: a random scene.
      robot: index of the robot and of its modality; static.
      name: one of `SITUATIONS`; static.
    """
    config, poi, limits = world.arena.config, jnp.int32(0), world.viewpoint
    key, viewpoint_key = jax.random.split(key)
    draw = jax.random.uniform(key, (6,))
    others_at = jnp.delete(scene.poses[:, :2], robot, axis=0)
    pose, bearing = viewpoints.random_viewpoint(
        viewpoint_key, limits, config, scene.layout, others_at, poi
    )
    positions, away = scene.layout.position, jnp.array(absence.outside(config))
    distance = jnp.linalg.norm(positions[0] - pose[:2])
    any_distance = limits.min_distance + draw[0] * (limits.max_distance - limits.min_distance)
    gone, alone = positions.at[0].set(away), jnp.tile(away, (len(positions), 1))
    view = View(positions, scene.poses.at[robot].set(pose), away, bearing, distance)

    def ahead(pose: jax.Array, distance: jax.Array) -> jax.Array:
        direction = pose[2] + bearing
        return pose[:2] + distance * jnp.stack([jnp.cos(direction), jnp.sin(direction)])

    if name in ("wall", "behind wall"):
        to_wall = _WALLS[0] + draw[1] * (_WALLS[1] - _WALLS[0])
        if name == "behind wall":
            any_distance = jnp.maximum(any_distance, 0.7)
            to_wall = 0.1 + draw[1] * (any_distance - config.poi_extent - 0.15)
        facing = jnp.radians(40.0) * (draw[2] - 0.5) - bearing
        x = config.side / 2 - to_wall * jnp.cos(facing + bearing)
        pose = jnp.stack([x, 2 * draw[3] - 1, facing])
        behind = alone.at[0].set(ahead(pose, any_distance))
        return dataclasses.replace(
            view,
            positions=behind if name == "behind wall" else alone,
            poses=view.poses.at[robot].set(pose),
            distance=any_distance,
        )
    if name == "empty":
        return dataclasses.replace(view, positions=gone, distance=any_distance)
    if name == "robot":
        twin = ahead(pose, any_distance)
        return dataclasses.replace(view, positions=gone, twin=twin, distance=any_distance)
    if name == "behind robot":
        is_low = world.sensors[robot].height < amiro.BODY_HEIGHT
        half_width = amiro.BODY_RADIUS if is_low else amiro.LIDAR_HALF_WIDTH
        share = (0.5 + 0.4 * draw[1]) * half_width / config.poi_extent
        # Along the true bearing, which the window's centre misses by an error.
        twin = pose[:2] + share * (positions[0] - pose[:2])
        return dataclasses.replace(view, twin=twin)
    if name == "off":
        by = jnp.radians(30.0 + 150.0 * draw[1]) * jnp.where(draw[2] < 0.5, 1.0, -1.0)
        bearing = (bearing + by + jnp.pi) % (2 * jnp.pi) - jnp.pi
        return dataclasses.replace(view, positions=alone.at[0].set(positions[0]), bearing=bearing)
    return view


def simulate(
    key: jax.Array, world: World, robot: int, name: str
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Readings of one look, and the believed bearing and the expected distance of its PoI.

    Args:
      key: random key.
      world: the simulation.
      robot: index of the robot and of its modality; static.
      name: one of `SITUATIONS`; static.
    """
    class_key, scene_key, view_key, noise_key = jax.random.split(key, 4)
    arena = world.arena.config
    classes = jax.random.randint(class_key, (arena.num_pois,), 0, len(arena.classes))
    scene = worlds.random_scene(scene_key, world, classes)
    view = view_of(view_key, world, scene, robot, name)
    layout = dataclasses.replace(scene.layout, position=view.positions)
    scene = dataclasses.replace(scene, layout=layout, poses=view.poses)
    data = arenas.place(world.arena, layout, view.poses)
    readings = worlds.scan_around(
        noise_key, world, scene, data, robot, view.bearing, robot, twin=view.twin
    )
    if name == "failed":
        readings = jnp.full_like(readings, world.sensors[robot].blind)
    return readings, view.bearing, view.distance


def answered(
    config: jaxsense.Config,
    models: jaxsense.Models,
    number: int,
    errors: SearchConfig | None = None,
) -> dict[str, dict[str, float]]:
    """Share of looks that are answered with a class, by modality and situation.

    Args:
      config: settings of the run.
      models: its trained models.
      number: looks in each situation.
      errors: largest errors of the robot's pose to search for; none by default.
    """
    errors = SearchConfig() if errors is None else errors
    arena = dataclasses.replace(config.arena, side=max(config.arena.side, _MIN_SIDE))
    made = worlds.make_world(dataclasses.replace(config, arena=arena))
    wide = tuple(search.widened(sensor, errors) for sensor in made.sensors)
    world = dataclasses.replace(made, sensors=wide)
    found: dict[str, dict[str, float]] = {}
    for robot, modality in enumerate(config.modalities):

        def share(key: jax.Array, name: str, robot: int = robot) -> float:
            @jax.jit
            def answers(keys: jax.Array, models: jaxsense.Models) -> jax.Array:
                def one(key: jax.Array) -> jax.Array:
                    readings, bearing, distance = simulate(key, world, robot, name)
                    return models.detect_in_window(
                        robot, made.sensors[robot], readings, bearing, distance, errors
                    ).is_there

                return jax.lax.map(one, keys, batch_size=_AT_ONCE)

            return float(jnp.mean(answers(jax.random.split(key, number), models)))

        key = jax.random.fold_in(jax.random.key(_SEED), robot)
        found[modality] = {name: share(key, name) for name in SITUATIONS}
    return found


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("--looks", type=int, default=10_000, help="in each situation")
    parser.add_argument(
        "--search", type=float, nargs=2, default=(0.0, 0.0), metavar=("M", "DEGREES")
    )
    parser.add_argument("--trust", action="store_true", help="import the run's own sensors")
    arguments = parser.parse_args(argv)
    try:
        errors = SearchConfig(*arguments.search)
    except ConfigError as error:
        parser.error(str(error))
    config, models = jaxsense.load(arguments.run, arguments.trust)
    found = answered(config, models, arguments.looks, errors)
    table = rich.table.Table("answered with a class", *found, title=f"{arguments.looks} looks each")
    for name in SITUATIONS:
        table.add_row(name, *(f"{of_modality[name]:.4f}" for of_modality in found.values()))
    rich.console.Console().print(table)


if __name__ == "__main__":
    main()

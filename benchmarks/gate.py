"""`python -m benchmarks.gate RUNS`: how often looks at nothing are answered with a class."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp

import jaxsense
from benchmarks import studies
from benchmarks.measure import reserve
from jaxsense.config import SearchConfig
from jaxsense.config.checks import check_fields, limited
from jaxsense.config.options import Name
from jaxsense.run import cli, devices
from jaxsense.sim import absence, amiro, search, viewpoints
from jaxsense.sim import arena as arenas
from jaxsense.sim import world as worlds
from jaxsense.sim.absence import View
from jaxsense.sim.world import Scene, World

PROGRAM = "benchmarks.gate"
SITUATIONS = {
    "PoI": "a PoI",
    "empty": "the PoI's empty position",
    "wall": "a wall, 0.5 to 5 m away",
    "behind robot": "a robot that covers the PoI",
    "behind wall": "a wall that covers the PoI",
    "robot": "a robot in the PoI's position",
    "off": "the PoI, 30 to 180 degrees off the bearing",
    "failed": "anything, with a failed sensor",
}
"""What a sensor looks at, and how a table calls it. The expected distance of `empty` and `wall` is
any."""
_WALLS = (0.5, 5.0)  # m
_MIN_SIDE = 11.0  # m, of an arena with room for such walls
_AT_ONCE = 500
_SEED = 29


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Counts looks at PoIs and at nothing that are accepted."""

    runs: Annotated[tuple[Path, ...], Name("RUNS")] = limited(
        (Path("pretrained:default"), Path("pretrained:noisy")), min_items=1
    )
    """Directories of finished runs, `latest`, or `pretrained:PRESET`."""
    looks: int = limited(10_000, at_least=1)
    """In each situation."""
    search_position: float = 0.0
    """Largest error of the position to search for, in metres."""
    search_heading: float = 0.0
    """Largest error of the heading to search for, in degrees. With a search, looks without one are
    counted, too."""
    trust: bool = False
    """Run the code of custom sensors that a run's `config.json` names."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        self.search  # noqa: B018

    @property
    def search(self) -> SearchConfig:
        """The search."""
        return SearchConfig(position=self.search_position, heading=self.search_heading)


def _view_of(world: World, robot: int, name: str, key: jax.Array, scene: Scene) -> View:
    """A look of a robot at the first PoI of a random scene, in one of `SITUATIONS`."""
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
    key: jax.Array, world: World, robot: int, situation: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Readings of one look, the believed bearing, the expected distance and the class of its PoI.

    Args:
      key: random key.
      world: the simulation.
      robot: index of the robot and of its modality; static.
      situation: `[]` index in `SITUATIONS`.
    """
    class_key, scene_key, view_key, noise_key = jax.random.split(key, 4)
    arena = world.arena.config
    classes = jax.random.randint(class_key, (arena.num_pois,), 0, len(arena.classes))
    scene = worlds.random_scene(scene_key, world, classes)
    views = [functools.partial(_view_of, world, robot, name) for name in SITUATIONS]
    view = jax.lax.switch(situation, views, view_key, scene)
    layout = dataclasses.replace(scene.layout, position=view.positions)
    scene = dataclasses.replace(scene, layout=layout, poses=view.poses)
    data = arenas.place(world.arena, layout, view.poses)
    readings = worlds.scan_around(
        noise_key, world, scene, data, robot, view.bearing, robot, twin=view.twin
    )
    has_failed = situation == [*SITUATIONS].index("failed")
    readings = jnp.where(has_failed, world.sensors[robot].blind, readings)
    return readings, view.bearing, view.distance, classes[0]


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

        @functools.partial(jax.jit, compiler_options=devices.compiler_options())
        def share(keys: jax.Array, models: jaxsense.Models, situation: jax.Array) -> jax.Array:
            def one(key: jax.Array) -> jax.Array:
                readings, bearing, distance, _ = simulate(key, world, robot, situation)  # noqa: B023
                return models.detect_in_window(
                    robot,  # noqa: B023
                    made.sensors[robot],  # noqa: B023
                    readings,
                    bearing,
                    distance,
                    errors,
                ).is_there

            return jnp.mean(jax.lax.map(one, keys, batch_size=_AT_ONCE))

        keys = jax.random.split(jax.random.fold_in(jax.random.key(_SEED), robot), number)
        found[modality] = {
            name: float(share(keys, models, jnp.int32(i))) for i, name in enumerate(SITUATIONS)
        }
    return found


def measure_all(arguments: Arguments) -> dict[str, object]:
    """The content of the JSON file: shares by run, modality and situation.

    Args:
      arguments: of the program.
    """
    results = studies.origin(PROGRAM, arguments)
    searches = {"answered": SearchConfig(), "answered in a search": arguments.search}
    for name, errors in searches.items():
        results[name] = {
            str(run): answered(
                *studies.load(PROGRAM, run, arguments.trust), arguments.looks, errors
            )
            for run in arguments.runs
            if errors.applies or name == "answered"
        }
    return results


def table(results: Mapping[str, Any]) -> str:
    """The shares without a search, in Markdown.

    Args:
      results: the content of the JSON file.
    """
    return _table(results, lambda *place: f"{_share(results['answered'], *place):.4f}")


def of_search(results: Mapping[str, Any]) -> str:
    """The shares without a search and with one, in Markdown.

    Args:
      results: the content of the JSON file.
    """

    def cell(*place: str) -> str:
        both = results["answered"], results["answered in a search"]
        return ", ".join(f"{_share(each, *place):.4f}" for each in both)

    return _table(results, cell)


def _share(answered: Mapping[str, Any], run: str, modality: str, situation: str) -> float:
    return answered[run][modality][situation]


def _table(results: Mapping[str, Any], cell: Callable[[str, str, str], str]) -> str:
    columns = [(run, name) for run, found in results["answered"].items() for name in found]
    heads = [f"{studies.in_words(name)} of `{studies.name_of(run)}`" for run, name in columns]
    rows = [
        [about, *(cell(*column, situation) for column in columns)]
        for situation, about in SITUATIONS.items()
    ]
    return studies.with_origin(studies.as_table(["looks at", *heads], rows), results)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    reserve(PROGRAM, "json", arguments.json)
    results = measure_all(arguments)
    studies.write(arguments.json, results)
    print((of_search if arguments.search.applies else table)(results))


if __name__ == "__main__":
    main()

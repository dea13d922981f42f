"""A mission seen from above, and beside it the shared map as its ellipses shrink."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch, Rectangle

from jaxsense.config import ArenaConfig, Config
from jaxsense.mission import Case, Mission, MissionState, Record, reset, rollout
from jaxsense.mission.evaluation import chunks, keys_of_episode
from jaxsense.mission.state import ENDED
from jaxsense.models import Models
from jaxsense.sim import amiro, raycast
from jaxsense.sim.arena import Layout, place
from jaxsense.types import Key

FRAME_PERIOD = 0.3  # s of the mission between two frames
SPEED = 3.0  # times real time
_RAYS = 41
_PHASES = ("asks", "drives to", "looks at", "backs off from", "has ended", "has failed")
_ROBOT_COLOURS = ("tab:purple", "tab:orange", "tab:cyan", "tab:olive")


def write(path: Path, key: Key, mission: Mission, models: Models, case: Case, title: str) -> None:
    """Plays the first mission of `Player.play` with the same key, and writes it as a GIF.

    Args:
      path: file to write.
      key: random key, as given to `Player.play`.
      mission: the mission.
      models: trained networks.
      case: policy and failures.
      title: what to call it.
    """
    settings = mission.config.mission
    state, record = play_first(key, mission, models, case)
    # A little longer than the mission, to look at the finished map.
    last = min(int(state.steps) + round(2.0 / settings.control_period), len(record.time))
    frames = np.arange(0, last, max(1, round(FRAME_PERIOD / settings.control_period)))
    record = jax.tree.map(lambda x: np.asarray(x)[frames], record)
    beams = np.asarray(_beams(mission, state, jnp.asarray(record.poses)))
    figure = Figure(figsize=(10, 5.6))
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.05, right=0.97, top=0.84, bottom=0.09, wspace=0.18)
    arena_view = _ArenaView(left, mission.config, state)
    map_view = _MapView(right, mission.config, state, models)
    heading = figure.suptitle("", fontsize=11)

    def draw(frame: int) -> None:
        arena_view.draw(record, frame, beams)
        map_view.draw(record, frame)
        doing = [
            f"{modality} {_doing(phase, target, mission.config.arena.num_pois)}"
            for modality, phase, target in zip(
                mission.config.modalities, record.phase[frame], record.target[frame], strict=True
            )
        ]
        heading.set_text(f"{title}   {record.time[frame]:.1f} s\n" + "      ".join(doing))

    film = FuncAnimation(figure, draw, frames=len(frames), blit=False)
    film.save(path, PillowWriter(fps=round(SPEED / FRAME_PERIOD)), dpi=80)


def play_first(
    key: Key, mission: Mission, models: Models, case: Case
) -> tuple[MissionState, Record]:
    """The first mission of `Player.play` with this key: its end and the records on the way."""
    arena_key, play_key = keys_of_episode(key, 0)
    chunk, most_chunks = chunks(mission.config)
    steps = chunk * most_chunks

    def play(models: Models) -> tuple[MissionState, Record]:
        start = reset(arena_key, mission, case.policy, case.faults)

        def go_on(state: MissionState, number: jax.Array) -> tuple[MissionState, Record]:
            return rollout(jax.random.fold_in(play_key, number), mission, models, state, chunk)

        state, record = jax.lax.scan(go_on, start, jnp.arange(most_chunks))
        return state, jax.tree.map(lambda x: x.reshape(steps, *x.shape[2:]), record)

    return jax.jit(play)(models)


def _beams(mission: Mission, state: MissionState, poses: jax.Array) -> jax.Array:
    """`[F, R, B, 2]` where rays over each sensor's whole field of view end, for `[F, R, 3]`."""
    world, layout = mission.world, state.scene.layout

    def of_frame(poses: jax.Array) -> jax.Array:
        data = place(world.arena, layout, poses)
        ends = []
        for robot, sensor in enumerate(world.sensors):
            angles = poses[robot, 2] + jnp.linspace(sensor.angles[0], sensor.angles[-1], _RAYS)
            section = raycast.cross_section(world.arena, data, sensor.height, robot)
            hit = raycast.cast(section, poses[robot, :2], angles)
            distance = jnp.minimum(hit.distance, 5.0)[:, None]
            ends.append(poses[robot, None, :2] + distance * _direction(angles))
        return jnp.stack(ends)

    return jax.jit(jax.vmap(of_frame))(poses)


def _direction(angle: jax.Array) -> jax.Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


class _ArenaView:
    """The arena from above: PoIs, robots, their trails and rays."""

    def __init__(self, axes: Any, config: Config, state: MissionState):
        arena, layout, half = config.arena, state.scene.layout, config.arena.side / 2
        axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xlabel="x [m]")
        axes.set_title("the arena")
        for n, (x, y) in enumerate(np.asarray(layout.position)):
            axes.add_patch(_poi(arena, layout, n))
            axes.text(x, y, str(n + 1), color="white", ha="center", va="center", weight="bold")
        self._state = state
        self._robots = []
        for r, modality in enumerate(config.modalities):
            colour = _ROBOT_COLOURS[r % len(_ROBOT_COLOURS)]
            rays = LineCollection([], colors=colour, linewidths=0.5, alpha=0.35)
            axes.add_collection(rays)
            trail = axes.plot([], [], color=colour, linewidth=1.2, alpha=0.8)[0]
            body = Circle((0, 0), amiro.BODY_RADIUS, color=colour, zorder=3, label=modality)
            axes.add_patch(body)
            nose = axes.plot([], [], color="white", linewidth=2, zorder=4)[0]
            self._robots.append((body, nose, trail, rays))
        axes.legend(loc="upper left", fontsize=8)

    def draw(self, record: Record, frame: int, beams: np.ndarray) -> None:
        for r, (body, nose, trail, rays) in enumerate(self._robots):
            x, y, yaw = record.poses[frame, r]
            body.set_center((x, y))
            nose.set_data(
                [x, x + amiro.BODY_RADIUS * np.cos(yaw)], [y, y + amiro.BODY_RADIUS * np.sin(yaw)]
            )
            trail.set_data(*record.poses[: frame + 1, r, :2].T)
            is_blind = record.time[frame] >= self._state.faults.blind_at[r]
            is_working = record.phase[frame, r] < ENDED and not is_blind
            ends = beams[frame, r] if is_working else []
            rays.set_segments([((x, y), tuple(end)) for end in ends])


class _MapView:
    """The latent space: the classes, and the belief of every PoI."""

    def __init__(self, axes: Any, config: Config, state: MissionState, models: Models):
        means = np.asarray(models.class_beliefs.mean)
        reach = 1.6 + float(np.abs(means).max())
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axes.set(xlabel="$\\mu_1$", ylabel="$\\mu_2$")
        axes.set_title("the shared map: 1-sigma ellipses of the posteriors")
        axes.grid(alpha=0.2)
        for label, mean in zip(config.arena.classes, means, strict=True):
            colour = config.arena.colours[label.split(" ")[0]]
            point = np.pad(mean, (0, 2))[:2]
            axes.plot(*point, "+", color=colour, markersize=14, markeredgewidth=2)
            place = {"textcoords": "offset points", "ha": "center", "color": colour}
            axes.annotate(label, point, (0, 14), **place)
        self._ellipses = []
        for n, colour in enumerate(np.asarray(state.scene.layout.colour)):
            ellipse = Ellipse((0, 0), 1, 1, facecolor="none", edgecolor=colour, linewidth=2.5)
            number = axes.text(0, 0, str(n + 1), weight="bold")
            self._ellipses.append((axes.add_patch(ellipse), number))

    def draw(self, record: Record, frame: int) -> None:
        for n, (ellipse, number) in enumerate(self._ellipses):
            mean = np.pad(record.belief.mean[frame, n], (0, 2))[:2]
            std = np.pad(record.belief.std[frame, n], (0, 2))[:2]
            ellipse.set(center=tuple(mean), width=2 * std[0], height=2 * std[1])
            ellipse.set_linestyle("-" if record.seen[frame, n].any() else ":")
            # Numbers of PoIs at the same place in the map stand side by side.
            number.set_position(tuple(mean + np.array([0.14 * n - 0.2, -0.05])))


def _doing(phase: int, target: int, num_pois: int) -> str:
    """What a robot is doing, in words."""
    return (
        f"{_PHASES[phase]} PoI {target + 1}"
        if 1 <= phase <= 3 and target < num_pois
        else _PHASES[phase]
    )


def _poi(arena: ArenaConfig, layout: Layout, n: int) -> Patch:
    """A PoI in its true shape and colour."""
    x, y = np.asarray(layout.position[n])
    colour = np.asarray(layout.colour[n])
    shape = list(arena.shapes.values())[int(layout.shape[n])]
    u, v = (share * arena.poi_radius for share in shape.half_sides)
    if shape.primitive == "cylinder":
        return Circle((x, y), u, color=colour, zorder=2)
    turn = np.degrees(float(layout.yaw[n]))
    return Rectangle(
        (x - u, y - v),
        2 * u,
        2 * v,
        angle=turn,
        rotation_point="center",
        color=colour,
        zorder=2,
    )

"""Pictures of states of tasks, while somebody plays them."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import PyTree
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from jaxsense.core.types import Belief
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.team_mdp import Team, TeamState
from jaxsense.show.colours import in_plane, modality_colour, plane
from jaxsense.tasks import Task

_SIZE = 4.0  # inches, of each part
_DPI = 100
_ARROW = 0.6  # m, from a robot to where it looks
_MARGIN = 0.8  # m, around places
_AROUND = 0.75  # of how far classes lie apart
_OF_CLASSES = [0, 2, 3, 5, 6, 7, 8, 9, 1, 4]


def frame(task: Task, state: MapState | TeamState, actions: Sequence[int]) -> np.ndarray:
    """What is known in a state, and the truth.

    Beliefs are 2-sigma ellipses in the two latent dimensions that show classes, which are numbered,
    farthest apart. Bars show class probabilities. Dots say which sensors have looked at a PoI, also
    before the episode, and a number how often the episode's actions chose it. Of a team, robots are
    shown where they are, with where they drive; the robot whose turn it is has a black edge.

    Args:
      task: whose state it is.
      state: the state.
      actions: of the episode so far.

    Returns:
      `[H, W, 3]` uint8 sRGB.
    """
    mdp: MapMdp = task.mdp.map
    found = _read(mdp, state.map.belief)
    shown, probabilities, classes = jax.tree.map(np.asarray, (state.map.belief, *found))
    colours = _class_colours(mdp.num_classes)
    present = np.asarray(task.action_mask(state))[:-1]
    number = 2 + len(state.teams)
    figure = Figure(figsize=(_SIZE * number, _SIZE), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, number)
    title = f"{task.name}, {task.agent}", f"step {len(actions)} of {task.max_steps}"
    figure.suptitle(", ".join([*title, *(f"{float(each.seconds):.1f} s" for each in state.teams)]))
    nearest = colours[np.argmax(probabilities, axis=1)]
    _draw_beliefs(axes[0], shown, classes, colours, nearest, present)
    _draw_probabilities(axes[1], probabilities, state.map, actions, colours, present)
    _name_sensors(axes[1], task.modalities)
    for each in state.teams:
        truth = colours[np.asarray(each.map.classes)]
        team = jax.tree.map(np.asarray, each.team)
        _draw_places(axes[2], team, int(each.agent), nearest, truth)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@jax.jit
def _read(mdp: MapMdp, belief: Belief) -> tuple[jax.Array, jax.Array]:
    """`[N, C]` class probabilities of beliefs, and `[C, D]` means of classes."""
    probabilities = jax.vmap(mdp.fusion.class_probabilities)(belief)
    return probabilities, mdp.fusion.classes.mean


def frames(task: Task, states: PyTree, actions: Sequence[Sequence[int]]) -> tuple[np.ndarray, ...]:
    """Pictures of a batch of states, see `frame`.

    Args:
      task: whose states they are.
      states: `[E, ...]`.
      actions: of each episode so far.
    """
    of_host = jax.device_get(states)
    each = (jax.tree.map(lambda x, i=i: x[i], of_host) for i in range(len(actions)))
    return tuple(frame(task, state, taken) for state, taken in zip(each, actions, strict=True))


def _class_colours(number: int) -> np.ndarray:
    """`[C, 4]` RGBA."""
    # First those that are no sensor's.
    few = number <= len(_OF_CLASSES)
    return colormaps["tab10"](_OF_CLASSES[:number]) if few else colormaps["tab20"](range(number))


def _draw_beliefs(
    ax: Axes,
    belief: Belief,
    classes: np.ndarray,
    colours: np.ndarray,
    nearest: np.ndarray,
    present: np.ndarray,
) -> None:
    """Ellipses of PoIs in the colour of their most likely class, and the classes."""
    dimensions = plane(classes)
    mean, std = in_plane(belief.mean, dimensions), in_plane(belief.std, dimensions)
    places = in_plane(classes, dimensions)
    for place, colour, c in zip(places, colours, range(len(places)), strict=True):
        ax.plot(place[0], place[1], "s", color=colour, markersize=14, alpha=0.35, markeredgewidth=0)
        ax.text(place[0], place[1], str(c + 1), ha="center", va="center", color="0.25")
    low, high = places.min(axis=0), places.max(axis=0)
    # Wider beliefs, such as those before any look, would make all else small.
    margin = _AROUND * max(np.max(high - low), 1e-3)
    tops: dict[tuple[int, ...], list[int]] = {}
    for n in np.flatnonzero(present).tolist():
        width, height = 4 * std[n]
        ax.add_patch(Ellipse(mean[n], width, height, facecolor="none", edgecolor=nearest[n]))
        top = mean[n] + (0.0, 2 * std[n, 1])
        tops.setdefault(tuple(np.round(top / (margin / 4)).astype(int)), []).append(n)
    for pois in tops.values():
        top = mean[pois[0]] + (0.0, 2 * std[pois[0], 1])
        words = "PoI " + ", ".join(map(str, pois))
        style = {"color": nearest[pois[0]], "weight": "bold", "ha": "center", "va": "bottom"}
        ax.text(top[0], top[1], words, clip_on=True, **style)
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set_title("beliefs and classes")
    ax.set_xlabel(f"latent {dimensions[0] + 1}")
    ax.set_ylabel(f"latent {(*dimensions, 1)[1] + 1}")


def _draw_probabilities(
    ax: Axes,
    probabilities: np.ndarray,
    state: MapState,
    actions: Sequence[int],
    colours: np.ndarray,
    present: np.ndarray,
) -> None:
    """A bar for each PoI, its true class, the sensors that have looked, and choices so far."""
    seen, truth = np.asarray(state.seen), np.asarray(state.classes)
    pois = np.flatnonzero(present)
    left = np.zeros(len(pois))
    for c, colour in enumerate(colours):
        ax.barh(pois, probabilities[pois, c], left=left, color=colour, edgecolor="w")
        left += probabilities[pois, c]
    for n in pois.tolist():
        for m in np.flatnonzero(seen[n]).tolist():
            ax.plot(1.05 + 0.05 * m, n, "o", color=modality_colour(m), clip_on=False)
        right = 1.1 + 0.05 * seen.shape[1]
        ax.text(right, n, f"{actions.count(n)}x", ha="center", va="center")
        own = colours[truth[n]]
        ax.text(right + 0.15, n, f"{truth[n] + 1}", color=own, weight="bold", va="center")
    ax.text(1.05, -0.75, "looks, choices, truth", fontsize="small", va="center")
    ax.set(xlim=(0, 1.4), ylim=(len(present) - 0.5, -1.0), xticks=(0, 0.5, 1))
    ax.set_yticks(pois, [f"PoI {n}" for n in pois])
    ax.set_title("class probabilities")
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.spines["bottom"].set_bounds(0, 1)


def _name_sensors(ax: Axes, names: Sequence[str]) -> None:
    """A legend below the bars: the dot of each sensor, and the square of a class."""
    dots = [
        Line2D([], [], color=modality_colour(m), label=name, marker="o", linestyle="")
        for m, name in enumerate(names)
    ]
    ax.legend(
        handles=[*dots, Patch(color="0.75", label="class, by number")],
        frameon=False,
        fontsize="small",
        columnspacing=1.0,
        ncols=len(names) + 1,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.08),
    )


def _draw_places(ax: Axes, team: Team, agent: int, nearest: np.ndarray, truth: np.ndarray) -> None:
    """PoIs, in the colour of the most likely class within that of the true one, and robots."""
    for n in np.flatnonzero(team.present).tolist():
        x, y = team.positions[n]
        edge = {"markeredgecolor": truth[n], "markeredgewidth": 3}
        ax.plot(x, y, "o", color=nearest[n], markersize=16, **edge)
        ax.text(x, y, str(n), ha="center", va="center", color="w", weight="bold")
    for r, (x, y, yaw) in enumerate(team.poses):
        colour = modality_colour(int(team.modality[r])) if team.works[r] else "0.7"
        if team.works[r] and team.target[r] < len(team.positions):
            goal = team.positions[team.target[r]]
            ax.plot([x, goal[0]], [y, goal[1]], ":", color=colour)
        ends = [x, x + _ARROW * np.cos(yaw)], [y, y + _ARROW * np.sin(yaw)]
        ax.plot(*ends, color=colour, linewidth=3)
        edge = "k" if r == agent else colour
        ax.plot(x, y, "o", color=colour, markersize=10, markeredgewidth=2, markeredgecolor=edge)
    places = np.concatenate([team.positions[team.present], team.poses[:, :2]])
    (left, bottom), (right, top) = places.min(axis=0) - _MARGIN, places.max(axis=0) + _MARGIN
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    ax.set_title("places (rim: truth)")

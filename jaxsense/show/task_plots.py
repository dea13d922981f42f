"""Pictures of states of tasks, while somebody plays them."""

import jax
import numpy as np
from jaxtyping import PyTree
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxsense.core.types import Belief
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.dqn.team import Team
from jaxsense.show.colours import in_plane, modality_colour, plane
from jaxsense.tasks import Task

_SIZE = 4.0  # inches, of each part
_DPI = 100
_ARROW = 0.6  # m, from a robot to where it looks
_MARGIN = 0.8  # m, around places
_AROUND = 0.75  # of how far classes lie apart


def frame(task: Task, state: State) -> np.ndarray:
    """What is known in a state, and the truth.

    Beliefs are 2-sigma ellipses in the two latent dimensions that show classes, which are numbered,
    farthest apart. Bars show class probabilities. Beside them stand the true class and the sensors
    that have looked at a PoI, also before the episode. Of a team, robots are shown where they are,
    with where they drive; the robot whose turn it is has a black edge.

    Returns:
      `[H, W, 3]` uint8 sRGB.
    """
    mdp, drives = task.mdp, task.mdp.teams is not None
    shown, probabilities, classes = jax.device_get((state.belief, *_read(mdp, state.belief)))
    colours = colormaps["tab10" if mdp.num_classes <= 10 else "tab20"](range(mdp.num_classes))
    pois = np.flatnonzero(np.asarray(task.action_mask(state))[:-1])
    figure = Figure(figsize=(_SIZE * (2 + drives), _SIZE), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2 + drives)
    title = f"{task.name}, {task.agent}", f"step {int(state.steps)} of {task.max_steps}"
    figure.suptitle(", ".join([*title, *[f"{float(state.seconds):.1f} s"] * drives]))
    nearest = colours[np.argmax(probabilities, axis=1)]
    _draw_beliefs(axes[0], shown, classes, colours, nearest, pois)
    truth, seen = np.asarray(state.classes), np.asarray(state.seen)
    left = np.zeros(len(pois))
    for colour, of_class in zip(colours, probabilities[pois].T, strict=True):
        axes[1].barh(pois, of_class, left=left, color=colour, edgecolor="w")
        left += of_class
    names = [
        f"PoI {n}: class {truth[n] + 1}\n{', '.join(np.compress(seen[n], task.modalities))}"
        for n in pois
    ]
    axes[1].set_yticks(pois, names, fontsize="small")
    axes[1].set(xlim=(0, 1), title="class probabilities")
    axes[1].invert_yaxis()
    if drives:
        team = jax.tree.map(np.asarray, state.team)
        _draw_places(axes[2], team, int(state.agent), nearest, colours[truth])
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@jax.jit
def _read(mdp: Mdp, belief: Belief) -> tuple[jax.Array, jax.Array]:
    """`[N, C]` class probabilities of beliefs, and `[C, D]` means of classes."""
    probabilities = jax.vmap(mdp.fusion.class_probabilities)(belief)
    return probabilities, mdp.fusion.classes.mean


def frames(task: Task, states: PyTree) -> tuple[np.ndarray, ...]:
    """Pictures of `[E, ...]` states, see `frame`."""
    leaves, structure = jax.tree.flatten(jax.device_get(states))
    return tuple(frame(task, structure.unflatten(each)) for each in zip(*leaves, strict=True))


def _draw_beliefs(
    ax: Axes,
    belief: Belief,
    classes: np.ndarray,
    colours: np.ndarray,
    nearest: np.ndarray,
    pois: np.ndarray,
) -> None:
    """Ellipses of PoIs in the colour of their most likely class, and the classes."""
    dimensions = plane(classes)
    mean, std = in_plane(belief.mean, dimensions), in_plane(belief.std, dimensions)
    places = in_plane(classes, dimensions)
    for c, (x, y) in enumerate(places):
        ax.plot(x, y, "s", color=colours[c], markersize=14, alpha=0.35, markeredgewidth=0)
        ax.text(x, y, str(c + 1), ha="center", va="center", color="0.25")
    for n in pois:
        (x, y), (a, b) = mean[n], 2 * std[n]
        ax.add_patch(Ellipse((x, y), 2 * a, 2 * b, facecolor="none", edgecolor=nearest[n]))
        ax.text(x, y + b, f"PoI {n}", clip_on=True, color=nearest[n], ha="center", va="bottom")
    low, high = places.min(axis=0), places.max(axis=0)
    # Wider beliefs, such as those before any look, would make all else small.
    margin = _AROUND * max(np.max(high - low), 1e-3)
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set(title="beliefs and classes", xlabel=f"latent {dimensions[0] + 1}")
    ax.set_ylabel(f"latent {(*dimensions, 1)[1] + 1}")


def _draw_places(ax: Axes, team: Team, agent: int, nearest: np.ndarray, truth: np.ndarray) -> None:
    """PoIs, in the colour of the most likely class within that of the true one, and robots."""
    for n in np.flatnonzero(team.present):
        edge = {"markeredgecolor": truth[n], "markeredgewidth": 3}
        x, y = team.positions[n]
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

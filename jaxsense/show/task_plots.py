"""Pictures of states of tasks, while somebody plays them."""

import jax
import numpy as np
from jaxtyping import PyTree
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxsense.dqn.mdp import State
from jaxsense.dqn.team import Team
from jaxsense.show.colours import modality_colour
from jaxsense.tasks import Task

_SIZE = 4.0  # inches, of each part
_DPI = 100
_ARROW = 0.6  # m, from a robot to where it looks


def frame(task: Task, state: State) -> np.ndarray:
    """What is known in a state, and the truth.

    Bars show class probabilities. Beside them stand the true class and the sensors that have looked
    at a PoI, also before the episode. Of a team, robots are shown where they are, with where they
    drive; the robot whose turn it is has a black edge.

    Returns:
      `[H, W, 3]` uint8 sRGB.
    """
    mdp, drives = task.mdp, task.mdp.teams is not None
    probabilities = np.asarray(jax.vmap(mdp.fusion.class_probabilities)(state.belief))
    colours = colormaps["tab10" if mdp.num_classes <= 10 else "tab20"](range(mdp.num_classes))
    pois = np.flatnonzero(np.asarray(task.action_mask(state))[:-1])
    figure = Figure(figsize=(_SIZE * (1 + drives), _SIZE), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    bars, *places = figure.subplots(1, 1 + drives, squeeze=False)[0]
    title = f"{task.name}, {task.agent}", f"step {int(state.steps)} of {task.max_steps}"
    figure.suptitle(", ".join([*title, *[f"{float(state.seconds):.1f} s"] * drives]))
    truth, seen = np.asarray(state.classes), np.asarray(state.seen)
    left = np.zeros(len(pois))
    for colour, of_class in zip(colours, probabilities[pois].T, strict=True):
        bars.barh(pois, of_class, left=left, color=colour, edgecolor="w")
        left += of_class
    names = [
        f"PoI {n}: class {truth[n] + 1}\n{', '.join(np.compress(seen[n], task.modalities))}"
        for n in pois
    ]
    bars.set_yticks(pois, names, fontsize="small")
    bars.set(xlim=(0, 1), title="class probabilities")
    bars.invert_yaxis()
    for ax in places:
        team, nearest = jax.tree.map(np.asarray, state.team), np.argmax(probabilities, axis=1)
        _draw_places(ax, team, int(state.agent), colours[nearest], colours[truth])
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def frames(task: Task, states: PyTree) -> tuple[np.ndarray, ...]:
    """Pictures of `[E, ...]` states, see `frame`."""
    leaves, structure = jax.tree.flatten(jax.device_get(states))
    return tuple(frame(task, structure.unflatten(each)) for each in zip(*leaves, strict=True))


def _draw_places(ax: Axes, team: Team, agent: int, nearest: np.ndarray, truth: np.ndarray) -> None:
    """PoIs, in the colour of the most likely class within that of the true one, and robots."""
    pois, places = np.flatnonzero(team.present), team.positions
    style = {"s": 250, "c": nearest[pois], "edgecolors": truth[pois], "linewidths": 3}
    ax.scatter(*places[pois].T, **style)
    for n in pois:
        x, y = places[n]
        ax.text(x, y, str(n), ha="center", va="center", color="w", weight="bold")
    colours = [modality_colour(int(m)) for m in team.modality]
    for r, colour in enumerate(np.where(team.works, colours, "#b3b3b3")):
        here, yaw = team.poses[r, :2], team.poses[r, 2]
        if team.works[r] and team.target[r] < len(places):
            ax.plot(*np.stack([here, places[team.target[r]]]).T, ":", color=colour)
        ahead = here + _ARROW * np.array([np.cos(yaw), np.sin(yaw)])
        ax.plot(*np.stack([here, ahead]).T, color=colour, linewidth=3)
        ax.scatter(*here, s=100, color=colour, edgecolors="k" if r == agent else colour, zorder=3)
    ax.margins(0.2)
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="places (rim: truth)")

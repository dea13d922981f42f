"""The plots of a run: the paper's Fig. 4 and Fig. 5, and the sensors' scanlines."""

import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import cm, colormaps
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter

from jaxsense.config import POLICIES, Config
from jaxsense.core.types import Belief
from jaxsense.mission.compare import interval
from jaxsense.run import files
from jaxsense.run.pipeline import RunResult
from jaxsense.show import metrics
from jaxsense.show.colours import RGB, as_srgb, class_colour
from jaxsense.sim import sensors
from jaxsense.vae.calibration import reliability

_MOST_ELLIPSES = 40
_SMOOTHING = 20  # epochs
_LEAST_SHARE = 1e-4  # of wrong points, which stands for all that is less
_NUM_COLOURS = 10  # of matplotlib's cycle
_FAR = 0.2  # sigma from the median of its class, beyond which a detection is an outlier


def write_plots(path: Path, config: Config, result: RunResult) -> None:
    """Writes the plots of a run into a directory, as `NAME.png`."""
    summary = result.summary
    plots = {
        "latent_space": latent_space(config, result.posteriors),
        "reward": rewards(result.rewards, summary["dqn"]),
        "scanlines": scanlines(config, result.windows),
        "calibration": calibration(config, result.detections, summary["belief"]),
        "policies": missions(summary["mission"]),
    }
    for name, figure in plots.items():
        files.write(path / f"{name}.png", _png(figure))


def write_seeds(
    path: Path, curves: dict[str, dict[str, np.ndarray]], summary: dict[str, Any]
) -> None:
    """Writes the plots of several seeds into a directory; for `curves` see `rewards`."""
    figures = {"reward": rewards(curves, summary["dqn"]), "policies": missions(summary["mission"])}
    for name, figure in figures.items():
        files.write(path / f"{name}.png", _png(figure))


def of_missions(config: Config, summary: dict[str, Any]) -> dict[str, bytes]:
    """The files `policies.png` and, with missions elsewhere, `teams.png`, by their names."""
    figures = {"policies.png": missions(summary["mission"])}
    if "elsewhere" in summary:
        figures["teams.png"] = teams(config, summary)
    return {name: _png(figure) for name, figure in figures.items()}


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    return content.getvalue()


def latent_space(config: Config, posteriors: dict[str, Belief]) -> Figure:
    """The paper's Fig. 4: posteriors of held-out detections as 1-sigma ellipses.

    Colours show classes above and `||sigma||` below. The first column shows detections by all
    modalities together, the others by each alone, in the first two latent dimensions. Crosses mark
    detections far from the others of their class.
    """
    names = ["joint", *config.modalities]
    titles = {"joint": " & ".join(config.modalities)}
    figure = Figure(figsize=(3.6 * len(names) + 1.2, 7.6), layout="constrained")
    axes = figure.subplots(2, len(names), sharex=True, sharey=True, squeeze=False)
    shown = {n: jax.tree.map(lambda x: x[:, :_MOST_ELLIPSES], posteriors[n]) for n in names}
    norms = {name: np.linalg.norm(belief.std, axis=-1) for name, belief in shown.items()}
    scale = Normalize(min(x.min() for x in norms.values()), max(x.max() for x in norms.values()))
    sigma_map = colormaps["viridis"]
    classes = config.arena.classes
    colours = [class_colour(config.arena, label) for label in classes]
    num_far = 0
    for column, (name, belief) in zip(axes.T, shown.items(), strict=True):
        column[0].set_title(titles.get(name, f"{name} alone"))
        num_far += _beliefs(column, belief, colours, sigma_map(scale(norms[name])))
    for c, (colour, label) in enumerate(zip(colours, classes, strict=True)):
        axes[0, 0].plot([], [], "o", color=colour, label=f"({c + 1}) {label}")
    if num_far:
        total = sum(norm.size for norm in norms.values())
        label = f"{num_far} of {total} detections, far from most of their class"
        axes[0, 0].plot([], [], "x", color="0.3", label=label)
    axes[0, 0].set_ylabel("class\n$\\mu_2$")
    axes[1, 0].set_ylabel("uncertainty\n$\\mu_2$")
    _fit(axes, [*shown.values()])
    mappable = cm.ScalarMappable(scale, sigma_map)
    figure.colorbar(mappable, ax=axes[1, :], label="$\\|\\sigma\\|_2$")
    columns = min(len(classes) + bool(num_far), 4)
    figure.legend(loc="outside upper center", ncols=columns, frameon=False)
    return figure


def _beliefs(axes: Any, belief: Belief, by_class: list[RGB], by_sigma: np.ndarray) -> int:
    """Draws `[C, S]` beliefs on two axes; returns how many lie far from their class."""
    mean, std = _in_plane(belief.mean), _in_plane(belief.std)
    centre, spread = np.median(mean, axis=1), np.median(std, axis=1)
    is_far = _apart(mean, centre[:, None], spread[:, None]) > _FAR
    for c, colour in enumerate(by_class):
        _ellipses(axes[0], mean[c], std[c], np.tile(colour, (mean.shape[1], 1)), is_far[c])
        _ellipses(axes[1], mean[c], std[c], by_sigma[c], is_far[c])
    _name_classes(axes[0], centre, spread)
    axes[1].set_xlabel("$\\mu_1$")
    return int(is_far.sum())


def _fit(axes: np.ndarray, beliefs: list[Belief]) -> None:
    """Limits the axes to a square around all ellipses, with room for the names of classes."""
    means = [_in_plane(belief.mean) for belief in beliefs]
    radii = [_in_plane(belief.std) for belief in beliefs]
    low = np.min(np.subtract(means, radii), axis=(0, 1, 2))
    high = np.max(np.add(means, radii), axis=(0, 1, 2))
    half = 0.63 * np.max(high - low)
    x, y = (low + high) / 2
    axes[0, 0].set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    for ax in axes.flat:
        ax.set_aspect("equal", adjustable="box")


def _in_plane(values: Any) -> np.ndarray:
    """`[..., D]` as `[..., 2]`: the first two, or zero."""
    values = np.asarray(values)
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, 1)])[..., :2]


def _apart(mean: np.ndarray, centre: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Distance of `[..., 2]` means from a centre, in standard deviations."""
    return np.linalg.norm((mean - centre) / np.maximum(spread, 1e-6), axis=-1)


def _ellipses(
    axes: Any, mean: np.ndarray, std: np.ndarray, colours: np.ndarray, is_far: np.ndarray
) -> None:
    """Ellipses and their centres, `[S, 2]`, in the colours `[S, 3 or 4]`; crosses if far `[S]`."""
    for marker, line, chosen in ((".", "-", ~is_far), ("x", ":", is_far)):
        pairs = zip(mean[chosen], std[chosen], strict=True)
        patches = [Ellipse(m, 2 * s[0], 2 * s[1]) for m, s in pairs]
        axes.add_collection(
            PatchCollection(
                patches, facecolors="none", edgecolors=colours[chosen], alpha=0.5, linestyles=line
            )
        )
        axes.scatter(*mean[chosen].T, s=25, marker=marker, c=colours[chosen])


def _name_classes(axes: Any, centre: np.ndarray, spread: np.ndarray) -> None:
    """Writes the numbers of classes, `[C, 2]`, above their ellipses; joins those in one place."""
    waiting = list(range(len(centre)))
    while waiting:
        first = waiting[0]
        apart = _apart(centre[waiting], centre[first], spread[first])
        together = [c for c, distance in zip(waiting, apart, strict=True) if distance < _FAR]
        waiting = [c for c in waiting if c not in together]
        axes.annotate(
            " & ".join(f"({c + 1})" for c in together),
            (centre[first, 0], centre[first, 1] + max(spread[c, 1] for c in together)),
            (0, 4),
            textcoords="offset points",
            ha="center",
            va="bottom",
            weight="bold",
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )


def rewards(per_epoch: dict[str, dict[str, np.ndarray]], agents: dict[str, Any]) -> Figure:
    """The paper's Fig. 5: reward of whole episodes over the epochs, with baselines as lines.

    Args:
      per_epoch: for each modality the `[epochs]` rewards of the exploring policy, `reward`, and of
        the greedy one, `greedy`, NaN where there are none; or `[K, epochs]` of several seeds, to
        show their mean and its 95% interval.
      agents: the block `dqn` of the summary.
    """
    figure = Figure(figsize=(5 * len(per_epoch), 4), layout="constrained")
    axes = figure.subplots(1, len(per_epoch), squeeze=False)
    for ax, (name, curves) in zip(axes[0], per_epoch.items(), strict=True):
        exploring, greedy = (np.atleast_2d(curves[kind]) for kind in ("reward", "greedy"))
        smooth = np.array([_smoothed(of_seed) for of_seed in exploring])
        if len(smooth) > 0:
            epochs = np.arange(exploring.shape[1] - smooth.shape[1], exploring.shape[1])
            _curve(ax, epochs, smooth, "0.6", "DQN, exploring")
            measured = np.flatnonzero(np.isfinite(greedy).any(axis=0))
            _curve(ax, measured, greedy[:, measured], "C0", "DQN, greedy")
        for i, key in enumerate(("return", "optimal", "naive", "random")):
            style = ("-.", "--", ":", (0, (1, 4)))[i]
            value = metrics.mean(agents[name][key])
            ax.axhline(value, color=f"C{i + 1}", linestyle=style, label=metrics.label(key))
        ax.set(title=f"{name} DQN", xlabel="epoch", ylabel="total reward of an episode")
        ax.set_ylim(bottom=1.3 * min(metrics.mean(agents[name]["random"]), -0.1))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="lower right")
    return figure


def _curve(ax: Any, epochs: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    """The mean of `[K, E]` values; with several seeds also its 95% interval."""
    ax.plot(epochs, values.mean(axis=0), color=colour, label=label, linewidth=1.2)
    if len(values) > 1:
        ax.fill_between(epochs, *interval(values), color=colour, alpha=0.2, linewidth=0)


def _smoothed(reward: np.ndarray) -> np.ndarray:
    """Running mean over the epochs in which an episode ended."""
    window = min(_SMOOTHING, len(reward))
    number = np.convolve(np.isfinite(reward), np.ones(window), mode="valid")
    total = np.convolve(np.nan_to_num(reward), np.ones(window), mode="valid")
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def scanlines(config: Config, windows: dict[str, np.ndarray]) -> Figure:
    """One look at each class as each detector reads it, from left to right."""
    classes = config.arena.classes
    figure = Figure(figsize=(3.6 * len(classes), 2.6 * len(windows)), layout="constrained")
    axes = figure.subplots(len(windows), len(classes), squeeze=False)
    for row, sensor in zip(axes, sensors.make(config), strict=True):
        name, ray = sensor.name, {"camera": "pixel", "lidar": "beam"}.get(sensor.name, "ray")
        from_left = 1 if sensor.angles[0] > sensor.angles[-1] else -1
        for ax, label, window in zip(row, classes, windows[name][:, 0], strict=True):
            readings = window.reshape(sensor.window, sensor.channels)[::from_left]
            ax.set(title=f"{name}: {label}", xlabel=f"{ray} of the window, left to right")
            if name == "camera":
                ax.imshow(as_srgb(readings)[None], aspect="auto", interpolation="nearest")
                ax.set(yticks=[])
            else:
                ax.plot(readings, ".", color=class_colour(config.arena, label), markersize=3)
            if name == "lidar":
                ax.set(ylabel="distance [m]", ylim=(0, None))
    return figure


def calibration(
    config: Config, detections: dict[str, np.ndarray], belief: dict[str, Any]
) -> Figure:
    """Whether probabilities are right: of the detectors, and of the map after several looks.

    Args:
      config: all settings.
      detections: for each modality `[C, S, D_m]` held-out detections.
      belief: the block `belief` of the summary.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], ":", color="0.5", label="calibrated")
    for i, (name, looks) in enumerate(detections.items()):
        labels = jnp.repeat(jnp.array(config.label_of_class(name)), looks.shape[1])
        flat = jnp.asarray(looks.reshape(-1, looks.shape[-1]))
        confidence, accuracy, share = map(np.asarray, reliability(flat, labels))
        left.plot(confidence, accuracy, color=f"C{i}", linewidth=1)
        # Hollow, for most lie on top of each other where detectors are sure.
        style = {"marker": "oDs^"[i % 4], "facecolors": "none", "edgecolors": f"C{i}"}
        left.scatter(confidence, accuracy, s=10 + 300 * share, label=name, **style)
    lowest = 1 / max(looks.shape[-1] for looks in detections.values())
    left.set(xlabel="confidence", ylabel="share of right labels", title="detectors")
    left.set(xlim=(lowest - 0.02, 1.02), ylim=(min(lowest, 0.5) - 0.1, 1.02))
    looks = [metrics.mean(number) for number in belief["looks"]]
    right.plot(looks, [*map(metrics.mean, belief["nll"])], "o-", label="map")
    right.plot(looks, [*map(metrics.mean, belief["bayes_nll"])], "x--", label="exact Bayes")
    right.set(xlabel="looks", ylabel="NLL of the true class [nats]", title="beliefs", yscale="log")
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend()
    return figure


def missions(block: dict[str, Any]) -> Figure:
    """Share of wrong points in finished maps against looks and time, of every policy.

    Args:
      block: the block `mission` of the summary.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    found = {name: case for name, case in metrics.cases(block).items() if name in POLICIES}
    naive = [case for name, case in found.items() if name.startswith("naive")]
    for ax, key in zip(axes, ("observations_per_poi", "time_s"), strict=True):
        line = [metrics.mean(case[key]) for case in naive], [*map(_wrong, naive)]
        ax.plot(*line, color="0.7", linewidth=1)
        for i, (name, case) in enumerate(found.items()):
            place = metrics.mean(case[key]), _wrong(case)
            ax.plot(*place, "oDs^"[i % 4], color=f"C{i}", label=name.replace("_", " "))
        metric = next(metric for metric in metrics.MISSIONS if metric.key == key)
        ax.set(xlabel=metric.label, xlim=(0, None), yscale="log")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("share of wrong points")
    axes[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes[0].yaxis.set_major_formatter(lambda share, _: _percent(share))
    if min(map(_wrong, found.values())) == _LEAST_SHARE:
        axes[0].set_ylim(bottom=0.8 * _LEAST_SHARE)
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    axes[1].legend(loc="upper left")
    return figure


def teams(config: Config, summary: dict[str, Any]) -> Figure:
    """Median time of missions, of every policy, against numbers of PoIs and of robots.

    Args:
      config: all settings.
      summary: of the run, with the block `elsewhere`.
    """
    own = {
        "num_pois": config.arena.num_pois,
        "side": config.arena.side,
        "robots": list(config.carried),
        "mission": summary["mission"],
    }
    places = [own, *summary["elsewhere"].values()]
    of_arenas = [
        (f"{number} points of interest in {side:g} m", "robots", group)
        for (number, side), group in _groups(places, "num_pois", "side")
        if len({len(place["robots"]) for place in group}) > 1
    ]
    drawn = [place for _, _, group in of_arenas for place in group]
    panels = [
        (f"robots: {_counted(team)}", "num_pois", group)
        for (team,), group in _groups(places, "robots")
        if len(group) > 1 or group[0] not in drawn
    ]
    panels += of_arenas
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for ax, (title, key, group) in zip(axes, panels, strict=False):
        _times(ax, group, key)
        ax.set(title=title)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    handles = {
        label: handle
        for ax in figure.axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside right upper")
    return figure


def _groups(places: list[dict[str, Any]], *keys: str) -> list[tuple[list[Any], list[Any]]]:
    """Places by the values of the keys, in the order in which these came first."""
    found: dict[str, list[dict[str, Any]]] = {}
    for place in places:
        found.setdefault(str([place[key] for key in keys]), []).append(place)
    return [([group[0][key] for key in keys], group) for group in found.values()]


def _counted(team: list[str]) -> str:
    """A team in words: `2 camera, 1 lidar`."""
    return ", ".join(f"{team.count(modality)} {modality}" for modality in dict.fromkeys(team))


def _times(ax: Any, places: list[dict[str, Any]], key: str) -> None:
    """A line for each policy: the time of missions against the number of PoIs or of robots."""

    def number(place: dict[str, Any]) -> int:
        return place[key] if key == "num_pois" else len(place[key])

    numbers = sorted(map(number, places))
    # Places of one number differ in something else, and no line leads from one to the other.
    line = "-" if len(set(numbers)) == len(numbers) else ""
    for i, name in enumerate(POLICIES):
        of_policy = [
            (number(place), metrics.mean(place["mission"][name]["time_s"]))
            for place in sorted(places, key=number)
            if name in place["mission"]
        ]
        if of_policy:
            # The last ones in the same colours have dashes.
            style = "oDs^"[i % 4] + (line if i < _NUM_COLOURS else 2 * line)
            ax.plot(*zip(*of_policy, strict=True), style, color=f"C{i}", label=name)
    label = "points of interest" if key == "num_pois" else "robots"
    ax.set(xlabel=label, ylabel="median time [s]", ylim=(0, None), xticks=sorted(set(numbers)))
    ax.grid(alpha=0.3)


def _wrong(case: dict[str, Any]) -> float:
    """The share of wrong points of a case, above 0 for an axis of logarithms."""
    return max(1 - metrics.mean(case["accuracy"]), _LEAST_SHARE)


def _percent(share: float) -> str:
    """A share of wrong points as text."""
    is_least = share < 1.01 * _LEAST_SHARE
    return f"{'≤ ' if is_least else ''}{100 * share:g}%"

"""Writes the `report.html` of a run directory."""

import base64
import contextlib
import dataclasses
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jinja2

from jaxsense.config import PRESETS, Config, ConfigError, as_plain, parse_json
from jaxsense.run import files
from jaxsense.show import metrics
from jaxsense.show.page import tables
from jaxsense.show.page.inline import Film, read_film

_WRONG = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
PLOTS = {
    "latent_space": (
        "Posteriors of detections as ellipses in the latent space, for all sensors together and "
        "for each alone, by class and by uncertainty",
        "The paper's Fig. 4: entries of the map after a look by all sensors, and by each alone. "
        "Classes that one sensor cannot distinguish share a place between them, with a larger "
        "sigma; so do classes between which an unsure look leaves doubt, if a filter writes the "
        "map.",
    ),
    "reward": (
        "Total reward of an episode over the epochs of training, for each Q-network, with lines "
        "for the optimal, the naive and the random policy",
        "The paper's Fig. 5: the greedy policy of each Q-network, played from random starts after "
        "every tenth epoch. Beside it the episodes with which it trains, in which it explores.",
    ),
    "policies": (
        "Share of wrong points in finished maps against looks and against time, for each policy",
        "What a look is worth: policies that choose looks by what they reveal, and naive "
        "exploration with one, two and three looks at each point, joined by a line. A policy "
        "without any wrong point stands at 0.01%.",
    ),
    "teams": (
        "Median time of missions against numbers of points and of robots, for each policy",
        "Missions of the run's policies in other arenas and with other robots.",
    ),
    "calibration": (
        "Share of right labels against the detectors' confidence, and the likelihood of the true "
        "class in the map against the number of looks, beside exact Bayes",
        "Whether beliefs are right. Left: a detector is calibrated where its points lie on the "
        "diagonal; larger points hold more looks. Right: the map after one to six looks, beside "
        "the exact Bayes filter over classes on the same detections.",
    ),
    "scanlines": (
        "One look at each class, as each detector reads it",
        "The detectors' input: one look at each class.",
    ),
}
"""The plots of a run: alternative text and caption."""


def write(run: Path, config: Config, summary: dict[str, Any]) -> Path:
    """Writes `report.html` of a run.

    Args:
      run: its directory; the page shows plots `NAME.png` and animations `mission*.svg` that a run
        wrote there.
      config: its settings.
      summary: the content of its `summary.json`.

    Returns:
      The page's path.

    Raises:
      ConfigError: if the summary lacks a value or holds a wrong one.
      OSError: if a file cannot be read or written.
    """
    return _write(run, config, summary, "report.html.jinja")


def write_seeds(run: Path, config: Config, summary: dict[str, Any]) -> Path:
    """Writes `report.html` of several seeds, with links to the page of each; see `write`."""
    return _write(run, config, summary, "seeds.html.jinja")


@contextlib.contextmanager
def showing(run: Path) -> Iterator[None]:
    """Raises `ConfigError` about a run whose summary lacks a value or holds a wrong one."""
    try:
        yield
    except (*_WRONG, jinja2.UndefinedError) as error:
        reason = f"must hold the summary.json of a finished run ({error!r})"
        raise ConfigError("run", str(run), reason) from None


def _write(run: Path, config: Config, summary: dict[str, Any], template: str) -> Path:
    with showing(run):
        text = _render(run, config, summary, template)
    path = run / "report.html"
    files.write(path, text)
    return path


def _render(run: Path, config: Config, summary: dict[str, Any], template: str) -> str:
    """The page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxsense.show.page", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    columns, table = tables.unambiguous(summary, list(config.arena.classes))
    return environment.get_template(template).render(
        run=run,
        argument=lambda path: shlex.quote(str(path)),
        trust=bool(config.sensors),
        summary=summary,
        modalities=[*summary["dqn"]],
        mean=metrics.mean,
        num_devices=len(summary["devices"]),
        devices=sorted(set(summary["devices"])),
        commit=_commit(run),
        changed=_changed(config, summary["preset"]),
        config=json.dumps(as_plain(config), indent=2),
        policies=tables.policies(summary),
        latent_space=tables.latent_space(summary),
        table_columns=columns,
        table=table,
        missions=tables.missions(summary),
        stages=tables.timing(summary),
        plots=_plots(run),
        films=_films(run),
    )


@dataclasses.dataclass(frozen=True)
class Plot:
    """A plot, as base64, with the alternative text and its caption."""

    data: str
    alternative: str
    caption: str


def _plots(run: Path) -> list[Plot]:
    """The plots in a run directory."""
    return [
        Plot(base64.b64encode(path.read_bytes()).decode(), *texts)
        for name, texts in PLOTS.items()
        if (path := run / f"{name}.png").exists()
    ]


def _films(run: Path) -> list[Film]:
    """The animations in a run directory, the run's own first."""
    found = map(read_film, sorted(run.glob("mission*.svg"), key=lambda path: path.stem))
    return [film for film in found if film is not None]


def _commit(run: Path) -> str | None:
    """The commit in a run's `config.json`, if any."""
    with contextlib.suppress(OSError, ValueError):
        content = parse_json((run / "config.json").read_text(encoding="utf-8"))
        return content.get("commit") if isinstance(content, dict) else None
    return None


def _changed(config: Config, preset: str) -> dict[str, tuple[str, str]]:
    """Settings that differ from the preset's: their value, and the preset's."""
    if preset not in PRESETS:
        return {}
    before = _flat(as_plain(PRESETS[preset]))
    return {
        name: (json.dumps(value), json.dumps(before.get(name)))
        for name, value in _flat(as_plain(config)).items()
        if value != before.get(name)
    }


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as `section.name`."""
    found = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found.update(_flat(value, f"{prefix}{name}."))
        else:
            found[f"{prefix}{name}"] = value
    return found

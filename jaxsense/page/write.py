"""Reads a run directory, and writes its `report.html`."""

import base64
import dataclasses
import json
from pathlib import Path
from typing import Any

import jinja2

from jaxsense import files
from jaxsense.config import PRESETS
from jaxsense.page import tables
from jaxsense.page.film import Film, read_film

PLOTS = {
    "latent_space": (
        "Posteriors of detections as ellipses in the latent space, for all sensors together and "
        "for each alone, by class and by uncertainty",
        "The paper's Fig. 4. What all sensors see together is one class; what one sensor cannot "
        "tell apart lies between the classes, with a larger sigma.",
    ),
    "reward": (
        "Total reward of an episode over the epochs of training, for each Q-network, with lines "
        "for the optimal, the naive and the random policy",
        "The paper's Fig. 5. While it trains, a Q-network still explores; greedy is what it has "
        "learned.",
    ),
    "scanlines": (
        "What each detector reads of one look at each class",
        "What the detectors read: one look at each class.",
    ),
}
"""The plots of a run: alternative text and caption."""


def write(run: Path, summary: dict[str, Any] | None = None) -> Path:
    """Writes `report.html` from the files that lie in a run directory; again, if they change.

    Args:
      run: directory with `config.json` and `summary.json`; plots `NAME.png` and animations
        `mission*.svg` are shown if they are there.
      summary: what is to be in `summary.json`, if it is not there yet.

    Returns:
      The page's path.

    Raises:
      OSError: if a file cannot be read or written.
    """
    settings = json.loads((run / "config.json").read_text())
    if summary is None:
        summary = json.loads((run / "summary.json").read_text())
    assert summary is not None
    classes = settings["config"]["arena"]["classes"]
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxsense.page", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    columns, table = tables.unambiguous(summary, classes)
    mission_columns, missions = tables.missions(summary)
    text = environment.get_template("report.html.jinja").render(
        run=run,
        summary=summary,
        modalities=list(summary["dqn"]),
        num_devices=len(summary["devices"]),
        devices=sorted(set(summary["devices"])),
        commit=settings.get("commit"),
        changed=_changed(settings),
        config=json.dumps(settings["config"], indent=2),
        policies=tables.policies(summary),
        latent_space=tables.latent_space(summary),
        table_columns=columns,
        table=table,
        mission_columns=mission_columns,
        missions=missions,
        stages=tables.timing(summary),
        plots=_plots(run),
        films=_films(run),
    )
    path = run / "report.html"
    files.write(path, text)
    return path


@dataclasses.dataclass(frozen=True)
class Plot:
    """A plot, as base64, with the alternative text and its caption."""

    data: str
    alternative: str
    caption: str


def _plots(run: Path) -> list[Plot]:
    """Those plots that there are."""
    return [
        Plot(base64.b64encode(path.read_bytes()).decode(), *texts)
        for name, texts in PLOTS.items()
        if (path := run / f"{name}.png").exists()
    ]


def _films(run: Path) -> list[Film]:
    """Animations, that of the run first."""
    return [read_film(path) for path in sorted(run.glob("mission*.svg"), key=lambda p: p.stem)]


def _changed(settings: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Settings that are not the preset's: what they are, and what the preset has."""
    if settings["preset"] not in PRESETS:
        return {}
    preset = _flat(json.loads(json.dumps(dataclasses.asdict(PRESETS[settings["preset"]]))))
    return {
        name: (json.dumps(value), json.dumps(preset.get(name)))
        for name, value in _flat(settings["config"]).items()
        if value != preset.get(name)
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

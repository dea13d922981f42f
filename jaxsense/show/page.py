"""The report of a run: one page that needs no other file."""

import base64
import contextlib
import dataclasses
import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import jinja2

from jaxsense.config import PRESETS, Config, as_plain, parse_json
from jaxsense.show import tables
from jaxsense.show.mission_plots import counted
from jaxsense.show.tables import Table
from jaxsense.summary import Evaluation, Missions, Summary, cases, compare, traffic
from jaxsense.summary.metrics import Number, mean
from jaxsense.summary.read import EVALUATIONS

PLOTS = {
    "policies": (
        "Looks and time of each policy, and its share of wrong PoIs",
        "Policies in the same arenas, the slowest below. Bars are 95 % intervals of the difference "
        "from the latent policy, arena by arena; of several seeds, of the mean.",
    ),
    "teams": (
        "Median time of missions against numbers of PoIs and of robots, for each policy",
        "The policies of this run in other arenas and with other robots.",
    ),
    "reward": (
        "Total reward of an episode over the epochs of training, for each Q-network, with lines "
        "for other policies",
        "The paper's Fig. 5: after every tenth epoch, the greedy policy of each Q-network plays "
        "from random starts, alone on the map. The episodes in which it trains explore.",
    ),
    "latent_space": (
        "Beliefs as ellipses in the latent space, for all sensors together and for each alone, by "
        "class and by uncertainty",
        "The paper's Fig. 4: beliefs after a look by all sensors, and by each alone. Classes that "
        "a sensor cannot tell apart share a position between them, with a larger sigma.",
    ),
    "calibration": (
        "Share of right labels against the detectors' confidence, and the likelihood of the true "
        "class in the map against the number of looks, beside exact Bayes",
        "Left: a detector is calibrated where its circles lie on the diagonal; larger circles hold "
        "more looks. Right: the map after one to six looks, beside exact Bayes on the same looks.",
    ),
    "scanlines": (
        "One look at each class, as each detector reads it",
        "The input of the detectors: one look at each class.",
    ),
}
"""The plots of a run: alternative text and caption."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture as a data URI, with its name, its alternative text and its caption."""

    data: str
    name: str
    alternative: str
    caption: str = ""


@dataclasses.dataclass(frozen=True)
class Section:
    """Missions in one set of arenas."""

    title: str
    verdict: str | None
    tables: list[Table]
    details: Table
    plots: list[Picture]


def render(
    run: Path, config: Config, summary: Summary, evaluations: Mapping[str, Evaluation] | None = None
) -> str:
    """Writes the page of a run, or of several seeds, as text.

    Args:
      run: its directory; the page shows plots `NAME.png` and films `mission*.svg` that lie there.
      config: its settings.
      summary: its summary.
      evaluations: further missions, by the names of their files.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxsense.show", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    missions = [_section(f"{summary['preset']} preset", summary["mission"], run / "policies.png")]
    for name, found in (evaluations or {}).items():
        title = (
            f"Evaluation: {found['num_pois']} PoIs in {found['side']:g} m; robots: "
            f"{counted(found['robots'])}; seed {found['seed']}"
        )
        picture = run / EVALUATIONS / f"{name}.png"
        missions.append(_section(title, found["mission"], picture))
    return environment.get_template("report.html.jinja").render(
        run=run,
        argument=lambda path: shlex.quote(str(path)),
        trust=" --trust" if config.sensors else "",
        summary=summary,
        cards=tables.cards(summary),
        missions=missions,
        bytes=cast(dict[str, Number], traffic(summary["mission"])),
        mean=mean,
        learned=[tables.detectors(summary), tables.agents(summary), tables.latent_space(summary)],
        certain=tables.unambiguous(summary, list(config.arena.classes)),
        paper=tables.paper(summary),
        times=[tables.timing(summary["timing"]), tables.speed(summary)],
        devices={kind: summary["devices"].count(kind) for kind in summary["devices"]},
        commit=_commit(run),
        changed=_changed(config, summary["preset"]),
        config=json.dumps(as_plain(config), indent=2),
        plots=[
            plot for name in PLOTS if name != "policies" for plot in _plots(run / f"{name}.png")
        ],
        films=_films(run),
    )


def _section(title: str, missions: Missions, plot: Path) -> Section:
    number = max(mean(case["episodes"]) for case in cases(missions).values())
    main = tables.missions(missions, f"{number:,.0f} missions of each policy, in the same arenas")
    failures = tables.failures(missions)
    return Section(
        title,
        compare.verdict(cases(missions)),
        [table for table in (main, failures) if table is not None and table.rows],
        tables.all_of_missions(missions),
        _plots(plot, "policies"),
    )


def _plots(path: Path, name: str = "") -> list[Picture]:
    """The plot in a file; none if there is no such file."""
    if not path.exists():
        return []
    return [Picture(_data(path, "png"), path.stem, *PLOTS[name or path.stem])]


def _films(run: Path) -> list[Picture]:
    """The films in a directory, the run's own first.

    A browser runs no script of an image and loads nothing that it names, so that a film may come
    from anywhere.
    """
    paths = sorted(run.glob("mission*.svg"), key=lambda path: path.stem)
    return [Picture(_data(path, "svg+xml"), path.stem, f"Film: {path.stem}") for path in paths]


def _data(path: Path, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


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
        is_section = isinstance(value, dict)
        found |= _flat(value, f"{prefix}{name}.") if is_section else {f"{prefix}{name}": value}
    return found

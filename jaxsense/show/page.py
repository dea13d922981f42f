"""The report of a run: one page that needs no other file."""

import contextlib
import json
import operator
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from jaxsense.config import PRESETS, Config, as_plain
from jaxsense.core import inside
from jaxsense.show import html, tables
from jaxsense.show.mission_plots import counted
from jaxsense.summary import Evaluation, Missions, Summary, cases, compare
from jaxsense.summary.metrics import mean
from jaxsense.summary.read import EVALUATIONS

OWN_FILMS = ("mission", "mission-naive")
"""Films of a run's own missions in one arena, without the suffix of their files."""


def render(
    run: Path,
    config: Config,
    summary: Summary,
    evaluations: Mapping[str, Evaluation] | None = None,
) -> str:
    """Writes the page of a run, or of several seeds, as text.

    Args:
      run: its directory; the page shows plots `NAME.svg` and films `mission*.svg` that lie there.
      config: its settings.
      summary: its summary.
      evaluations: further missions, by the names of their files.

    Raises:
      OSError: if a picture cannot be read, or they are too large.
      ConfigError: if the summary is of other classes.
    """
    here = _missions(f"{summary['preset']} preset", summary["mission"], run / "policies.svg")
    plots = {path.stem: path for path in inside.matching(run, f"{EVALUATIONS}/*.svg")}
    elsewhere = [
        _missions(_title(found, summary), found["mission"], plots.get(name))
        for name, found in (evaluations or {}).items()
    ]
    return html.render(
        "report.html.jinja",
        run=run,
        argument=lambda path: shlex.quote(str(path)),
        trust=" --trust" if config.named_code else "",
        summary=summary,
        order=_order(config),
        remarks=compare.remarks(summary),
        cards=tables.cards(summary),
        missions=[here, *elsewhere],
        learned=[
            tables.detectors(summary),
            tables.agents(summary),
            tables.latent_space(summary),
            tables.unambiguous(summary, config.arena.classes),
        ],
        paper=tables.paper(summary),
        times=tables.times(summary, summary["timing"]),
        counted=_counted,
        changed=_changed(config, summary["preset"]),
        config=json.dumps(as_plain(config), indent=2),
        plot=lambda name: _data(run / f"{name}.svg"),
        films=_films(run),
    )


def _order(config: Config) -> str:
    """Who takes which look under the latent policy, see `mission.choice`."""
    if config.dqn.task == "team" and config.team.tours.steps:
        return "a second network orders these looks"
    if config.mission.auctions:
        return "an auction over travel times divides these looks among the robots"
    return "robots take the most valuable look first"


def _films(run: Path) -> list[html.Films]:
    """The films of a run, those of the same arena together, its own first."""
    found = {
        path.stem: inside.read(path).decode(errors="replace")
        for path in sorted(inside.matching(run, "*.svg"), key=operator.attrgetter("stem"))
        if path.name.startswith("mission")
    }
    own = {name: film for name, film in found.items() if name in OWN_FILMS}
    others = ({name: film} for name, film in found.items() if name not in own)
    return [html.films(group) for group in (own, *others) if group]


def _counted(devices: Sequence[str]) -> str:
    """Devices by kind; that a single one is single is not worth telling."""
    numbers = {kind: devices.count(kind) for kind in devices}
    return ", ".join(f"{n} \u00d7 {kind}" if n > 1 else kind for kind, n in numbers.items())


def _missions(title: str, missions: Missions, plot: Path | None) -> dict[str, object]:
    """Section of the page about missions in the same arenas."""
    played = cases(missions)
    number = max(mean(case["episodes"]) for case in played.values())
    caption = f"{number:,.0f} missions of each policy, in the same arenas"
    found = [tables.missions(missions, caption), tables.failures(missions)]
    return {
        "title": title,
        "verdict": compare.verdict(played),
        "tables": [table for table in found if table.rows],
        "details": tables.all_of_missions(missions),
        "sizes": compare.detection_sizes(missions),
        "plot": plot and _data(plot),
    }


def _title(found: Evaluation, summary: Summary) -> str:
    """What was evaluated, and with what where that is not what finished the run."""
    seeds = {case.get("seed", 0) for case in cases(found["mission"]).values()}
    changed = compare.differences_of([summary, found.get("origin", compare.UNKNOWN)])
    made = "".join(f"; {name} {value}" for name, (_, value) in changed.items())
    return (
        f"Evaluation: {found['num_pois']} PoIs in {found['side']:g} m; robots: "
        f"{counted(found['robots'])}; seed {', '.join(map(str, sorted(seeds)))}{made}"
    )


def _data(path: Path) -> str | None:
    """A picture as a data URI; None if there is no such file."""
    with contextlib.suppress(FileNotFoundError):
        return html.picture(inside.read(path))
    return None


def _changed(config: Config, preset: str) -> dict[str, tuple[str, str]]:
    """Settings that differ from the preset's: their value, and the preset's."""
    before = dict(_flat(as_plain(PRESETS.get(preset, config))))
    return {
        name: (json.dumps(value), json.dumps(before.get(name)))
        for name, value in _flat(as_plain(config))
        if value != before.get(name)
    }


def _flat(settings: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Nested settings as `section.name`."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value

"""The report of a run: one page that needs no other file."""

import base64
import contextlib
import json
import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import jinja2
from markupsafe import Markup

from jaxsense.config import PRESETS, Config, as_plain
from jaxsense.config.options import command, flat
from jaxsense.core import inside
from jaxsense.summary import compare, tables
from jaxsense.summary.blocks import Evaluation, Missions, Summary, mean
from jaxsense.summary.read import EVALUATIONS

OWN_FILMS = ("mission", "mission-naive")
"""Films of a run's own missions in one arena, without the suffix of their files."""
_SVG = "{http://www.w3.org/2000/svg}"
_TAG = re.compile("circle|ellipse|g|line|path|polyline|rect|style|svg|text|title").fullmatch
_ATTRIBUTE = re.compile(
    "class|c?x|c?y|d|(fill|stroke)?-?opacity|fill|height|points|r|role|rx|ry|"
    "stroke(-dasharray|-dashoffset|-width)?|style|transform|viewBox|width|[xy][12]"
).fullmatch
_STYLE = re.compile(r"--film:[\d.]+s \d+|animation:[\w .,()-]*").fullmatch
_KEY_FRAMES = re.compile(r"@keyframes k[0-9a-f]{10}\{(?:[\d.]+%\{[a-z-]+:[\w.,()-]*\})*\}\n?")


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
      evaluations: further missions, by the names of their files.

    Raises:
      OSError: if a picture cannot be read, or they are too large.
      ConfigError: if the summary is of other classes.
    """
    here = _missions(f"{summary['preset']} preset", summary["mission"], run / "policies.svg")
    elsewhere = [
        _missions(_title(found, summary), found["mission"], run / EVALUATIONS / f"{name}.svg")
        for name, found in (evaluations or {}).items()
    ]
    return fill(
        "report.html.jinja",
        run=run,
        argument=lambda path: shlex.quote(str(path)),
        trust=" --trust" if config.named_code else "",
        summary=summary,
        remarks=compare.remarks(summary),
        missions=[here, *elsewhere],
        learned=[
            tables.detectors(summary),
            tables.agents(summary),
            tables.latent_space(summary),
            tables.unambiguous(summary, config.arena.classes),
        ],
        times=tables.times(summary, summary["timing"]),
        counted=tables.counted,
        changed=_changed(config, summary["preset"]),
        config=json.dumps(as_plain(config), indent=2),
        plot=lambda name: _picture(run / f"{name}.svg"),
        films=_films(run),
    )


def fill(template: str, **values: object) -> str:
    """Fills a template of this package; text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("jaxsense.show", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(command=command, **values)


def drawing(film: str) -> Markup:
    """The elements, attributes and key frames of a film; nothing if the text is no SVG.

    What no film draws is left out: a file may come from anywhere.
    """
    try:
        root = ElementTree.fromstring(film)
        text = ElementTree.tostring(_copied(root), encoding="unicode")
    except (ElementTree.ParseError, RecursionError):
        return Markup()
    return Markup(text if root.tag == f"{_SVG}svg" else "")


def _copied(element: Element) -> Element:
    """A copy of what films are made of, without the namespace, which HTML knows."""
    given = {name: x for name, x in element.attrib.items() if _ATTRIBUTE(name) and "url(" not in x}
    kept = {name: x for name, x in given.items() if name != "style" or _STYLE(x)}
    copy = Element(element.tag.removeprefix(_SVG), kept)
    is_sheet = copy.tag == "style"
    copy.text = "".join(_KEY_FRAMES.findall(element.text or "")) if is_sheet else element.text
    copy.extend([_copied(child) for child in element if _TAG(child.tag.removeprefix(_SVG))])
    return copy


def _films(run: Path) -> list[dict[str, Markup]]:
    """The films of a run by name, those of the same arena together, its own first."""
    files = inside.matching(run, "mission*.svg")
    found = {path.stem: drawing(inside.read(path).decode(errors="replace")) for path in files}
    own = {name: found.pop(name) for name in OWN_FILMS if name in found}
    return [group for group in (own, *({name: x} for name, x in found.items())) if group]


def _missions(title: str, missions: Missions, plot: Path) -> dict[str, object]:
    """Section of the page about missions in the same arenas."""
    number = max(mean(case["episodes"]) for case in missions.values())
    caption = f"{number:,.0f} missions of each policy, in the same arenas"
    found = [tables.missions(missions, caption), tables.failures(missions)]
    return {
        "title": title,
        "verdict": compare.verdict(missions),
        "tables": [table for table in found if table.rows],
        "details": tables.all_of_missions(missions),
        "plot": _picture(plot),
    }


def _title(found: Evaluation, summary: Summary) -> str:
    """What was evaluated; version and devices where they differ from the run's."""
    seeds = {case.get("seed", 0) for case in found["mission"].values()}
    changed = compare.differences_of([summary, found.get("origin", compare.UNKNOWN)])
    made = "".join(f"; {name} {value}" for name, (_, value) in changed.items())
    return (
        f"Evaluation: {found['num_pois']} PoIs in {found['side']:g} m; robots: "
        f"{tables.counted(found['robots'])}; seed {', '.join(map(str, sorted(seeds)))}{made}"
    )


def _picture(path: Path) -> str | None:
    """An SVG as the source of an `img`, in which no script runs; None if there is no file."""
    with contextlib.suppress(FileNotFoundError):
        return f"data:image/svg+xml;base64,{base64.b64encode(inside.read(path)).decode()}"
    return None


def _changed(config: Config, preset: str) -> dict[str, tuple[str, str]]:
    """Settings that differ from the preset's: their value, and the preset's."""
    before = flat(as_plain(PRESETS.get(preset, config)))
    return {
        name: (json.dumps(value), json.dumps(before.get(name)))
        for name, value in flat(as_plain(config)).items()
        if value != before.get(name)
    }

"""Writes the tables of README, `docs` and `benchmarks/RESULTS.md`: `python -m benchmarks.results`.

Each table stands between two comments, of which the first names a file of `benchmarks/results` and,
if that file makes several, the table.
"""

import json
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import (
    exported,
    gate,
    imperfect_tables,
    kernels,
    pipeline,
    place,
    recorded,
    same_accuracy,
    travel,
    where,
)
from benchmarks.digits import table as digits
from benchmarks.raw import report as raw
from benchmarks.seeds import rows, tables
from benchmarks.seeds.plan import GROUPS
from benchmarks.tasks import board

_HERE = Path(__file__).parent
RESULTS = _HERE / "results"
PAGES = (
    _HERE.parent / "README.md",
    *sorted((_HERE.parent / "docs").glob("*.md")),
    _HERE / "RESULTS.md",
)
_BLOCK = re.compile(
    r"(<!-- (?P<file>[\w-]+\.json)(?: (?P<table>[\w-]+))? -->\n).*?(<!-- end -->)", re.DOTALL
)


def main() -> None:
    """The program."""
    for page in PAGES:
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


def written(page: str) -> str:
    """The page with tables of the present results."""

    def block(found: re.Match[str]) -> str:
        content = json.loads((RESULTS / found["file"]).read_text(encoding="utf-8"))
        return f"{found[1]}\n{TABLES[found['file']][found['table']](content)}\n\n{found[4]}"

    return _BLOCK.sub(block, page)


def table(rows: list[dict[str, Any]]) -> str:
    """Rows of one machine as Markdown, with where and when they were measured below."""
    lines = [
        "| row | ours | peer | theirs | ratio | at once |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        theirs = row["theirs"] is not None
        cells = [
            f"`{row['row']}`",
            _ours(row),
            row["peer"] or "" if theirs else "",
            number(row["theirs"]) if theirs else "",
            f"{number(row['ratio'])} x" if theirs else "",
            f"{row['batch']:,}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", _about(rows)])


def _ours(row: dict[str, Any]) -> str:
    """Our figure, in all its units."""
    units = {row["unit"]: row["ours"], **row["also"]}
    return ", ".join(f"{number(value)} {unit}" for unit, value in units.items())


def _about(rows: list[dict[str, Any]]) -> str:
    """Machine, commit, day and versions, one of each unless rows differ."""
    device = max({row["device"] for row in rows}, key=len)
    versions = {name: at for row in rows for name, at in row["versions"].items()}
    commits = dict.fromkeys(f"{row['commit'][:10]} on {row['date']}" for row in rows)
    command = f"python -m benchmarks {' '.join(row['row'] for row in rows)}"
    peers = " --peers" if any(row["theirs"] is not None for row in rows) else ""
    return (
        f"`{command}{peers}`: {device} with {rows[0]['cores']} cores; commit {', '.join(commits)}; "
        + ", ".join(f"{name} {at}" for name, at in versions.items())
        + "."
    )


def number(value: float) -> str:
    """Three digits and more, with thousands apart."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


_Tables = Mapping[str | None, Callable[[Any], str]]
_IMPERFECT: _Tables = {
    "breaks": imperfect_tables.breaks,
    "constant": partial(imperfect_tables.of_sizes, sweeps=["both [m]"]),
    "drifts": partial(imperfect_tables.of_sizes, sweeps=["both drifts [m]"]),
}
_PIPELINE = [
    f"pipeline{of}.json" for of in ("", "_newest", "_missions", "_accelerator", "_evaluation")
]
TABLES: Mapping[str, _Tables] = {
    **{name: {None: table} for name in ("cpu.json", "h100.json", "h200.json", "h100x2.json")},
    "digits.json": {None: digits.of_results},
    "seeds.json": {
        "readme": partial(tables.of_presets, rows=rows.OF_README, presets=("paper", "default")),
        "worth": partial(tables.worth, names=tables.EVALUATED),
        "paper": partial(tables.of_presets, rows=rows.OF_FIGURES, presets=("paper", "default")),
        "default": partial(tables.of_missions, preset="default"),
        "raw": partial(tables.of_presets, rows=rows.OF_RAW, presets=("raw", "default")),
        **{
            f"raw_{preset}": partial(
                tables.of_presets,
                rows=rows.OF_RAW_AND_LABELLED,
                presets=(f"raw_{preset}", preset),
                heads=("from scans", "with detectors"),
            )
            for preset in ("noisy", "many")
        },
        "noisy": partial(tables.missions, preset="noisy", num_pois=3, robots=2),
        "maps": partial(tables.of_presets, rows=rows.OF_MAPS, presets=("noisy", "many")),
        "many": partial(tables.missions, preset="many", num_pois=8, robots=4),
        "team": partial(tables.missions, preset="team", num_pois=16, robots=2),
        "sizes": partial(tables.worth, names=tables.SIZES),
        "runs": lambda _: tables.runs(GROUPS.values()),
        "runs_of_raw_noisy": lambda _: tables.runs([GROUPS["raw_noisy"]]),
        "failures": partial(tables.failures, preset="default", num_pois=3, robots=2),
    },
    "tasks.json": {None: board.tables},
    "gate.json": {None: gate.table, "search": gate.of_search},
    "where.json": {None: where.table, "accuracy": where.of_accuracies},
    **{name: {None: pipeline.table} for name in _PIPELINE},
    "kernels.json": {None: kernels.table},
    "place.json": {None: place.table},
    "travel.json": {None: travel.table},
    "curves.json": {None: same_accuracy.table},
    **{name: _IMPERFECT for name in ("imperfect_default.json", "imperfect_noisy.json")},
    "imperfect_trained.json": {None: partial(imperfect_tables.of_sizes, sweeps=["both [m]"])},
    "imperfect_messages.json": {None: imperfect_tables.of_messages},
    "raw_ablation.json": {
        None: partial(raw.written, make=raw.of_ablation),
        "seeds": lambda content: raw.of_seeds(*raw.gather(content)),
    },
    "raw_ratio.json": {None: partial(raw.written, make=raw.of_ratio)},
    "raw_depth.json": {None: partial(raw.written, make=raw.of_depth)},
    "exported.json": {
        None: partial(exported.table, programs=exported.SHOWN),
        "numpy": partial(
            exported.latencies,
            runs=("pretrained:default", "pretrained:noisy"),
            programs=("detect_camera", "detect_lidar", "write_lidar", "decide", "classify"),
        ),
    },
    "recorded.json": {None: recorded.table, "noise": recorded.of_noise},
}
"""What makes each table of a file, by their names."""


if __name__ == "__main__":
    main()

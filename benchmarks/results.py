"""Writes the tables of README, `docs` and `benchmarks/RESULTS.md`: `python -m benchmarks.results`.

Each table stands between two comments, of which the first names a file of `benchmarks/results` and,
if that file makes several, the table.
"""

import collections
import json
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import (
    exported,
    first_steps,
    gate,
    history,
    imperfect_tables,
    kernels,
    lost_beams,
    measure,
    pipeline,
    place,
    same_accuracy,
    studies,
    travel,
    where,
)
from benchmarks.digits import table as digits
from benchmarks.faults import table as faults
from benchmarks.fusions import table as fusions
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
ROWS = ("cpu.json", "h100.json", "h200.json", "h200x2.json")
"""What `python -m benchmarks` has written."""
PIPELINE = tuple(f"pipeline{of}.json" for of in ("", "_newest", "_missions", "_accelerator"))
"""What `python -m benchmarks.pipeline` has."""
CHANGES: Mapping[str, str | None] = {
    **dict.fromkeys(ROWS),
    **dict.fromkeys((*PIPELINE, "first_steps.json"), history.WHOLE),
    "kernels.json": "missions_under_way",
}
"""Files that tell whether their code has changed, and the row whose code they measure, or None if
they hold rows."""
_BLOCK = re.compile(
    r"(<!-- (?P<file>[\w-]+\.json)(?: (?P<table>[\w-]+))? -->\n).*?(<!-- end -->)", re.DOTALL
)


def main() -> None:
    """The program."""
    for name, measures in CHANGES.items():
        history.note(RESULTS / name, measures)
    for page in PAGES:
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


def written(page: str) -> str:
    """The page with tables of the present results."""

    def block(found: re.Match[str]) -> str:
        content = json.loads((RESULTS / found["file"]).read_text(encoding="utf-8"))
        return f"{found[1]}\n{TABLES[found['file']][found['table']](content)}\n\n{found[4]}"

    return _BLOCK.sub(block, page)


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as Markdown, and below how each commit, machine and set of versions measured its own.

    Args:
      rows: as `python -m benchmarks` writes them and `history.note` adds to them.
    """
    heads = ["row", "ours", "peer", "theirs", "ratio", "batch", "commit"]
    cells = []
    for row in rows:
        theirs = row["theirs"] is not None
        cells.append(
            [
                f"`{row['row']}`",
                _ours(row),
                row["peer"] or "" if theirs else "",
                number(row["theirs"]) if theirs else "",
                f"{number(row['ratio'])} x" if theirs else "",
                f"{row['batch']:,}",
                row["commit"][:10] + (", changed since" if row.get("changed") else ""),
            ]
        )
    return "\n\n".join([studies.as_table(heads, cells), *_origins(rows)])


def _ours(row: dict[str, Any]) -> str:
    """Our figure, in all its units."""
    units = {row["unit"]: row["ours"], **row["also"]}
    return ", ".join(f"{number(value)} {unit}" for unit, value in units.items())


def _origins(rows: list[dict[str, Any]]) -> list[str]:
    """A sentence for all rows that were measured together, with the command that measures them."""
    groups = collections.defaultdict[str, list[dict[str, Any]]](list)
    for row in rows:
        # Each row tells of its own code.
        groups[measure.where({**row, "changed": False})].append(row)
    return [f"`{command(group)}`: {origin}" for origin, group in groups.items()]


def command(rows: list[dict[str, Any]]) -> str:
    """Measures rows again.

    Args:
      rows: as `python -m benchmarks` writes them.
    """
    peers = " --peers" if any(row["theirs"] is not None for row in rows) else ""
    return f"python -m benchmarks {' '.join(row['row'] for row in rows)}{peers}"


def number(value: float) -> str:
    """Three digits and more, with thousands apart."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


_Tables = Mapping[str | None, Callable[[Any], str]]
_IMPERFECT: _Tables = {
    "breaks": imperfect_tables.breaks,
    "constant": partial(imperfect_tables.of_sizes, sweeps=["both [m]"]),
    "drifts": partial(imperfect_tables.of_sizes, sweeps=["both drifts [m]"]),
}
TABLES: Mapping[str, _Tables] = {
    **{name: {None: table} for name in ROWS},
    "digits.json": {None: digits.of_results},
    "fusions.json": {None: fusions.of_results},
    "seeds.json": {
        "readme": partial(tables.of_presets, rows=rows.OF_README, presets=("paper", "default")),
        "worth": partial(tables.worth, names=tables.EVALUATED),
        "table_one": partial(tables.table_one, presets=("paper", "default")),
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
    **{name: {None: pipeline.table} for name in PIPELINE},
    "faults.json": {None: faults.table},
    "first_steps.json": {None: first_steps.table},
    "kernels.json": {None: kernels.table},
    "lost_beams.json": {None: lost_beams.table},
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
        "latencies": partial(
            exported.latencies,
            runs=("pretrained:default", "pretrained:noisy"),
            programs=("detect_camera", "detect_lidar", "write_lidar", "decide", "classify"),
        ),
    },
}
"""What makes each table of a file, by their names."""


if __name__ == "__main__":
    main()

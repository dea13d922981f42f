"""Writes the tables of `benchmarks/RESULTS.md`: `python -m benchmarks.results`.

Each table stands between two comments and shows one file of `benchmarks/results`, which
`python -m benchmarks --json` has written.
"""

import json
import re
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent
PAGE = _HERE / "RESULTS.md"
RESULTS = _HERE / "results"
_BLOCK = re.compile(r"(<!-- (?P<name>[\w-]+)\.json -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    """The program."""
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


def written(page: str) -> str:
    """The page with tables of the present results."""

    def block(found: re.Match[str]) -> str:
        rows = json.loads((RESULTS / f"{found['name']}.json").read_text(encoding="utf-8"))
        return f"{found[1]}\n{table(rows)}\n\n{found[3]}"

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


if __name__ == "__main__":
    main()

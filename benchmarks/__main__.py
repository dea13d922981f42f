"""`python -m benchmarks`: one table of how fast each stage is, and how fast its peer."""

import contextlib
import json
from pathlib import Path

import jax
import rich.console
import rich.table

from benchmarks import ROWS
from benchmarks.measure import Options, Row, reserve
from jaxsense.config.options import Positional
from jaxsense.config.section import Checked, require
from jaxsense.run import cli, devices, output

PROGRAM = "benchmarks"
_WIDTH_OF_FILES = 160


class Arguments(Checked):
    """Measures each stage, and with --peers those who do the same, and prints one table.

    Attributes:
      rows: Rows to measure; all by default. A wrong one lists them.
      peers: Also measure other libraries on the same work, in turn.
      json: File to write; must be new.
      quick: Use tiny sizes, to check that everything runs.
    """

    rows: Positional[tuple[str, ...]] = ()
    peers: bool = False
    json: Path | None = None
    quick: bool = False

    def check(self) -> None:
        """Checks the names of rows; raises `ConfigError`."""
        require(set(self.rows) <= set(ROWS), self, "rows", f"must be some of {', '.join(ROWS)}")


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, argv)
    reserve(PROGRAM, arguments.json)
    # A device for each core. Called from another program, the devices may be fixed already.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", devices.cores())
    # Before anything uses JAX, so that all cores may take part.
    devices.start(None)
    console = rich.console.Console()
    if not console.is_terminal:
        console.width = _WIDTH_OF_FILES
    rows: list[Row] = []
    for name in dict.fromkeys(arguments.rows or ROWS):
        with console.status(name):
            rows.append(ROWS[name](Options(arguments.peers, arguments.quick)))
        if arguments.json is not None:
            # After each row, so that what was measured before a failure is kept.
            text = json.dumps([row.as_json() for row in rows], indent=2)
            arguments.json.write_text(f"{text}\n", encoding="utf-8")
    _print_table(console, rows)


def _print_table(console: rich.console.Console, rows: list[Row]) -> None:
    table = rich.table.Table(
        "row", "unit", "ours", "peer", "theirs", "ratio", "compile [s]", "device", "batch"
    )
    for row in rows:
        bound = ">= " if row.is_bound else ""
        table.add_row(
            row.row,
            row.unit,
            _number(row.ours),
            row.peer or "",
            "" if row.theirs is None else bound + _number(row.theirs),
            "" if row.ratio is None else f"{bound}{_number(row.ratio)} x",
            f"{row.compile_s:.1f}",
            row.origin["device"],
            str(row.batch),
        )
        for unit, value in row.also.items():
            table.add_row("", unit, _number(value))
    console.print(table)
    versions: dict[str, str] = {}
    for row in rows:
        versions |= row.origin["versions"]
    console.print(", ".join(f"{name} {version}" for name, version in versions.items()))


def _number(value: float) -> str:
    """Three digits, and thousands apart."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    output.run(main)

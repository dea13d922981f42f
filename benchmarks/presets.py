"""`python -m benchmarks.presets RUN...`: figures of finished runs, a column for each preset.

Cells are ranges over the seeds of a preset.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from jaxsense.config import ConfigError
from jaxsense.config.options import Positional
from jaxsense.config.section import Checked, require
from jaxsense.run import cli
from jaxsense.summary.blocks import Results, Summary
from jaxsense.summary.read import read_summary

PROGRAM = "benchmarks.presets"
TABLE_ONE = {
    "camera": [True, False, False],
    "lidar": [False, False, True],
    "joint": [True, True, True],
}
"""Table I of the paper: which classes each encoder tells apart."""

Value = float | None
Read = Callable[[Results], Iterable[Value]]
"""The numbers of one seed that belong to one range; None where a run has no such figure."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A row of the table; `form` writes one number."""

    label: str
    form: str
    read: Read

    def cell(self, seeds: Iterable[Results]) -> str:
        """The range over seeds; empty if no seed has the figure."""
        values = [value for seed in seeds for value in self.read(seed) if value is not None]
        if not values:
            return ""
        low, high = (self.form.format(found + 0.0) for found in (min(values), max(values)))
        return low if low == high else f"{low} to {high}"


def _table_one(results: Results) -> list[Value]:
    found = results["jmvae"]["unambiguous"]
    pairs = [zip(found.get(name, ()), paper, strict=False) for name, paper in TABLE_ONE.items()]
    return [sum(ours == theirs for cells in pairs for ours, theirs in cells)]


def _sigmas(is_unambiguous: bool) -> Read:
    def read(results: Results) -> list[Value]:
        jmvae = results["jmvae"]
        return [
            sigma
            for name, cells in jmvae["unambiguous"].items()
            for cell, sigma in zip(cells, jmvae["sigma_norm"][name], strict=True)
            if cell == is_unambiguous
        ]

    return read


def _nll_over_bayes(results: Results) -> list[Value]:
    of_map, of_bayes = results["belief"]["nll"], results["belief"]["bayes_nll"]
    return [(sum(of_map) - sum(of_bayes)) / len(of_map)]


def _of_agents(key: str) -> Read:
    return lambda results: [agent[key] for agent in results["dqn"].values()]


LEARNED = (
    Figure(
        "detectors' accuracy",
        "{:.4f}",
        lambda results: [each["accuracy"] for each in results["detectors"].values()],
    ),
    Figure("cells of Table I, of 9", "{:.0f}", _table_one),
    Figure("sigma norm, unambiguous", "{:.2f}", _sigmas(True)),
    Figure("sigma norm, ambiguous", "{:.2f}", _sigmas(False)),
    Figure("fusion accuracy", "{:.4f}", lambda results: [results["jmvae"]["fusion"]["accuracy"]]),
    Figure("mean NLL over exact Bayes [nats]", "{:.4f}", _nll_over_bayes),
    Figure("return, fraction of the optimum", "{:.3f}", _of_agents("fraction_of_optimal")),
    Figure("start states within 0.01 of optimal", "{:.0f}", _of_agents("optimal_states")),
)


def _of_missions(policy: str) -> Iterator[Figure]:
    for label, key, form in (
        ("right", "accuracy", "{:.4f}"),
        ("looks per PoI", "observations_per_poi", "{:.2f}"),
        ("median time [s]", "time_s", "{:.1f}"),
        ("mean time [s]", "mean_time_s", "{:.1f}"),
        ("collisions", "collisions", "{:.0f}"),
    ):

        def read(results: Results, key: str = key) -> list[Value]:
            of_run = results["mission"]
            return [of_run[policy][key]] if policy in of_run else []

        yield Figure(f"`{policy}`: {label}", form, read)


def table(summaries: Iterable[Summary]) -> str:
    """All figures of runs as one Markdown table.

    Args:
      summaries: of one seed or of several each.
    """
    presets: dict[str, list[Results]] = {}
    for found in summaries:
        of_seeds = found["seeds"].values() if "seeds" in found else [found]
        presets.setdefault(found["preset"], []).extend(of_seeds)
    seeds = [seed for group in presets.values() for seed in group]
    policies = dict.fromkeys(name for seed in seeds for name in seed["mission"])
    figures = [*LEARNED, *(figure for policy in policies for figure in _of_missions(policy))]
    heads = [
        f"`{preset}`, {len(group)} seed{'s' * (len(group) > 1)}"
        for preset, group in presets.items()
    ]
    rows = [["", *heads], ["---"] * (1 + len(heads))]
    rows += [[each.label, *map(each.cell, presets.values())] for each in figures]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


class Arguments(Checked):
    """Prints the figures of finished runs, a column for each preset.

    Attributes:
      runs: Their directories, at least one.
    """

    runs: Positional[tuple[Path, ...]] = ()


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, argv)
    try:
        require(bool(arguments.runs), arguments, "runs", "must be at least one directory")
        print(table(map(read_summary, arguments.runs)))
    except (ConfigError, OSError) as error:
        cli.fail(PROGRAM, str(error))


if __name__ == "__main__":
    main()

"""The tables of a run, for the page and the terminal, from the one table of metrics."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

from jaxsense.config import ConfigError
from jaxsense.mission.outcome import is_fault
from jaxsense.summary.blocks import (
    AGENTS,
    BELIEF,
    DETECTORS,
    JMVAE,
    MISSIONS,
    STAGES,
    Case,
    Metric,
    Missions,
    Results,
    Timing,
    mean,
    policies,
)

_YES_OR_NO = {0.0: "no", 1.0: "yes"}


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
      caption: what it shows.
      columns: their names.
      rows: the name of each, and a text for each column.
      meanings: explanations, by names of columns.
    """

    caption: str
    columns: list[str]
    rows: list[tuple[str, list[str]]]
    meanings: dict[str, str] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        """As lines of text, with aligned columns."""
        lines = [["", *self.columns], *([name, *texts] for name, texts in self.rows)]
        first, *widths = (max(map(len, column)) for column in zip(*lines, strict=True))
        rows = [[name.ljust(first), *map(str.rjust, texts, widths)] for name, *texts in lines]
        return "\n".join([self.caption, *map("  ".join, rows), ""])


def of_metrics(
    caption: str, blocks: Mapping[str, Mapping[str, object]], metrics: Iterable[Metric]
) -> Table:
    """Blocks as rows and metrics as columns, without empty ones."""
    shown = [m for m in metrics if any(m.value(block) is not None for block in blocks.values())]
    rows = [
        (name, [metric.text(block) for metric in shown])
        for name, block in blocks.items()
        if any(metric.value(block) is not None for metric in shown)
    ]
    meanings = {metric.label: metric.meaning for metric in shown if metric.meaning}
    return Table(caption, [metric.label for metric in shown], rows, meanings)


def detectors(results: Results) -> Table:
    """The detectors, on scans of scenes that they were not trained on."""
    return of_metrics("Detectors", results["detectors"], DETECTORS.values())


def agents(results: Results) -> Table:
    """The Q-networks compared with other policies on the map."""
    keys = "return", "optimal", "greedy", "naive", "random", "fraction_of_optimal", "optimal_states"
    metrics = [AGENTS[key] for key in (*keys, "num_states")]
    return of_metrics("Policies of a robot alone on the map: mean reward", results["dqn"], metrics)


def latent_space(results: Results) -> Table:
    """The latent space and the beliefs of its map."""
    per_class = "sigma_norm", "unambiguous", "consistent"
    metrics = [metric for key, metric in JMVAE.items() if key not in per_class]
    block = {**results["jmvae"], **results["belief"]}
    return of_metrics("Latent space", {"here": block}, [*metrics, BELIEF["doubt_correlation"]])


def unambiguous(results: Results, classes: tuple[str, ...]) -> Table:
    """Classes that each sensor alone, and all together, identify with certainty (Table I).

    Raises `ConfigError` if the results are of other `classes`.
    """
    block = results["jmvae"]
    columns = sorted(block["unambiguous"], key="joint".__eq__)
    blocks = block["unambiguous"], block["consistent"], block["sigma_norm"]
    if {len(each.get(name, ())) for each in blocks for name in columns} - {len(classes)}:
        raise ConfigError("jmvae", columns, f"must each have a value for {len(classes)} classes")

    def cell(c: int, name: str) -> str:
        holds, consistent, norm = (mean(each[name][c]) for each in blocks)
        here = _YES_OR_NO.get(holds, f"{holds:.0%}")  # of several seeds
        return f"{here} ({consistent:.1%}, {norm:.2f})"

    rows = [(label, [cell(c, name) for name in columns]) for c, label in enumerate(classes)]
    brackets = "Share of looks that leave exactly the classes that this sensor cannot tell apart; "
    brackets += "mean sigma norm."
    return Table("Classes identified with certainty", columns, rows, {"In brackets": brackets})


def missions(block: Missions, caption: str) -> Table:
    """The policies that played in the same arenas."""
    return _missions(policies(block), caption)


def failures(block: Missions) -> Table:
    """The missions of a block `mission` in which a robot fails."""
    failing = {name: case for name, case in block.items() if is_fault(name)}
    return _missions(failing, "The latent policy, with a robot that is alone, stops or goes blind")


_CAPTIONS = {
    "": "Maps, looks and time",
    "calibration": "Calibration of the maps",
    "intervals": "Difference from the latent policy in the same arenas, with 95 % intervals",
}
_UNFINISHED = (
    "Missions that no robot ended by choice: after `mission.time_limit`, or because a PoI was "
    "unreachable or showed nothing, no look would have been new, or robots failed."
)


def _missions(played: Mapping[str, Case], caption: str) -> Table:
    keys = "accuracy", "observations_per_poi", "time_s", "collisions"
    table = of_metrics(caption, played, [MISSIONS[key] for key in keys])
    rows = []
    for (name, texts), case in zip(table.rows, played.values(), strict=True):
        ends = {reason: mean(n) for reason, n in case["ended"].items() if reason != "finished"}
        words = (f"{n:g} {reason}".replace(" ", "\u00a0") for reason, n in ends.items())
        rows.append((name, [*texts, ", ".join(words)]))
    meanings = {**table.meanings, "unfinished": _UNFINISHED}
    return Table(caption, [*table.columns, "unfinished"], rows, meanings)


def all_of_missions(block: Missions) -> list[Table]:
    """Every metric of every case of a block `mission`, except its seed and how missions ended."""
    groups: dict[str, list[Metric]] = {caption: [] for caption in _CAPTIONS.values()}
    for key, metric in MISSIONS.items():
        if key not in ("seed", "ended"):
            groups[_CAPTIONS[key.rpartition(".")[0]]].append(metric)
    found = [of_metrics(caption, block, metrics) for caption, metrics in groups.items()]
    return [table for table in found if table.rows]


def times(results: Results, timing: Timing) -> list[Table]:
    """The time of each stage, in order, and the speed of Q-learning."""
    speed = AGENTS["env_steps"], AGENTS["env_steps_per_s"]
    return [
        of_metrics("Stages, which compile and run side by side", timing["stages"], STAGES.values()),
        of_metrics("Training of the Q-networks", results["dqn"], speed),
    ]


def counted(names: Sequence[str]) -> str:
    """How often each name is there: `2 camera, 1 lidar`."""
    return ", ".join(f"{names.count(name)} {name}" for name in dict.fromkeys(names))

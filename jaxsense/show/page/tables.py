"""What the page says in tables: the metrics of `summary.json`, beside those of the paper."""

import dataclasses
from collections.abc import Callable
from typing import Any

Summary = dict[str, Any]
PAPER_TABLE = {
    ("green cylinder", "camera"): True,
    ("green cylinder", "lidar"): False,
    ("red cylinder", "camera"): False,
    ("red cylinder", "lidar"): False,
    ("red cube", "camera"): False,
    ("red cube", "lidar"): True,
}
"""Table I of Korthals et al. 2018: whether a sensor alone can tell a class for certain."""
_YES_OR_NO = ("no", "yes")
PAPER_CLASSES = {label for label, _ in PAPER_TABLE}
PAPER_MODALITIES = {modality for _, modality in PAPER_TABLE}


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
      name: of the figure.
      values: one for each column.
      paper: what the paper has.
      meaning: what the figure tells.
    """

    name: str
    values: list[str]
    paper: str
    meaning: str


def number(value: Any, digits: int = 3) -> str:
    """A figure as text; a dash for one that there is not."""
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"


def policies(summary: Summary) -> list[Row]:
    """Detectors and Q-networks, one column for each modality."""
    blocks = summary["dqn"]

    def row(name: str, meaning: str, value: Callable[[str], str], paper: str = "") -> Row:
        return Row(name, [value(modality) for modality in blocks], paper, meaning)

    def of_dqn(name: str, key: str, meaning: str, paper: str = "") -> Row:
        return row(name, meaning, lambda m: number(blocks[m][key]), paper)

    def one_step(name: str, key: str, meaning: str, paper: str) -> Row:
        return row(name, meaning, lambda m: number(blocks[m]["one_step"][key]), paper)

    return [
        row(
            "detector: accuracy",
            "Share of scans, from scenes it was not trained on, whose class it tells as well as "
            "the sensor can.",
            lambda m: number(summary["detectors"][m]["accuracy"], 4),
        ),
        of_dqn(
            "reward of an episode: DQN",
            "return",
            "What the greedy policy of the Q-network gains in information, summed over an episode; "
            "a look in vain costs 1.",
            "Fig. 5",
        ),
        of_dqn(
            "reward of an episode: optimal",
            "optimal",
            "The policy that knows what every look can tell on average.",
            "0.550*",
        ),
        of_dqn("reward of an episode: naive", "naive", "Every point once, whatever is known."),
        of_dqn("reward of an episode: random", "random", "Any look, or the end, by chance."),
        of_dqn("fraction of optimal", "fraction_of_optimal", "The first of these over the second."),
        row(
            "optimal in states",
            "States of the map, all that there are, in which the policy gains within 0.01 of the "
            "optimum.",
            lambda m: f"{blocks[m]['optimal_states']} of {blocks[m]['num_states']}",
            "384 states",
        ),
        one_step(
            "reward of one step: DQN",
            "policy",
            "Of the first step alone, as the authors' code measures it.",
            "0.340, 0.385*",
        ),
        one_step(
            "reward of one step: optimal", "optimal", "The optimal policy's first step.", "0.426*"
        ),
        one_step("reward of one step: random", "random", "A random first step.", "-0.302*"),
        row(
            "steps of training",
            "Steps of all environments together.",
            lambda m: number(blocks[m]["env_steps"]),
            "2,000 epochs",
        ),
        row(
            "steps per second",
            "Of the environments, with learning.",
            # Several seeds in one program have no rate of their own.
            lambda m: number(blocks[m].get("env_steps_per_s"), 0),
        ),
    ]


def latent_space(summary: Summary) -> list[Row]:
    """The JMVAE, with a single column."""
    metrics = summary["jmvae"]
    pairs = [
        (norm, is_clear)
        for name, norms in metrics["sigma_norm"].items()
        for norm, is_clear in zip(norms, metrics["unambiguous"][name], strict=True)
    ]
    fusion = metrics["fusion"]
    return [
        Row(
            "dimensions in use",
            [number(metrics["active_units"])],
            "1",
            "Of the latent space; the paper's Fig. 4 uses one of two.",
        ),
        Row(
            "sigma norm, unambiguous",
            [_range([norm for norm, is_clear in pairs if is_clear])],
            "from 1.05",
            "Uncertainty of beliefs in a single class: the smaller, the more is known (Fig. 4).",
        ),
        Row(
            "sigma norm, ambiguous",
            [_range([norm for norm, is_clear in pairs if not is_clear])],
            "to 1.25",
            "Uncertainty of beliefs between classes that a sensor cannot tell apart.",
        ),
        Row(
            "fusion: right class",
            [number(fusion["accuracy"], 4)],
            "",
            "Share of entries, written by one sensor and then by another, that are nearest to the "
            "true class.",
        ),
        Row(
            "fusion: error",
            [number(fusion["mean_error"])],
            "",
            "How far such an entry is from what both sensors together give, in standard "
            "deviations.",
        ),
        Row(
            "error of moments",
            [number(metrics["moment_matching_error"])],
            "0 in theory",
            "How far a sensor's belief is from the best single Gaussian over the classes that it "
            "leaves open.",
        ),
    ]


def _range(values: list[float]) -> str:
    """The least and the greatest."""
    if not values:
        return "-"
    least, greatest = (f"{f(values):.2f}" for f in (min, max))
    return least if least == greatest else f"{least} to {greatest}"


def unambiguous(summary: Summary, classes: list[str]) -> tuple[list[str], list[Row]]:
    """What each sensor alone, and all together, can tell for certain.

    Args:
      summary: of the run.
      classes: of the arena.

    Returns:
      The columns, and a row for each class: what holds here, and in the paper's Table I if that has
      the same classes and sensors.
    """
    metrics = summary["jmvae"]["unambiguous"]
    alone = [name for name in metrics if name != "joint"]
    is_paper = set(classes) == PAPER_CLASSES and set(alone) == PAPER_MODALITIES

    def cell(label: str, name: str, holds: bool) -> str:
        here = _YES_OR_NO[holds]
        if not is_paper:
            return here
        there = _YES_OR_NO[name == "joint" or PAPER_TABLE[label, name]]
        return f"{here}\u00a0/\u00a0{there}"

    columns = [*alone, "joint"]
    rows = [
        Row(label, [cell(label, name, metrics[name][c]) for name in columns], "", "")
        for c, label in enumerate(classes)
    ]
    return [*alone, "together"], rows


def missions(summary: Summary) -> tuple[list[str], list[Row]]:
    """Missions: the policies and failures that were played, as columns, and their metrics."""
    blocks = {n: b for n, b in summary["mission"].items() if n != "bytes_per_detection"}

    def row(name: str, key: str, digits: int, meaning: str) -> Row:
        return Row(name, [number(block.get(key), digits) for block in blocks.values()], "", meaning)

    rows = [
        row(
            "accuracy",
            "accuracy",
            3,
            "Share of points whose most likely class in the finished map is the true one.",
        ),
        row(
            "looks per point", "observations_per_poi", 2, "The fewer, the better they were chosen."
        ),
        row("time [s]", "time_s", 1, "Until all robots have ended; the median."),
        row("collisions", "collisions", 0, "Control periods in which a robot touched something."),
        row(
            "goals reached",
            "goals_reached_fraction",
            3,
            "Share of the viewpoints that robots set out for.",
        ),
        row("information", "information", 2, "In the finished map: the sum of 1 / sigma norm."),
        row("missions", "episodes", 0, ""),
    ]
    reasons = {reason for block in blocks.values() for reason in block["ended"]} - {"finished"}
    for reason in sorted(reasons):
        numbers = [number(block["ended"].get(reason, 0)) for block in blocks.values()]
        rows.append(Row(reason, numbers, "", "Missions that did not finish, for this reason."))
    return [name.replace("_", " ") for name in blocks], rows


@dataclasses.dataclass(frozen=True)
class Stage:
    """The time of a stage in seconds, and as shares of the longest's in percent."""

    name: str
    compile_s: float
    run_s: float
    compile_share: float
    run_share: float


def timing(summary: Summary) -> list[Stage]:
    """The stages, in their order."""
    stages = summary["timing"]["stages"]
    longest = max((s["compile_s"] + s["run_s"] for s in stages.values()), default=1.0) or 1.0
    return [
        Stage(
            name.replace("_", " "),
            block["compile_s"],
            block["run_s"],
            100 * block["compile_s"] / longest,
            100 * block["run_s"] / longest,
        )
        for name, block in stages.items()
    ]

"""The tables of the page: metrics of `summary.json` beside the paper's."""

import dataclasses
from collections.abc import Iterable
from typing import Any

from jaxsense.mission.compare import arenas
from jaxsense.show import metrics
from jaxsense.show.metrics import Metric, cases, mean, text

Summary = dict[str, Any]
PAPER_TABLE = {
    ("green cylinder", "camera"): True,
    ("green cylinder", "lidar"): False,
    ("red cylinder", "camera"): False,
    ("red cylinder", "lidar"): False,
    ("red cube", "camera"): False,
    ("red cube", "lidar"): True,
}
"""Table I of Korthals et al. 2018: whether a sensor alone identifies a class."""
_YES_OR_NO = {0.0: "no", 1.0: "yes"}
PAPER_CLASSES = {label for label, _ in PAPER_TABLE}
PAPER_MODALITIES = {modality for _, modality in PAPER_TABLE}


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table.

    Attributes:
      name: of the metric.
      values: one for each column.
      paper: the paper's value.
      meaning: what the metric measures.
    """

    name: str
    values: list[str]
    paper: str
    meaning: str


def _row(metric: Metric, blocks: Iterable[dict[str, Any]]) -> Row:
    """A metric of several blocks, one in each column."""
    values = [metric.text(block) for block in blocks]
    return Row(metric.label, values, metric.paper, metric.meaning)


def policies(summary: Summary) -> list[Row]:
    """Detectors and Q-networks, one column for each modality."""
    agents = summary["dqn"]
    detectors = [summary["detectors"][modality] for modality in agents]
    rows = [_row(metric, detectors) for metric in metrics.DETECTORS]
    return rows + [_row(metric, agents.values()) for metric in metrics.AGENTS]


def latent_space(summary: Summary) -> list[Row]:
    """The JMVAE and the beliefs of its map, with a single column."""
    block = summary["jmvae"]
    pairs = [
        (mean(norm), mean(is_clear) > 0.5)
        for name, norms in block["sigma_norm"].items()
        for norm, is_clear in zip(norms, block["unambiguous"][name], strict=True)
    ]
    units, *others = (_row(metric, [block]) for metric in metrics.LATENT_SPACE)
    norms = [
        Row(
            metric.label,
            [_range([norm for norm, is_clear in pairs if is_clear == (i == 0)])],
            metric.paper,
            metric.meaning,
        )
        for i, metric in enumerate(metrics.SIGMA_NORM)
    ]
    beliefs = [_row(metric, [summary["belief"]]) for metric in metrics.BELIEFS]
    return [units, *norms, *others, *beliefs]


def _range(values: list[float]) -> str:
    """The least and the greatest value, as text."""
    if not values:
        return "-"
    least, greatest = (f"{f(values):.2f}" for f in (min, max))
    return least if least == greatest else f"{least} to {greatest}"


def unambiguous(summary: Summary, classes: list[str]) -> tuple[list[str], list[Row]]:
    """Classes that each sensor alone, and all together, identify with certainty.

    Args:
      summary: of the run.
      classes: of the arena.

    Returns:
      The columns, and a row for each class: the result here, and in the paper's Table I if that
      has the same classes and sensors; in brackets, the share of looks that leave open just those
      classes that the sensors cannot distinguish.
    """
    shares, consistent = summary["jmvae"]["unambiguous"], summary["jmvae"]["consistent"]
    alone = [name for name in shares if name != "joint"]
    is_paper = set(classes) == PAPER_CLASSES and set(alone) == PAPER_MODALITIES

    def cell(c: int, label: str, name: str) -> str:
        holds = mean(shares[name][c])
        here = _YES_OR_NO.get(holds, f"{holds:.0%}")  # of several seeds
        just = f"\u00a0({mean(consistent[name][c]):.1%})"
        if not is_paper:
            return f"{here}{just}"
        there = _YES_OR_NO[name == "joint" or PAPER_TABLE[label, name]]
        return f"{here}\u00a0/\u00a0{there}{just}"

    columns = [*alone, "joint"]
    rows = [
        Row(label, [cell(c, label, name) for name in columns], "", "")
        for c, label in enumerate(classes)
    ]
    return [*alone, "together"], rows


def missions(summary: Summary) -> list[tuple[str, list[str], list[Row]]]:
    """Missions of the run, and then elsewhere: captions, policies as columns, metrics as rows."""
    tables = [_missions(summary["mission"], "All robots together")]
    for place in summary.get("elsewhere", {}).values():
        arena = f"{place['num_pois']} points in {place['side']:g} m"
        tables.append(_missions(place["mission"], f"{arena}; robots: {', '.join(place['robots'])}"))
    return tables


def _missions(mission: dict[str, Any], name: str) -> tuple[str, list[str], list[Row]]:
    """The table of one place."""
    blocks = cases(mission)
    played = [arenas(block) for block in blocks.values()]
    caption = f"{name}, in the same arenas for each policy"
    if any(each != played[0] for each in played):
        caption = f"{name}; policies of equal seed and missions had the same arenas"
    # Some metrics exist only where a robot is alone, or beside other policies.
    every = blocks.values()
    measured = [m for m in metrics.MISSIONS if any(m.block in block for block in every)]
    rows = [_row(metric, blocks.values()) for metric in measured]
    reasons = {reason for block in blocks.values() for reason in block["ended"]} - {"finished"}
    for reason in sorted(reasons):
        numbers = [text(block["ended"].get(reason, 0), 1) for block in blocks.values()]
        rows.append(Row(reason, numbers, "", "Missions that ended early for this reason."))
    return caption, [name.replace("_", " ") for name in blocks], rows


@dataclasses.dataclass(frozen=True)
class Stage:
    """The time of a stage in seconds, and in percent of the longest stage's."""

    name: str
    compile_s: float
    run_s: float
    compile_share: float
    run_share: float


def timing(summary: Summary) -> list[Stage]:
    """The time of each stage, in order."""
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

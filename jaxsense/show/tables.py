"""The tables of a run, for the page and the terminal, from the one table of metrics."""

import dataclasses
from collections.abc import Iterable, Mapping

from jaxsense.config import POLICIES
from jaxsense.summary.blocks import (
    AGENTS,
    BELIEF,
    DETECTORS,
    JMVAE,
    MISSIONS,
    STAGES,
    Agent,
    Case,
    Missions,
    Results,
    Timing,
    cases,
)
from jaxsense.summary.metrics import Metric, mean, text

PAPER_TABLE = {
    ("green cylinder", "camera"): True,
    ("green cylinder", "lidar"): False,
    ("red cylinder", "camera"): False,
    ("red cylinder", "lidar"): False,
    ("red cube", "camera"): False,
    ("red cube", "lidar"): True,
}
"""Table I of Korthals et al. 2018: whether a sensor alone identifies a class."""
_PAPER_PERMUTATIONS = 384  # states of the paper's task
_YES_OR_NO = {0.0: "no", 1.0: "yes"}


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
      caption: what it shows.
      columns: their names.
      rows: the name of each, and a text for each column.
      meanings: explanations of columns or rows, by their names.
      best: rows and columns of values to highlight.
    """

    caption: str
    columns: list[str]
    rows: list[tuple[str, list[str]]]
    meanings: dict[str, str] = dataclasses.field(default_factory=dict)
    best: frozenset[tuple[int, int]] = frozenset()


def _table(
    caption: str, blocks: Mapping[str, Mapping[str, object]], metrics: Iterable[Metric]
) -> Table:
    """A row for each block and a column for each metric that one of them has."""
    shown = [m for m in metrics if any(m.value(block) is not None for block in blocks.values())]
    rows = [
        (name.replace("_", " "), [metric.text(block) for metric in shown])
        for name, block in blocks.items()
    ]
    meanings = {metric.label: metric.meaning for metric in shown if metric.meaning}
    return Table(caption, [metric.label for metric in shown], rows, meanings)


def detectors(results: Results) -> Table:
    """The detectors, on scans of scenes that they were not trained on."""
    return _table("Detectors", results["detectors"], DETECTORS.values())


def agents(results: Results) -> Table:
    """The Q-networks beside other policies on the map."""
    keys = "return", "optimal", "naive", "random", "fraction_of_optimal", "optimal_states"
    metrics = [AGENTS[key] for key in (*keys, "num_states")]
    return _table("Policies of a robot alone on the map: mean reward", results["dqn"], metrics)


def speed(results: Results) -> Table:
    """The training of the Q-networks."""
    metrics = AGENTS["env_steps"], AGENTS["env_steps_per_s"]
    return _table("Training of the Q-networks", results["dqn"], metrics)


def latent_space(results: Results) -> Table:
    """The latent space and the beliefs of its map."""
    block = results["jmvae"]
    metrics = [metric for key, metric in JMVAE.items() if "." in key]
    metrics += [JMVAE["moment_matching_error"], BELIEF["doubt_correlation"]]
    table = _table("Latent space", {"here": {**block, **results["belief"]}}, metrics)
    pairs = [
        (mean(norm), mean(is_clear) > 0.5)
        for name, norms in block["sigma_norm"].items()
        for norm, is_clear in zip(norms, block["unambiguous"][name], strict=True)
    ]
    first = [JMVAE["active_units"].text(block)]
    first += [_range(norm for norm, is_clear in pairs if is_clear == wanted) for wanted in (1, 0)]
    columns = ["dimensions in use", "sigma norm: one class", "several classes", *table.columns]
    (name, values), meaning = table.rows[0], JMVAE["sigma_norm"].meaning
    meanings = {"sigma norm": meaning, **table.meanings}
    return dataclasses.replace(
        table, columns=columns, rows=[(name, [*first, *values])], meanings=meanings
    )


def _range(values: Iterable[float]) -> str:
    """The lowest and the highest value, as text."""
    found = sorted({f"{value:.2f}" for value in values}, key=float)
    return " to ".join(found[:: max(1, len(found) - 1)]) or "-"


def unambiguous(results: Results, classes: list[str]) -> Table:
    """Classes that each sensor alone, and all together, identify with certainty.

    Args:
      results: of the run.
      classes: of the arena.

    Returns:
      A row for each class: the result here, and the paper's if it has the same classes and sensors.
    """
    shares, consistent = results["jmvae"]["unambiguous"], results["jmvae"]["consistent"]
    columns = [*(name for name in shares if name != "joint"), "joint"]
    is_paper = {(c, m) for c in classes for m in columns[:-1]} == set(PAPER_TABLE)

    def cell(c: int, name: str) -> str:
        holds = mean(shares[name][c])
        here = _YES_OR_NO.get(holds, f"{holds:.0%}")  # of several seeds
        if is_paper:
            here += f" / {_YES_OR_NO[name == 'joint' or PAPER_TABLE[classes[c], name]]}"
        return f"{here} ({mean(consistent[name][c]):.1%})".replace(" ", "\u00a0")

    caption = "Is a class certain?" + is_paper * " Here / in the paper's Table I"
    rows = [(label, [cell(c, name) for name in columns]) for c, label in enumerate(classes)]
    in_brackets = (
        "Share of looks that leave exactly the classes that this sensor cannot tell apart."
    )
    return Table(caption, [*columns[:-1], "together"], rows, {"In brackets": in_brackets})


def paper(results: Results) -> Table | None:
    """Figures beside the paper's; None if its task is another."""
    agents = results["dqn"]
    if any(mean(agent["num_permutations"]) != _PAPER_PERMUTATIONS for agent in agents.values()):
        return None
    rows = [
        (metric.label, [*(metric.text(agent) for agent in agents.values()), metric.paper])
        for metric in AGENTS.values()
        if metric.paper or metric.key == "optimal_permutations"
    ]
    blank = [""] * (len(agents) - 1)
    rows += [
        (metric.label, [metric.text(results["jmvae"]), *blank, metric.paper])
        for metric in (JMVAE["active_units"], JMVAE["moment_matching_error"])
    ]
    return Table("Comparison with the paper", [*agents, "paper"], rows)


def missions(block: Missions, caption: str) -> Table:
    """The policies that played in the same arenas, the best values marked.

    Args:
      block: `mission` of a summary or of an evaluation.
      caption: of the table.
    """
    played = {name: case for name, case in cases(block).items() if name in POLICIES}
    return _missions(played, caption, cases(block).get("naive"))


def failures(block: Missions) -> Table | None:
    """The missions in which a robot fails; None if none were played. See `missions`."""
    failing = {name: case for name, case in cases(block).items() if name not in POLICIES}
    caption = "The latent policy, with a robot that is alone, stops or goes blind"
    return _missions(failing, caption, None) if failing else None


def _missions(played: Mapping[str, Case], caption: str, naive: Case | None) -> Table:
    metrics = [MISSIONS[key] for key in ("accuracy", "observations_per_poi", "time_s")]
    table = _table(caption, played, metrics)
    best = set()
    for i, (metric, find) in enumerate(zip(metrics, (max, min, min), strict=True)):
        values = [row[i] for _, row in table.rows]
        numbers = [mean(case[metric.key]) for case in played.values()]
        wanted = values[numbers.index(find(numbers))] if numbers else None
        best |= {(r, i) for r, value in enumerate(values) if value == wanted and len(values) > 1}
    columns, rows = [*table.columns], []
    if naive is not None:
        columns.append("against naive")
    for (name, values), case in zip(table.rows, played.values(), strict=True):
        ends = {reason: mean(n) for reason, n in case["ended"].items() if reason != "finished"}
        versus = [] if naive is None else [_percent(case["time_s"], naive["time_s"])]
        unfinished = ", ".join(f"{n:g} {reason}" for reason, n in ends.items()) or "0"
        rows.append((name, [*values, *versus, MISSIONS["collisions"].text(case), unfinished]))
    meanings = {
        **table.meanings,
        **({} if naive is None else {"against naive": "Difference in median time."}),
        "collisions": MISSIONS["collisions"].meaning,
    }
    return Table(caption, [*columns, "collisions", "unfinished"], rows, meanings, frozenset(best))


def all_of_missions(block: Missions) -> Table:
    """Every metric of every case."""
    metrics = [metric for key, metric in MISSIONS.items() if key != "ended"]
    return _table("All metrics of these missions", cases(block), metrics)


def _percent(value: float, reference: float) -> str:
    """A difference in percent of a reference, as text."""
    if not mean(reference):
        return "-"
    percent = round(100 * (mean(value) / mean(reference) - 1))
    return f"{percent:+d}\u00a0%" if percent else "="


def cards(results: Results) -> list[tuple[str, str, str]]:
    """The main results: number, what it is, and what to compare it with."""
    played = cases(results["mission"])
    found = []
    if latent := played.get("latent"):
        for key in ("observations_per_poi", "time_s", "accuracy"):
            digits = MISSIONS[key].digits
            number, others = text(mean(latent[key]), digits), []
            for name in ("naive", "auction", "random"):
                # Random looks are short only because they end early.
                if name in played and (name == "random") == (key == "accuracy"):
                    value = mean(played[name][key])
                    others.append(
                        f"{name} {_share(value) if key == 'accuracy' else text(value, digits)}"
                    )
                    if name == "naive":
                        others[-1] += f", {_percent(latent[key], played[name][key])}"
            number = _share(mean(latent[key])) if key == "accuracy" else number
            what = {"accuracy": "of PoIs right", "time_s": "s per mission"}.get(
                key, "looks per PoI"
            )
            found.append((number, what, "; ".join(others)))
    for modality, agent in results["dqn"].items():
        found.append((_optimal(agent), "map states played optimally", modality))
    return found


def _share(share: float) -> str:
    return f"{100 * share:.4g}\u00a0%"


def _optimal(agent: Agent) -> str:
    optimal, states = mean(agent["optimal_states"]), mean(agent["num_states"])
    return f"{optimal:,.0f} of {states:,.0f}"


def timing(timing: Timing) -> Table:
    """The time of each stage, in order."""
    return _table("Stages compile and run side by side", timing["stages"], STAGES.values())

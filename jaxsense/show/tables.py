"""The tables of a run, for the page and the terminal, from the one table of metrics."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import cast

from jaxsense.config import ConfigError
from jaxsense.mission import is_fault
from jaxsense.summary import Case, Metric, Missions, Results, Timing, cases
from jaxsense.summary.blocks import (
    AGENTS,
    BELIEF,
    DETECTORS,
    JMVAE,
    MISSIONS,
    STAGES,
    Agent,
    policies,
)
from jaxsense.summary.compare import AS_ACCURATE
from jaxsense.summary.metrics import Number, mean, text

# Table I of Korthals et al. 2018: the classes that a sensor alone identifies.
_PAPER_CLASSES = {"green cylinder", "red cylinder", "red cube"}
_PAPER_CERTAIN = {("green cylinder", "camera"), ("red cube", "lidar")}
_PAPER_PERMUTATIONS = 384  # states of the paper's task
_PAPER = {
    "return": "Fig. 5",
    "optimal": "0.550*",
    "one_step.policy": "0.340, 0.385*",
    "one_step.optimal": "0.426*",
    "one_step.random": "-0.302*",
    "optimal_permutations": "",
    "num_permutations": "384",
    "env_steps": "2,000 epochs",
}
_RULES = ("nearest", "auction", "rollout")  # written by hand, and learned by none
_NO_BOUND = (
    "The optimal policy maximises the expected rewards of looks, but rewards are read from the "
    "map: on a poor map, or over few starts, another policy can score higher. If it led by more "
    "than 1 % and two standard errors, the table would name no optimal policy."
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
      best: rows and columns of values to highlight.
      note: a text below it; empty if there is nothing to add.
    """

    caption: str
    columns: list[str]
    rows: list[tuple[str, list[str]]]
    meanings: dict[str, str] = dataclasses.field(default_factory=dict)
    best: frozenset[tuple[int, int]] = frozenset()
    note: str = ""


def _table(
    caption: str, blocks: Mapping[str, Mapping[str, object]], metrics: Iterable[Metric]
) -> Table:
    """A row for each block that has one of the metrics, a column for each that one of them has."""
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
    return _table("Detectors", results["detectors"], DETECTORS.values())


def agents(results: Results) -> Table:
    """The Q-networks compared with other policies on the map."""
    keys = "return", "optimal", "greedy", "naive", "random", "fraction_of_optimal", "optimal_states"
    metrics = [AGENTS[key] for key in (*keys, "num_states")]
    caption = "Policies of a robot alone on the map: mean reward"
    table = _table(caption, results["dqn"], metrics)
    above = [
        text for name, agent in results["dqn"].items() if (text := _above_optimal(name, agent))
    ]
    return dataclasses.replace(table, note=" ".join([*above, _NO_BOUND]) if above else "")


def _above_optimal(name: str, agent: Agent) -> str:
    """Names the policies whose mean reward is shown above the optimal one; empty without any."""
    if agent["optimal"] is None:
        return ""

    def shown(key: str) -> float:
        return round(mean(cast(Number, AGENTS[key].value(agent))), AGENTS[key].digits)

    rivals = "return", "greedy", "naive", "random"
    above = [AGENTS[key].label for key in rivals if shown(key) > shown("optimal")]
    verb = "get" if len(above) > 1 else "gets"
    return f"For {name}, {' and '.join(above)} {verb} more than optimal." if above else ""


def latent_space(results: Results) -> Table:
    """The latent space and the beliefs of its map."""
    per_class = "sigma_norm", "unambiguous", "consistent"
    metrics = [metric for key, metric in JMVAE.items() if key not in per_class]
    block = {**results["jmvae"], **results["belief"]}
    return _table("Latent space", {"here": block}, [*metrics, BELIEF["doubt_correlation"]])


def unambiguous(results: Results, classes: tuple[str, ...]) -> Table:
    """Classes that each sensor alone, and all together, identify with certainty.

    Args:
      results: of the run.
      classes: of the arena.

    Returns:
      A row for each class: the result here, and the paper's if it has the same classes and sensors.

    Raises:
      ConfigError: if the results are of other classes.
    """
    block = results["jmvae"]
    columns = sorted(block["unambiguous"], key="joint".__eq__)
    blocks = block["unambiguous"], block["sigma_norm"], block["consistent"]
    if {len(each.get(name, ())) for each in blocks for name in columns} - {len(classes)}:
        raise ConfigError("jmvae", columns, f"must each have a value for {len(classes)} classes")
    is_paper = set(classes) == _PAPER_CLASSES and set(columns) == {"camera", "lidar", "joint"}

    def cell(c: int, name: str) -> str:
        holds = mean(block["unambiguous"][name][c])
        here = _YES_OR_NO.get(holds, f"{holds:.0%}")  # of several seeds
        if is_paper:
            here += f" / {_YES_OR_NO[name == 'joint' or (classes[c], name) in _PAPER_CERTAIN]}"
        norm, consistent = (mean(block[key][name][c]) for key in ("sigma_norm", "consistent"))
        return " ".join(
            part.replace(" ", "\u00a0") for part in (here, f"({consistent:.1%}, {norm:.2f})")
        )

    caption = "Classes identified with certainty" + is_paper * " Here / in the paper's Table I"
    rows = [(label, [cell(c, name) for name in columns]) for c, label in enumerate(classes)]
    brackets = "Share of looks that leave exactly the classes that this sensor cannot tell apart; "
    brackets += "mean sigma norm, in the paper's Fig. 4 from 1.05 to 1.25."
    return Table(caption, columns, rows, {"In brackets": brackets})


def paper(results: Results) -> Table | None:
    """The Q-networks compared with the paper's; None if its task is another."""
    agents = results["dqn"]
    if any(mean(agent["num_permutations"]) != _PAPER_PERMUTATIONS for agent in agents.values()):
        return None
    rows = [
        (AGENTS[key].label, [*(AGENTS[key].text(agent) for agent in agents.values()), there or "-"])
        for key, there in _PAPER.items()
    ]
    return Table("Comparison with the paper", [*agents, "paper"], rows)


def missions(block: Missions, caption: str) -> Table:
    """The policies that played in the same arenas, with the best values marked.

    Args:
      block: `mission` of a summary or of an evaluation.
      caption: of the table.
    """
    return _missions(policies(block), caption)


def failures(block: Missions) -> Table:
    """The missions of a block `mission` in which a robot fails."""
    failing = {name: case for name, case in cases(block).items() if is_fault(name)}
    return _missions(failing, "The latent policy, with a robot that is alone, stops or goes blind")


_AGAINST = {"against naive": "Difference of the median time from that of naive exploration."}
_UNFINISHED = {
    "unfinished": (
        "Number of missions that did not end because every robot chose to. `time limit`: "
        "after `mission.time_limit`; `unreachable`: a robot gave up a PoI that it could not get "
        "to; `undetected`: it gave one up after looks that showed nothing; `exhausted`: it left "
        "one that was still worth a look, because no look would have been new; `robot failed`: the "
        "others finished; `no robot left`: all failed."
    ),
    "in bold": "The best value among policies that are as accurate as the best one.",
}


def _missions(played: Mapping[str, Case], caption: str) -> Table:
    keys = "accuracy", "observations_per_poi", "time_s", "collisions"
    table = _table(caption, played, [MISSIONS[key] for key in keys])
    values = [[mean(case[key]) for key in keys[:3]] for case in played.values()]
    most = max((accuracy for accuracy, *_ in values), default=0.0)
    able = [row for row in values if row[0] >= most - AS_ACCURATE]
    # A value alone is not the best of any.
    best = {(r, c) for r, row in enumerate(values) for c in range(1, 3) if row in able
            and len(able) > 1 and row[c] == min(each[c] for each in able)}  # fmt: skip
    best |= {(r, 0) for r, row in enumerate(values) if len(values) > 1 and row[0] == most}
    rows = []
    for (name, texts), case in zip(table.rows, played.values(), strict=True):
        ends = {reason: mean(n) for reason, n in case["ended"].items() if reason != "finished"}
        unfinished = ", ".join(
            f"{n:g} {reason}".replace(" ", "\u00a0") for reason, n in ends.items()
        )
        against = [_percent(case["time_s"], played["naive"]["time_s"])] if "naive" in played else []
        rows.append((name, [*texts[:3], *against, *texts[3:], unfinished]))
    against = ["against naive"] if "naive" in played else []
    columns = [*table.columns[:3], *against, *table.columns[3:], "unfinished"]
    meanings = {**table.meanings, **(_AGAINST if against else {}), **_UNFINISHED}
    return Table(caption, columns, rows, meanings, frozenset(best))


ALL_OF_MISSIONS = {
    "Maps at the end": ("accuracy", "calibration.accuracy", "calibration.confidence",
                        "calibration.nll", "information"),
    "Looks and time": ("observations_per_poi", "time_s", "mean_time_s", "goals_reached_fraction",
                       "collisions", "episodes"),
    "Difference from the latent policy in the same arenas, with 95 % intervals": (
        "intervals.accuracy", "intervals.observations_per_poi", "intervals.time_s"),
    "Ratio to naive exploration of the same accuracy": (
        "of_naive.observations_per_poi", "of_naive.time_s", "of_naive.mean_time_s"),
    "A robot alone": ("told", "ambiguous_reported"),
}  # fmt: skip
"""The metrics of all tables of `all_of_missions`, by their captions."""


def all_of_missions(block: Missions) -> list[Table]:
    """Every metric of every case of a block `mission`, except its seed and how missions ended."""
    found = [
        _table(caption, cases(block), [MISSIONS[key] for key in keys])
        for caption, keys in ALL_OF_MISSIONS.items()
    ]
    return [table for table in found if table.rows]


def _percent(value: Number, reference: Number) -> str:
    """A difference in percent of a reference, as text."""
    if not mean(reference):
        return "-"
    percent = round(100 * (mean(value) / mean(reference) - 1))
    return f"{percent:+d}\u00a0%" if percent else "="


def cards(results: Results) -> list[tuple[str, str, str]]:
    """The main results: a number, its meaning, and figures to compare it with."""
    found, played = [], cases(results["mission"])
    if own := played.get("latent"):
        rules = _fastest_rule(played)
        for key, what, others in (
            ("observations_per_poi", "looks per PoI", ("naive",)),
            ("time_s", "median seconds per mission", ("naive", *rules)),
            ("accuracy", "of PoIs right", ("naive", "random")),
        ):
            beside = []
            for name in (each for each in others if each in played):
                beside.append(f"{name} {_short(key, played[name][key])}")
                if name == "naive" and key != "accuracy":
                    beside.append(_percent(own[key], played[name][key]))
            found.append((_short(key, own[key]), what, ", ".join(beside)))
    for modality, agent in results["dqn"].items():
        states = f"{mean(agent['num_states']):,.0f} states of the map"
        if agent["optimal_states"] is None:  # without an optimum to compare with
            continue
        number = f"{mean(agent['optimal_states']):,.0f}"
        found.append((number, f"of {states} played optimally", modality))
    return found


def _fastest_rule(played: Mapping[str, Case]) -> list[str]:
    """The fastest of the rules that are as accurate as the latent policy, if one was played."""
    least = mean(played["latent"]["accuracy"]) - AS_ACCURATE
    able = {
        name: mean(played[name]["time_s"])
        for name in _RULES
        if name in played and mean(played[name]["accuracy"]) >= least
    }
    return sorted(able, key=lambda name: able[name])[:1]


def _short(key: str, value: Number) -> str:
    """A metric of missions on a card, without its interval; shares in percent."""
    if key == "accuracy":
        return f"{100 * mean(value):.1f}\u00a0%"
    return text(mean(value), MISSIONS[key].digits)


def times(results: Results, timing: Timing) -> list[Table]:
    """The time of each stage, in order, and the speed of Q-learning.

    Args:
      results: of the run.
      timing: of the run.
    """
    speed = AGENTS["env_steps"], AGENTS["env_steps_per_s"]
    return [
        _table("Stages, which compile and run side by side", timing["stages"], STAGES.values()),
        _table("Training of the Q-networks", results["dqn"], speed),
    ]

"""Tables in Markdown of what `benchmarks.seeds.runs` has gathered."""

import re
import textwrap
from collections import ChainMap
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

from benchmarks.seeds.plan import Group
from benchmarks.seeds.rows import Row
from benchmarks.seeds.runs import TABLE_ONE, Figures
from benchmarks.studies import as_table, in_words
from jaxsense import PRESETS

_OF_SUMMARY = (
    ("accuracy of the finished map", "accuracy", "{:.4f}"),
    ("looks per PoI", "observations_per_poi", "{:.2f}"),
    ("time, median", "time_s", "{:.1f} s"),
    ("time, mean", "mean_time_s", "{:.1f} s"),
    ("collisions", "collisions", "{}"),
)


def runs(groups: Iterable[Group]) -> str:
    """The commands that train and evaluate groups of runs, as a block of a page.

    Args:
      groups: from `plan`.
    """
    lines = []
    for group in groups:
        lines.append(f"# {group.name}: {_seeds([*group.seeds])}")
        if group.shares is None:
            lines += _wrapped(group.train("S"))
        for words in group.evaluations:
            lines += _wrapped(group.evaluate("RUN", words))
    return "\n".join(f"    {line}" for line in lines)


def _wrapped(command: str) -> list[str]:
    """Lines of a command, with a backslash at the end of all but the last."""
    lines = textwrap.wrap(command, 108, subsequent_indent="    ", break_on_hyphens=False)
    return [*(f"{line} \\" for line in lines[:-1]), lines[-1]]


def of_presets(
    found: Mapping[str, Any],
    rows: Iterable[Row],
    presets: tuple[str, ...],
    heads: tuple[str, ...] = (),
) -> str:
    """A table of presets next to the paper, each cell from the minimum to the maximum of its seeds.

    Args:
      found: from `gather`.
      rows: of the table.
      presets: or other groups of runs, its columns.
      heads: of the columns, if they are not named after presets.
    """
    names = [*heads] or [f"`{preset}` preset" for preset in presets]
    seeds = [_of_seeds(found[preset]) for preset in presets]
    shown = names
    if len(set(seeds)) > 1:
        shown = [f"{name}, {of}" for name, of in zip(names, seeds, strict=True)]
    rows = list(rows)
    paper = ["paper"] if any(row.paper for row in rows) else []
    lines = [_line("", *paper, *shown), _line(*["---"] * (1 + len(paper) + len(presets)))]
    for row in rows:
        cells = [row.paper for _ in paper] + [
            _cell(row, [each["figures"] for each in found[preset].values()])
            + (" (fitted)" if row.fitted and preset == "paper" else "")
            for preset in presets
        ]
        lines.append(_line(row.label, *cells))
    command = "python -m jaxsense.train --preset PRESET --seed S"
    columns = {name: found[preset] for name, preset in zip(names, presets, strict=True)}
    return "\n".join([*lines, "", _about(columns, command)])


def table_one(found: Mapping[str, Any], presets: tuple[str, ...]) -> str:
    """Table I of the paper, and how many of its cells the trainings of presets reproduce.

    Args:
      found: from `gather`.
      presets: their names.
    """
    heads = "class", "camera", "LiDAR", "camera & LiDAR"
    cells = zip(*(TABLE_ONE[name] for name in ("camera", "lidar", "joint")), strict=True)
    rows = [
        [f"{label} ({number})", *(str(is_clear).lower() for is_clear in of_class)]
        for number, (label, of_class) in enumerate(
            zip(PRESETS["paper"].arena.classes, cells, strict=True), 1
        )
    ]
    number = sum(map(len, TABLE_ONE.values()))
    lines = [f"Cells of {number} that each training reproduces:", ""]
    for preset in presets:
        same = [run["figures"]["table_one"] for run in found[preset].values()]
        lines.append(f"- `{preset}`, {_of_seeds(found[preset])}: {_range('{}', same)}")
    command = "python -m jaxsense.train --preset PRESET --seed S"
    about = _about({f"`{preset}` preset": found[preset] for preset in presets}, command)
    return "\n".join([as_table([*heads], rows), "", *lines, "", about])


def _cell(row: Row, runs: list[Figures]) -> str:
    """From the minimum to the maximum over runs, for each agent if there are several."""
    values = [row.value(figures) for figures in runs]
    if values[0] is None:
        return ""
    if row.pooled:
        return _range(row.form, [x for each in values for x in each])
    if not isinstance(values[0], list):
        return _range(row.form, values)
    joint = "; " if "," in row.form else ", "
    return joint.join(_range(row.form, list(of_agent)) for of_agent in zip(*values, strict=True))


def _written(form: str, value: float) -> str:
    """The number in words, without the sign of a zero."""
    text = form.format(value)
    return text if re.search("[1-9]", text) else text.removeprefix("-")


def _range(form: str, values: list[float]) -> str:
    low, high = _written(form, min(values)), _written(form, max(values))
    unit = " s" if form.endswith(" s") else ""
    return low if low == high else f"{low.removesuffix(unit)} to {high}"


def of_missions(found: Mapping[str, Any], preset: str) -> str:
    """Missions that trainings end with, policies side by side.

    Args:
      found: from `gather`.
      preset: its name.
    """
    runs = [run["figures"]["mission"] for run in found[preset].values()]
    policies = [*runs[0]]
    lines = [_line("", *policies), _line(*["---"] * (1 + len(policies)))]
    for label, key, form in _OF_SUMMARY:
        cells = [_range(form, [run[policy][key] for run in runs]) for policy in policies]
        lines.append(_line(label, *cells))
    number = max(run["latent"]["episodes"] for run in runs)
    command = f"python -m jaxsense.train --preset {preset} --seed S --mission.episodes {number}"
    return "\n".join([*lines, "", _about({preset: found[preset]}, command)])


_POLICIES = {
    "latent": "looks that pay by the Q-network, ordered by an auction (`team`: a learned order)",
    "network": "highest value of the Q-network (`team`: as `latent`)",
    "greedy": "highest expected gain on the map",
    "bayes": "highest expected gain by exact Bayes",
    "optimal": "dynamic programming",
    "auction": "rule: an auction of PoIs",
    "nearest": "rule: the nearest PoI worth a look",
    "rollout": "rule: the highest gain per second",
    "naive": "one look with each sensor",
    "naive_2": "two looks with each sensor",
    "naive_3": "three looks with each sensor",
    "random": "any PoI",
}
_OF_MISSIONS = (
    ("right", "accuracy", "{:.3f}"),
    ("looks per PoI", "observations_per_poi", "{:.2f}"),
    ("time, median", "time_s", "{:.1f} s"),
    ("time, mean", "mean_time_s", "{:.1f} s"),
    ("confidence minus accuracy", "overconfidence", "{:.3f}"),
    ("NLL of the maps", "nll", "{:.3f}"),
)


Played: TypeAlias = tuple[str, int, int]
"""A preset or another group of runs, and numbers of PoIs and robots of their evaluations."""
EVALUATED: Mapping[Played, str] = {
    ("default", 3, 2): "`default`",
    ("noisy", 3, 2): "`noisy`",
    ("many", 8, 4): "`many`",
    ("team", 16, 2): "`team`, 16 PoIs",
}
"""Columns of README's table."""
SIZES: Mapping[Played, str] = {
    ("team_sizes", 3, 2): "3 PoIs",
    ("team_sizes", 8, 2): "8 PoIs",
    ("team_sizes", 16, 4): "16 PoIs, four robots",
    ("team_sizes", 16, 6): "16 PoIs, six robots",
}
"""Columns of the table of teams that differ in size."""


def worth(found: Mapping[str, Any], names: Mapping[Played, str]) -> str:
    """What every policy reaches: time, as a multiple of `latent`'s; looks; and wrong PoIs.

    Args:
      found: from `gather`.
      names: of the columns.
    """
    played = {of: _evaluated(found, *of) for of in names}
    heads = [f"{names[of]}, {_of_seeds(runs)}" for of, runs in played.items()]
    lines = [_line("policy", *heads), _line(*["---"] * (1 + len(heads)))]
    for policy, what in _POLICIES.items():
        cells = []
        for of_seeds in played.values():
            runs = [run for run in of_seeds.values() if policy in run]
            ratios = [run[policy]["mean_time_s"] / run["latent"]["mean_time_s"] for run in runs]
            looks = [run[policy]["observations_per_poi"] for run in runs]
            wrong = [100 * (1 - run[policy]["accuracy"]) for run in runs]
            shown = ("{:.2f}", ratios), ("{:.1f}", looks), ("{:.1f}", wrong)
            cells.append(
                "; ".join(_range(*each) for each in shown) + " %" if runs else "not played"
            )
        if any(cell != "not played" for cell in cells):
            lines.append(_line(f"`{policy}`, {what}", *cells))
    command = "python -m jaxsense.evaluate RUN"
    columns = {names[of]: _origins(found, *of) for of in played}
    return "\n".join([*lines, "", _about(columns, command)])


def missions(found: Mapping[str, Any], preset: str, num_pois: int, robots: int) -> str:
    """What every policy of a preset's evaluations reaches, over seeds.

    Args:
      found: from `gather`.
      preset: its name.
      num_pois: of the evaluations.
      robots: their number.
    """
    heads = [*(head for head, _, _ in _OF_MISSIONS), "seconds longer than `latent`, by seed"]
    lines = [_line("policy", *heads), _line(*["---"] * (1 + len(heads)))]
    runs = _evaluated(found, preset, num_pois, robots)
    for policy in _POLICIES:
        if shown := [run[policy] for run in runs.values() if policy in run]:
            cells = [_range(form, [x[key] for x in shown]) for _, key, form in _OF_MISSIONS]
            cells.append("; ".join(_interval(x["longer"]) for x in shown if x["longer"]))
            lines.append(_line(f"`{policy}`", *cells))
    command = f"python -m jaxsense.evaluate RUN` of `python -m jaxsense.train --preset {preset}"
    used = _origins(found, preset, num_pois, robots)
    return "\n".join([*lines, "", _about({preset: used}, command)])


_OF_CASES = (("right", "accuracy", "{:.3f}"), *_OF_SUMMARY[1:])


def failures(found: Mapping[str, Any], preset: str, num_pois: int, robots: int) -> str:
    """Missions in which robots fail, next to those in which none does.

    Args:
      found: from `gather`.
      preset: its name.
      num_pois: of the evaluations.
      robots: their number.
    """
    lines = [_line("robots", *(head for head, _, _ in _OF_CASES))]
    lines.append(_line(*["---"] * (1 + len(_OF_CASES))))
    runs = _evaluated(found, preset, num_pois, robots)
    cases = dict.fromkeys(case for run in runs.values() for case in run if case not in _POLICIES)
    for case, label in {"latent": "all work", **{x: in_words(x) for x in cases}}.items():
        shown = [run[case] for run in runs.values() if case in run]
        lines.append(
            _line(label, *(_range(form, [x[key] for x in shown]) for _, key, form in _OF_CASES))
        )
    command = f"python -m jaxsense.evaluate RUN` of `python -m jaxsense.train --preset {preset}"
    used = _origins(found, preset, num_pois, robots)
    return "\n".join([*lines, "", _about({preset: used}, command)])


def _interval(of: Mapping[str, float]) -> str:
    mean, low, high = (_written("{:.1f}", of[name]) for name in ("mean", "low", "high"))
    return f"{mean} ({low} to {high})"


def _evaluated(
    found: Mapping[str, Any], group: str, num_pois: int, robots: int
) -> dict[str, dict[str, Any]]:
    """Policies and their missions by the seeds that were evaluated with so many PoIs and robots."""
    return {
        seed: dict(ChainMap(*(each["mission"] for each in evaluations)))
        for seed, evaluations in _of_size(found[group], num_pois, robots).items()
    }


def _origins(
    found: Mapping[str, Any], group: str, num_pois: int, robots: int
) -> dict[str, Mapping[str, Any]]:
    """How `_evaluated` was made; of those that do not say, how the runs were trained.

    Raises `ValueError` if evaluations of one run were made by several commits.
    """
    made = {}
    for seed, evaluations in _of_size(found[group], num_pois, robots).items():
        origins = [each.get("origin", found[group][seed]) for each in evaluations]
        if len(commits := {each["commit"] for each in origins}) > 1:
            reason = f"evaluated by {' and '.join(sorted(commits))}: must be one commit"
            raise ValueError(f"run {seed} of {group}: {reason}")
        made[seed] = origins[-1]
    return made


def _of_size(
    runs: Mapping[str, Any], num_pois: int, robots: int
) -> dict[str, list[Mapping[str, Any]]]:
    """The evaluations with so many PoIs and robots, by the seeds of the runs that have some."""
    found = {
        seed: [
            each
            for each in run["evaluations"].values()
            if (each["num_pois"], len(each["robots"])) == (num_pois, robots)
        ]
        for seed, run in runs.items()
    }
    return {seed: each for seed, each in found.items() if each}


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _about(columns: Mapping[str, Mapping[str, Any]], command: str) -> str:
    """The command, and how the runs of each column were made, once if all were made alike.

    Args:
      columns: runs by their seeds, by the names of the columns.
      command: of all.
    """
    made = {name: _made([*runs.values()]) for name, runs in columns.items()}
    if len(set(made.values())) > 1:
        each = (f"- {name}, {_of_seeds(columns[name])}: {made[name]}." for name in columns)
        return "\n".join([f"`{command}`:", "", *each])
    seeds = _of_seeds(ChainMap(*map(dict, columns.values())))
    return f"`{command}`, {seeds}: {next(iter(made.values()))}."


def _made(runs: list[Mapping[str, Any]]) -> str:
    """Devices, commits and versions of runs."""

    def each(name: str) -> str:
        """The values of the runs that hold one; those of earlier versions lack cores and date."""
        return " and ".join(dict.fromkeys(str(run[name]) for run in runs if name in run))

    kinds = dict.fromkeys(kind for run in runs for kind in run["devices"])
    cores, dates = each("cores"), each("date")
    commits = dict.fromkeys(run["commit"][:10] for run in runs)
    at = ", ".join(
        f"{name} {' and '.join(dict.fromkeys(run['versions'][name] for run in runs))}"
        for name in ("python", "jax", "mujoco")
    )
    return (
        f"{', '.join(kinds)}{f' with {cores} cores' if cores else ''}; commit "
        f"{', '.join(commits)}{f' on {dates}' if dates else ''}; {at}"
    )


def _of_seeds(runs: Iterable[str]) -> str:
    return _seeds(sorted(map(int, runs)))


def _seeds(numbers: list[int]) -> str:
    """Seeds in words, those in a row from the first to the last."""
    rows: list[list[int]] = []
    for number in numbers:
        if rows and rows[-1][-1] == number - 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    parts = [f"{row[0]} to {row[-1]}" if len(row) > 1 else f"{row[0]}" for row in rows]
    return f"seed{'s' if len(numbers) > 1 else ''} {', '.join(parts)}"

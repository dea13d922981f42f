"""The scoreboard: rows as JSON, and the tables of `docs/tasks.md` made of them."""

import dataclasses
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxsense
from jaxsense.tasks import Score, Task, estimate

_PICTURE = "![Learning curves of all learners in all tasks](figures/tasks_curves.svg)"
_LAST = "naive", "random"


@dataclasses.dataclass(frozen=True)
class Row:
    """A policy in a task; an object of the JSON file.

    Attributes:
      task: its name.
      agent: who acts.
      policy: name of a learner, or of a policy to compare with.
      returns: `[seeds]` mean return of an episode with each seed of a score.
      best: name of the policy to measure against: the optimum, or else the best rule.
      best_returns: `[seeds]` its returns from the same starts.
      steps: environment steps of a training; None without one, as all that follow.
      seconds: CPU time of a training without compilation and evaluation, the mean over seeds.
      wall_seconds: of all trainings, with compilation and evaluation.
      settings: of the learner.
      about: when, where and how it was made.
    """

    task: str
    agent: str
    policy: str
    returns: tuple[float, ...]
    best: str
    best_returns: tuple[float, ...]
    steps: int | None = None
    seconds: float | None = None
    wall_seconds: float | None = None
    settings: dict[str, object] = dataclasses.field(default_factory=dict)
    about: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def place(self) -> tuple[str, str, str]:
        """Task, agent and policy: there is one row of each."""
        return self.task, self.agent, self.policy

    @property
    def fractions(self) -> np.ndarray:
        """`[seeds]` returns over those of `best`."""
        return np.array(self.returns) / np.array(self.best_returns)


def row(score: Score, policy: str, **training: Any) -> Row:
    """The row of a score; `training` is what `Row` holds besides."""
    best = tuple(score.references[score.best].tolist())
    returns = tuple(score.returns.tolist())
    return Row(score.task, score.agent, policy, returns, score.best, best, **training)


def references(task: Task) -> list[Row]:
    """Rows of the policies that a task stores the returns of."""
    known = dict(zip(task.references, np.asarray(task.returns), strict=True))
    scores = {
        name: Score(task.name, task.agent, returns, known, task.has_optimum)
        for name, returns in known.items()
    }
    return [row(score, name) for name, score in scores.items()]


def write(file: Path, rows: Iterable[Row]) -> None:
    """Writes rows as JSON."""
    content = [dataclasses.asdict(each) for each in rows]
    file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read(file: Path) -> list[Row]:
    """The rows that `write` wrote; none if there is no such file."""
    return _rows(json.loads(file.read_text(encoding="utf-8"))) if file.exists() else []


def tables(content: Sequence[dict[str, Any]]) -> str:
    """A table for each task and agent, the learners' settings, and what made them, as Markdown.

    Args:
      content: of the JSON file.
    """
    rows = _rows(content)
    found = [_PICTURE, ""] if rows else []
    for name in jaxsense.registered():
        for agent in jaxsense.tasks.agents(name):
            of_task = references(jaxsense.make(name, agent))
            learned = [each for each in rows if (each.task, each.agent) == (name, agent)]
            first = [each for each in of_task if each.policy not in _LAST]
            last = [each for each in of_task if each.policy in _LAST]
            found += [f"### `{name}`, `{agent}`", "", _table([*first, *learned, *last]), ""]
    return "\n".join([*found, *_settings(rows), "", *_about(rows)]).rstrip()


def _table(rows: Sequence[Row]) -> str:
    """The policies of a task."""
    best = rows[0].best
    share = "fraction of optimal" if best == "optimal" else f"fraction of `{best}`"
    titles = ["policy", "return", share, "environment steps", "CPU seconds"]
    lines = [titles, ["---"] * len(titles)]
    for each in rows:
        is_learner = each.steps is not None
        lines.append(
            [
                each.policy if is_learner else f"`{each.policy}`",
                str(estimate(np.array(each.returns))),
                str(estimate(each.fractions)),
                f"{each.steps:,}" if is_learner else "",
                f"{each.seconds:.3g}" if each.seconds is not None else "",
            ]
        )
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _settings(rows: Sequence[Row]) -> list[str]:
    """A line for each learner, or several if its settings are not the same in all tasks."""
    found: dict[tuple[str, str], list[str]] = {}
    for each in rows:
        settings = ", ".join(f"{name} {value}" for name, value in each.settings.items())
        found.setdefault((each.policy, settings), []).append(f"`{each.task}`")
    names, lines = [policy for policy, _ in found], []
    for (policy, settings), tasks in found.items():
        where = f" in {', '.join(tasks)}" if names.count(policy) > 1 else ""
        lines.append(f"- {policy}{where}: {settings}")
    return lines


def _about(rows: Sequence[Row]) -> list[str]:
    """What made the rows, a line for each command, commit and day."""
    found: dict[str, list[str]] = {}
    for each in rows:
        about = each.about
        versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
        text = f"{about['device']}, commit {about['commit'][:10]} on {about['date']}; {versions}"
        found.setdefault(text, []).append(each.policy)
    lines = [f"{', '.join(dict.fromkeys(names))}: {text}." for text, names in found.items()]
    minutes = round(sum(each.wall_seconds or 0.0 for each in rows) / 60)
    took = f"Training, compiling and evaluating took {minutes} minute"
    return [*lines, f"{took}{'s' if minutes != 1 else ''} of a core."] if rows else []


def _rows(content: Sequence[dict[str, Any]]) -> list[Row]:
    """JSON knows no tuples."""
    returns = "returns", "best_returns"
    return [Row(**{**each, **{name: tuple(each[name]) for name in returns}}) for each in content]

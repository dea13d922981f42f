"""`jaxsense tasks`: the frozen tasks, and what known policies reach in them."""

import numpy as np

from jaxsense import tasks
from jaxsense.config.section import Checked
from jaxsense.run import cli, devices, output
from jaxsense.run.output import tell
from jaxsense.summary.tables import Table
from jaxsense.tasks import Task
from jaxsense.tasks.registry import TASKS, agents
from jaxsense.tasks.score import estimate
from jaxsense.tasks.task import EPISODES, SEEDS

PROGRAM = "jaxsense tasks"
SCOREBOARD = "docs/tasks.md"
"""The page with the scores of policies."""


class Arguments(Checked):
    """Lists the frozen tasks of `jaxsense.make`, and the returns of policies to compare with."""


def main(argv: list[str] | None = None) -> None:
    """Runs the program.

    Args:
      argv: the command line without the program; by default the process's own.
    """
    cli.parse(PROGRAM, Arguments, argv)
    with cli.ending(PROGRAM):
        devices.start(1)
    found = [tasks.make(name, agent) for name in tasks.registered() for agent in agents(name)]
    tell(str(_table(found)))
    for name, about in TASKS.items():
        tell(f"{name}: {about}.")
    tell(
        f"Returns are interquartile means over {SEEDS} seeds of {EPISODES:,} episodes, "
        f"stored with the tasks. {SCOREBOARD} in the source tree lists other policies.\n"
        'Next, in Python: jaxsense.score("noisy-v0", policy)'
    )


def _table(found: list[Task]) -> Table:
    """A row for each task and agent."""
    others = "naive", "random"

    def row(task: Task) -> tuple[str, list[str]]:
        known = {
            name: f"{estimate(returns).value:.3f}"
            for name, returns in zip(task.references, np.asarray(task.returns), strict=True)
        }
        best = next(iter(known))
        sizes = str(task.observation_size), str(task.num_actions)
        returns = f"{known[best]} {best}", *(known[name] for name in others)
        return task.name, [task.agent, *sizes, *returns]

    columns = ["agent", "observation", "actions", "reference", *others]
    return Table("Tasks of jaxsense.make(name, agent)", columns, [row(task) for task in found])


if __name__ == "__main__":
    output.run(main)

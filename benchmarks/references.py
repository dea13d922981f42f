"""`python -m benchmarks.references`: what known policies reach in the frozen tasks, as a table."""

import numpy as np

import jaxsense
from jaxsense.tasks import Score, estimate

_COLUMNS = "task", "agent", "optimal or best rule", "greedy", "naive", "random"


def rows() -> list[tuple[str, ...]]:
    """Cells of the table: the stored returns with 95 % intervals over the ten seeds of a score."""
    found = []
    for name in jaxsense.registered():
        for agent in ("team",) if name.startswith("team") else ("camera", "lidar"):
            task = jaxsense.make(name, agent)
            stored = np.asarray(task.returns)
            returns = dict(zip(task.references, stored, strict=True))
            best = Score(name, agent, stored[0], returns, task.has_optimum).best
            shown = "" if task.has_optimum else f", `{best}`"
            cells = [
                str(estimate(returns[each])) if each in returns else ""
                for each in (best, *_COLUMNS[3:])
            ]
            found.append((f"`{name}`", f"`{agent}`", cells[0] + shown, *cells[1:]))
    return found


def main() -> None:
    """Runs the program."""
    rules = tuple("---" for _ in _COLUMNS)
    for cells in (_COLUMNS, rules, *rows()):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()

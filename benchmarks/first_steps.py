"""What a newcomer waits for: `python -m benchmarks.first_steps --help`.

Each step runs in a new process, in an empty directory and with an empty home, where caches are;
then it runs again with that home.
"""

import dataclasses
import re
import statistics
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks import measure, pipeline, studies
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli

PROGRAM = "benchmarks.first_steps"
_EMPTY = "pass"
_IMPORTS = tuple(f"import {name}" for name in ("jaxsense", "jaxsense.vae", "jaxsense.dqn"))


def first_program(page: str) -> tuple[str, ...]:
    """The words behind `python` that run the first program of a page.

    Args:
      page: its path in the source tree.
    """
    text = (pipeline.ROOT / page).read_text(encoding="utf-8")
    return "-c", re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]


STEPS: Mapping[str, tuple[str, Callable[[], tuple[str, ...]]]] = {
    "program": ("the first program of the README", lambda: first_program("README.md")),
    "tasks": ("... of The tasks", lambda: first_program("docs/tasks.md")),
    "jmvae": (
        "... of The JMVAE on your own data: a training",
        lambda: first_program("docs/jmvae.md"),
    ),
    "functions": ("... of Single functions", lambda: first_program("docs/functions.md")),
    "robot": (
        "`jaxsense export pretrained:noisy`",
        lambda: ("-m", "jaxsense", "export", "pretrained:noisy"),
    ),
    "demo": ("`jaxsense demo`", lambda: ("-m", "jaxsense", "demo", "--no-browser")),
}
"""Names in the table and words behind `python`, by the names of the option `steps`."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measures what newcomers wait for: imports, the demo, and the first programs of pages."""

    steps: tuple[str, ...] = tuple(STEPS)
    """Which steps, besides imports: the README's first `program`, the `demo`, and the first steps
    of the pages for four kinds of user: `tasks`, `robot`, `jmvae` and `functions`."""
    repeats: int = limited(5, at_least=1)
    """How often imports are measured; the medians count."""
    json: Path | None = None
    """File to write; must be new, and the source without changes since its commit."""

    def __post_init__(self):
        check_fields(self)


def seconds(words: tuple[str, ...], place: Path, home: Path) -> float:
    """How long Python takes for some words.

    Args:
      words: behind `python`.
      place: working directory, which must be new.
      home: directory of the user, where all caches are.
    """
    place.mkdir(parents=True)
    variables = {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    return pipeline.python(pipeline.ROOT, words, place, variables).seconds


def of_imports(repeats: int, place: Path) -> dict[str, list[float]]:
    """Seconds of an empty program and of each import, which take turns.

    Args:
      repeats: how often each is measured.
      place: a new directory.
    """
    found: dict[str, list[float]] = {program: [] for program in (_EMPTY, *_IMPORTS)}
    for i in range(repeats):
        for j, program in enumerate(found):
            found[program].append(seconds(("-c", program), place / f"{i}-{j}", place))
    return found


def of_step(name: str, place: Path) -> dict[str, float]:
    """Seconds of a step, at first and again.

    Args:
      name: of the step.
      place: a new directory.
    """
    _, words = STEPS[name]
    return {time: seconds(words(), place / time, place) for time in ("first", "again")}


def table(results: Mapping[str, Any]) -> str:
    """Seconds of each step in Markdown; of imports, those that an empty program does not take.

    Args:
      results: the content of the JSON file.
    """
    imports = results["imports"]

    def of_import(program: str) -> list[str]:
        pairs = zip(imports[program], imports[_EMPTY], strict=True)
        return [f"`{program}`", "", f"{statistics.median(x - empty for x, empty in pairs):.2f}"]

    rows = [of_import(program) for program in imports if program != _EMPTY]
    for name, found in results["steps"].items():
        rows.append([STEPS[name][0], f"{found['first']:.1f}", f"{found['again']:.1f}"])
    heads = ["step", "seconds at first", "again"]
    return studies.with_origin(studies.as_table(heads, rows), results)


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    measure.require_known(PROGRAM, "steps", arguments.steps, STEPS)
    if arguments.json is not None:
        measure.require_commit(PROGRAM)
    measure.reserve(PROGRAM, "json", arguments.json)
    # First: a commit that is made meanwhile is not what is measured.
    results = measure.origin(studies.command(PROGRAM, arguments))
    with tempfile.TemporaryDirectory() as folder:
        results["imports"] = of_imports(arguments.repeats, Path(folder) / "imports")
        results["steps"] = {name: of_step(name, Path(folder) / name) for name in arguments.steps}
    studies.write(arguments.json, results)
    print(table(results))


if __name__ == "__main__":
    main()

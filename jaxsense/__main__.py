"""`jaxsense COMMAND`, or `python -m jaxsense COMMAND`: the commands of the package."""

import importlib
import sys

from jaxsense.run import output
from jaxsense.run.version import __version__

COMMANDS = {
    "demo": ("jaxsense.demo", "plays a mission with trained robots and opens a page that shows it"),
    "tasks": ("jaxsense.task_list", "lists the frozen tasks and the returns of known policies"),
    "train": ("jaxsense.train", "trains the whole pipeline, from scanlines to policies"),
    "evaluate": ("jaxsense.evaluate", "plays missions with the policies of a finished run"),
    "explore": ("jaxsense.explore", "plays missions in places that the robots do not know"),
    "export": ("jaxsense.export", "writes trained models as one file for robots without JAX"),
}
"""The module of each command, and what it does."""


def main() -> None:
    """Runs the command that the process's command line names, and ends the process."""
    output.run(run)


def run() -> None:
    """Runs the command that the process's command line names."""
    match sys.argv[1:]:
        case [] | ["-h" | "--help", *_]:
            output.tell(_help())
        case ["--version", *_]:
            output.tell(f"jaxsense {__version__}")
        case [name, *_] if name in COMMANDS:
            del sys.argv[1]  # the command reads the rest
            importlib.import_module(COMMANDS[name][0]).main()
        case [name, *_]:
            known = ", ".join(COMMANDS)
            output.complain(f"jaxsense: command = {name[:80]!r}: must be one of {known}")
            sys.exit(2)


def _help() -> str:
    """A line for each command."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {about}" for name, (_, about) in COMMANDS.items()]
    begin = "usage: jaxsense COMMAND [OPTIONS]\n\ncommands:"
    end = "\n`jaxsense COMMAND --help` lists its options, `jaxsense --version` the version."
    return "\n".join([begin, *lines, end])


if __name__ == "__main__":
    main()

"""Command lines: options by tyro, and errors of the user as one line."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import jax
import tyro

from jaxsense.compilation import Kept
from jaxsense.config import Config, ConfigError
from jaxsense.sim import sensors

T = TypeVar("T")


def parse(program: str, arguments: type[T], argv: list[str], default: T | None = None) -> T:
    """Reads a command line; ends the program with status 2 and one line if it is wrong.

    Args:
      program: module that is run, for example "jaxsense.train".
      arguments: dataclass of the options.
      argv: the command line without the program.
      default: options that are not given.

    Returns:
      The options.
    """
    messages = io.StringIO()
    more: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(arguments, prog=f"python -m {program}", args=argv, **more)
    except ConfigError as error:
        fail(program, str(error))
    except SystemExit as stop:
        if stop.code == 0:
            raise
        fail(program, _one_line(messages.getvalue()))


def run(main: Callable[[], None]) -> None:
    """Runs a program, which Ctrl-C ends without many words."""
    try:
        main()
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr, flush=True)
        # Threads that compile would hold up any other way out.
        os._exit(130)


def fail(program: str, message: str) -> NoReturn:
    """Ends a program for a reason that is the user's to mend."""
    print(f"{program}: {message} (--help tells every option)", file=sys.stderr)
    sys.exit(2)


def keep_programs(program: str, directory: Path | None, config: Config) -> Kept | None:
    """Where compiled programs are kept.

    Args:
      program: module that is run.
      directory: where the user wants them, if anywhere.
      config: all settings.

    Returns:
      The programs with these settings; None if the directory cannot be used, which is told.
    """
    # Programs of several processes need all of them to load.
    if directory is None or jax.process_count() > 1:
        return None
    try:
        directory = directory.expanduser()
        kept = Kept(directory, config, sensors.fingerprints(config))
    except (OSError, RuntimeError) as error:
        print(f"{program}: programs cannot be kept in {directory} ({error})", file=sys.stderr)
        return None
    return kept


def _one_line(message: str) -> str:
    """What tyro says in a box, as one line without the box and without the help text."""
    _, *lines = message.splitlines()  # the first is the title of the box
    flat = " ".join(re.sub(r"[╰╯│─]|-{4,}", " ", " ".join(lines)).split())
    error = re.split(r" (?:For full helptext|Argument helptext|Perhaps you meant)", flat)[0]
    error = re.sub(r"^.*?Error parsing (?:config\S* )?", "", error)
    error = re.sub(r"invalid literal for int.*?: (.*)", r"\1 must be a whole number", error)
    error = re.sub(r"could not convert string to float: (.*)", r"\1 must be a number", error)
    similar = re.search(r"Perhaps you meant: (--\S+)", flat)
    return f"{error}; perhaps {similar[1]}" if similar else error

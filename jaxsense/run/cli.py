"""Reads command lines; user errors end a program in one line."""

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

import jax

from jaxsense.config import Config, ConfigError, options
from jaxsense.config.section import require_32_bits
from jaxsense.run.files import WriteError
from jaxsense.run.kept import Kept, use_cache
from jaxsense.run.monitor import StageError
from jaxsense.run.output import complain, tell

T = TypeVar("T")

_CACHES = Path(os.environ.get("XDG_CACHE_HOME", ""))
CACHE = (_CACHES if _CACHES.is_absolute() else Path("~/.cache")) / "jaxsense"
"""Where compiled programs are kept for later calls."""


def parse(program: str, base: T | type[T], argv: list[str] | None, common: Sequence[str] = ()) -> T:
    """Reads a command line; ends the program after printing the help or an error.

    Args:
      program: module to run, for example "jaxsense.train".
      base: dataclass of the options; an instance, or else the class, holds their defaults.
      argv: the command line without the program; by default the process's own.
      common: options that `--help` shows, in this order; all by default.
    """
    argv = sys.argv[1:] if argv is None else argv
    if {"-h", "--help", "--help-all"} & set(argv):
        tell(options.describe(program, base, () if "--help-all" in argv else common).rstrip())
        sys.exit(0)
    with ending(program):
        require_32_bits()
        return options.read(base, argv)


def warn(program: str, message: str) -> None:
    """Prints a line about a program, a module that runs, to standard error."""
    complain(f"{options.command(program).removeprefix('python -m ')}: {message}")


def fail(program: str, message: str) -> NoReturn:
    """Ends a program with status 2 and one line about an error that the user can correct."""
    warn(program, " ".join(message.splitlines()))
    sys.exit(2)


@contextlib.contextmanager
def ending(program: str, advice: str = "") -> Iterator[None]:
    """Ends a program at an error that its user can correct; `advice` follows a full disk."""
    try:
        yield
    except (ConfigError, StageError) as error:
        fail(program, str(error))
    except OSError as error:
        if isinstance(error, WriteError):  # every file is written as a whole or not at all
            fail(program, f"cannot write {error.filename}: {error.strerror}{advice}")
        cannot = f"{error.filename}: cannot be used ({error.strerror})"
        fail(program, cannot if error.filename else str(error))


def keep_programs(
    program: str, directory: Path | None, config: Config, *, has_own_code: bool = False
) -> Kept | None:
    """Opens the directory of compiled programs.

    Returns:
      The programs with these settings; None with custom sensors or policies, whose code may
      change, and, with a warning, if the usual directory cannot be used.

    Raises:
      ConfigError: if another directory cannot be used.
    """
    # All processes of a run must load a program together.
    if directory is None or jax.process_count() > 1:
        return None
    try:
        place = directory.expanduser()
        use_cache(place)
        is_kept = not (config.named_code or has_own_code)
        return Kept(place, jax.tree.structure(config)) if is_kept else None
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        if directory != CACHE:
            raise ConfigError("cache", str(directory), f"must be a directory ({reason})") from None
        warn(program, f"programs cannot be kept in {directory} ({reason})")
        return None

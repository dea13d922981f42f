"""Runs command lines: options, exit statuses, and user errors in one line."""

import contextlib
import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

import jax

from jaxsense.config import Config, ConfigError, options, require_32_bits
from jaxsense.run import kept, rundir
from jaxsense.run.kept import Kept
from jaxsense.tasks import pretrained

T = TypeVar("T")

CACHE = Path("~/.cache/jaxsense")
"""Where compiled programs are kept for later calls."""
# Exit statuses, as in shells.
INTERRUPTED = 130
_CLOSED = 141
_RARELY = 100_000, 50, 50  # see `gc.set_threshold`


def parse(
    program: str,
    arguments: type[T],
    argv: list[str],
    default: T | None = None,
    common: Sequence[str] = (),
) -> T:
    """Reads a command line; ends the program after printing the help or an error.

    Args:
      program: module to run, for example "jaxsense.train".
      arguments: dataclass of the options, which checks their values.
      argv: the command line without the program.
      default: values of missing options; those of the class by default.
      common: options that `--help` shows, in this order; all by default.

    Returns:
      The options.

    Raises:
      SystemExit: with status 0 after the help, with status 2 after an error.
    """
    base = arguments if default is None else default
    if {"-h", "--help", "--help-all"} & set(argv):
        is_all = "--help-all" in argv
        print(options.describe(program, base, () if is_all else common), end="")
        sys.exit(0)
    try:
        require_32_bits()
        return options.read(base, argv)
    except (ConfigError, options.OptionError) as error:
        fail(program, str(error))


def run(main: Callable[[], None]) -> None:
    """Runs a program; Ctrl-C ends it without a traceback."""
    # Tracing makes and drops millions of small objects; by default, looking for circles among them
    # takes a sixth of its time.
    gc.set_threshold(*_RARELY)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The terminal may be unable to show the name of a directory.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        main()
    except KeyboardInterrupt:
        complain("Interrupted.")
        _exit(INTERRUPTED)
    except BrokenPipeError:  # for example `--help | head`
        _exit(_CLOSED)
    except SystemExit as stop:
        _exit(stop.code if isinstance(stop.code, int) else int(stop.code is not None))


def _exit(status: int) -> NoReturn:
    """Ends the process immediately: any other exit would wait for compiling threads."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)


def complain(text: str) -> None:
    """Prints a line to standard error, if it is still open."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def warn(program: str, message: str) -> None:
    """Prints a line about a program to standard error.

    Args:
      program: module that runs.
      message: the rest of the line.
    """
    complain(f"{options.command(program).removeprefix('python -m ')}: {message}")


def fail(program: str, message: str) -> NoReturn:
    """Ends a program with one line about an error that the user can correct.

    Args:
      program: module that runs.
      message: the error.

    Raises:
      SystemExit: with status 2.
    """
    warn(program, " ".join(message.splitlines()))
    sys.exit(2)


def reason(error: OSError) -> str:
    """An `OSError` as one line."""
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def require_directory(field: str, path: Path | None) -> None:
    """Checks that a path is a directory or may become one.

    Args:
      field: name of the option, for the error.
      path: the path; None is allowed.

    Raises:
      ConfigError: if it is something else or cannot be used.
    """
    try:
        is_other = path is not None and path.exists() and not path.is_dir()
    except OSError as error:
        raise ConfigError(field, str(path), f"cannot be used ({error.strerror})") from None
    if is_other:
        raise ConfigError(field, str(path), "must be a directory")


def find_run(path: Path) -> Path:
    """Returns the directory of a run, where `latest` is the newest finished one in `runs/`.

    Raises:
      ConfigError: if there is no finished run, or if the models that come with jaxsense are named.
    """
    preset = (given := str(path)).removeprefix(pretrained.PREFIX)
    if (preset != given or preset in pretrained.PRETRAINED) and not path.exists():
        demo = f"{options.command('jaxsense.demo')} --preset {preset}"
        reason = f"must be the directory of a finished run; play pretrained models with {demo}"
        raise ConfigError("run", given, reason)
    return rundir.newest(path)


def keep_programs(
    program: str, directory: Path | None, config: Config, *, has_own_code: bool = False
) -> Kept | None:
    """Opens the directory of compiled programs.

    Args:
      program: module that runs.
      directory: where to keep them, if anywhere.
      config: all settings.
      has_own_code: whether missions play custom policies.

    Returns:
      The programs with these settings; None with custom sensors or policies, whose code may
      change, and, with a warning, if the directory cannot be used.
    """
    # All processes of a run must load a program together.
    if directory is None or jax.process_count() > 1:
        return None
    try:
        directory = directory.expanduser()
        if config.sensors or has_own_code:
            kept.use_cache(directory)
            return None
        return Kept(directory, jax.tree.structure(config))
    except (OSError, RuntimeError) as error:
        warn(program, f"programs cannot be kept in {directory} ({error})")
        return None

"""Command lines: options by tyro, and user errors as one line."""

import contextlib
import dataclasses
import difflib
import io
import itertools
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import jax
import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from jaxsense.config import Config, ConfigError, require_32_bits
from jaxsense.run import compilation
from jaxsense.run.compilation import Kept

T = TypeVar("T")

CACHE = Path("~/.cache/jaxsense")
# Exit statuses, as in shells.
INTERRUPTED = 130
_CLOSED = 141


def parse(program: str, arguments: type[T], argv: list[str], default: T | None = None) -> T:
    """Reads a command line; ends the program with status 2 and one line if it is wrong.

    Args:
      program: module to run, for example "jaxsense.train".
      arguments: dataclass of the options, which checks their types.
      argv: the command line without the program.
      default: values of options that are missing.

    Returns:
      The options.
    """
    more: dict[str, Any] = {} if default is None else {"default": default}
    try:
        require_32_bits()
        with contextlib.redirect_stderr(io.StringIO()):
            found, unknown = tyro.cli(
                arguments,
                prog=f"python -m {program}",
                args=argv,
                return_unknown_args=True,
                registry=_texts_of_wrong_types(),
                **more,
            )
        if unknown:
            raise _unknown(arguments, unknown)
        return found
    except ConfigError as error:
        wrong = error
    except SystemExit as stop:
        if stop.code == 0:
            raise
        wrong = _cause(stop) or _lacking(arguments, argv)
    fail(program, f"{wrong} (--help lists every option)")


def run(main: Callable[[], None]) -> None:
    """Runs a program; Ctrl-C ends it without a traceback."""
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
    """Ends the process at once: any other exit would wait for threads that compile."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(status)


def complain(text: str) -> None:
    """Prints a line to standard error, if it is still open."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def fail(program: str, message: str) -> NoReturn:
    """Ends a program with status 2 for an error that the user can correct."""
    complain(f"{program}: {' '.join(message.splitlines())}")
    sys.exit(2)


def reason(error: OSError) -> str:
    """An `OSError` as one line."""
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def require_directory(field: str, path: Path | None) -> None:
    """Raises `ConfigError` if a path is no directory, or cannot be one."""
    try:
        is_other = path is not None and path.exists() and not path.is_dir()
    except OSError as error:
        raise ConfigError(field, str(path), f"cannot be used ({error.strerror})") from None
    if is_other:
        raise ConfigError(field, str(path), "must be a directory")


def keep_programs(program: str, directory: Path | None, config: Config) -> Kept | None:
    """Opens the directory of compiled programs.

    Args:
      program: module that runs.
      directory: where to keep them, if anywhere.
      config: all settings.

    Returns:
      The programs with these settings; None if the settings name custom sensors, whose code may
      change, and, with a warning, if the directory cannot be used.
    """
    # Several processes can load a program only together.
    if directory is None or jax.process_count() > 1:
        return None
    try:
        directory = directory.expanduser()
        if config.sensors:
            compilation.use_cache(directory)
            return None
        return Kept(directory, jax.tree.structure(config))
    except (OSError, RuntimeError) as error:
        complain(f"{program}: programs cannot be kept in {directory} ({error})")
        return None


def _texts_of_wrong_types() -> ConstructorRegistry:
    """Rules that make tyro pass on a text that is not of an option's type.

    The dataclass then names the option, the text and what would be right.
    """
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def read(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        kind: Any = info.type
        if kind not in (int, float, Path, int | None, Path | None) and not _is_literal(kind):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=_metavar(kind),
            instance_from_str=lambda texts: _read(kind, texts[0]),
            is_instance=lambda value: True,
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def _is_literal(kind: Any) -> bool:
    return get_origin(kind) is Literal


def _metavar(kind: Any) -> str:
    """The value of an option in `--help`."""
    if get_origin(kind) in (Union, types.UnionType):
        return "|".join(map(_metavar, get_args(kind)))
    if _is_literal(kind):
        return f"{{{','.join(get_args(kind))}}}"
    return "{None}" if kind is types.NoneType else kind.__name__.upper()


def _read(kind: Any, text: str) -> Any:
    """The value of a text, or the text itself if it is of another type."""
    if get_origin(kind) in (Union, types.UnionType):
        return None if text == "None" else _read(get_args(kind)[0], text)
    if _is_literal(kind):
        return text
    if kind is Path:
        return Path(text) if text and text.isprintable() else text
    try:
        return kind(text)
    except ValueError:
        return text


def _options(arguments: Any, prefix: str = "--") -> dict[str, Any]:
    """The options of a dataclass and their types."""
    found = {}
    for field, annotated in get_type_hints(arguments, include_extras=True).items():
        kind, *marks = get_args(annotated) if hasattr(annotated, "__metadata__") else [annotated]
        names = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        name = names[0] if names else field.replace("_", "-")
        if dataclasses.is_dataclass(kind):
            found |= _options(kind, f"{prefix}{name}." if name else prefix)
        elif tyro.conf.Positional not in marks:
            found[prefix + name] = kind
    return found


def _cause(error: BaseException | None) -> ConfigError | None:
    """The dataclass error that ended tyro, if any."""
    while error is not None and not isinstance(error, ConfigError):
        error = error.__context__
    return error


def _unknown(arguments: Any, words: list[str]) -> ConfigError:
    """The error about words that belong to no option."""
    word = next((word for word in words if word.startswith("-")), words[0])
    name = word.partition("=")[0].replace("_", "-")
    similar = difflib.get_close_matches(name, _options(arguments), 1, 0.7)
    hint = f"; perhaps {similar[0]}" if similar else ""
    return ConfigError("option", word, f"must be one of the program{hint}")


def _lacking(arguments: Any, argv: list[str]) -> ConfigError:
    """The error about an option without a value, or a missing word."""
    options = _options(arguments)
    for word, following in itertools.pairwise([*argv, "--"]):
        kind = options.get(word.replace("_", "-"), bool)
        if kind is not bool and following.startswith("--"):
            return ConfigError(word.removeprefix("--"), "", "must have a value")
    for field in dataclasses.fields(arguments):
        if tyro.conf.Positional in get_args(field.type):
            return ConfigError(field.name, "", "must be given")
    return ConfigError("options", " ".join(argv), "must have as many values as each option takes")

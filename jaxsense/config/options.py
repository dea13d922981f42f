"""Settings as plain data, the form of `config.json`, and as options of a command line."""

import argparse
import contextlib
import dataclasses
import difflib
import functools
import inspect
import json
import re
import shlex
import sys
import tomllib
import types
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NoReturn,
    TypeVar,
    cast,
    get_args,
    get_origin,
)

from jaxsense.config.section import ConfigError, fields_of
from jaxsense.config.whole import Config

T = TypeVar("T")
_LONGEST = 100  # characters of a reason, which may repeat a word


def as_plain(config: Config) -> dict[str, Any]:
    """Converts settings to dictionaries, lists, numbers and strings, for JSON."""
    return dataclasses.asdict(config)


def from_plain(stored: object, base: Config | None = None, *, skips: bool = False) -> Config:
    """Makes settings from plain data, the inverse of `as_plain`.

    Args:
      stored: sections and their fields.
      base: source of missing settings; the defaults by default.
      skips: whether to skip what are constants now, as models do that travel with the package.

    Raises:
      ConfigError: names a field that is unknown, of the wrong type, or invalid.
    """
    return cast(Config, _made(Config, stored, base or Config(), skips=skips))


def _made(
    kind: Any, stored: object, base: object = None, place: str = "", *, skips: bool = False
) -> object:
    """A value of a type, its missing fields from `base`; dataclasses check their fields."""
    if not dataclasses.is_dataclass(kind):
        if isinstance(stored, dict) and len(inner := get_args(kind)) == 2:
            return {n: _made(inner[1], each, None, f"{place}.{n}") for n, each in stored.items()}
        return stored
    if not isinstance(stored, dict):
        raise ConfigError(place or "config", stored, "must be an object with names and values")
    kinds, given = {name: each for name, each, *_ in fields_of(kind)}, {}
    for name, value in stored.items():
        path, default = f"{place}.{name}".lstrip("."), getattr(base or kind, name, None)
        is_nested = isinstance(default, Mapping) or dataclasses.is_dataclass(default)
        if skips and (name not in kinds or isinstance(value, dict) != is_nested):
            continue
        if name not in kinds:
            near = _nearest(path, [*flat(as_plain(Config()))])
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ConfigError(path, value, f"unknown setting{hint}")
        given[name] = _made(kinds[name], value, default, path, skips=skips)
    if base is not None:
        return dataclasses.replace(cast(Any, base), **given)
    for field in dataclasses.fields(kind):
        if field.name not in given and field.default is dataclasses.MISSING:
            raise ConfigError(place, stored, f"missing setting {field.name}")
    return kind(**given)  # pyright: ignore[reportCallIssue]


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Plain settings by `section.name`."""
    found: dict[str, object] = {}
    for name, value in settings.items():
        path = f"{prefix}{name}"
        found |= flat(value, f"{path}.") if isinstance(value, Mapping) else {path: value}
    return found


def _nearest(path: str, names: Sequence[str]) -> list[str]:
    """The names nearest to an unknown one, of its section or else of any."""
    section, _, last = path.rpartition(".")
    apart = [name.rpartition(".") for name in names]
    for known in ([name for name in apart if name[0] == section], apart):
        for near in difflib.get_close_matches(last, [name[2] for name in known], 1, 0.7):
            return ["".join(name) for name in known if name[2] == near]
    return []


def parse(content: bytes, *, is_toml: bool = False) -> object:
    """Parses JSON or TOML strictly: UTF-8, no deep nesting, no field twice, no half of a character.

    Raises:
      ValueError: if the content is something else.
    """
    try:
        if is_toml:
            return tomllib.loads(content.decode())
        found = json.loads(content.decode(), object_pairs_hook=_without_twins)
        json.dumps(found, ensure_ascii=False).encode()
        return found
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _without_twins(fields: list[tuple[str, object]]) -> dict[str, object]:
    for name, number in Counter(name for name, _ in fields).items():
        if number > 1:
            raise ValueError(f"{name!r} appears twice")
    return dict(fields)


_POSITIONAL = "positional"
Positional = Annotated[T, _POSITIONAL]
"""A field that is a positional argument of the command line, not the option `--FIELD`."""


@dataclasses.dataclass(frozen=True)
class Option:
    """A command-line option, or a positional argument.

    Attributes:
      path: fields and keys that lead to its value, with dots between them.
      name: on the command line.
      kind: type of the value.
      default: value if it is missing; `dataclasses.MISSING` if it is required.
      section: dataclass that declares it.
    """

    path: str
    name: str
    kind: object
    default: object
    section: type

    @property
    def is_optional(self) -> bool:
        """Whether the value may be None."""
        return types.NoneType in get_args(self.kind)

    @property
    def words(self) -> tuple[object, int | str | None]:
        """Type of the words of the value and, of a tuple, their number as argparse has it."""
        kind = get_args(self.kind)[0] if self.is_optional else self.kind
        if get_origin(kind) is not tuple:
            return kind, None
        inner = get_args(kind)
        return inner[0], "*" if ... in inner else len(inner)

    @property
    def help(self) -> str:
        """The description of the field, or of the dictionary with this entry, and the default."""
        known, value = docs(self.section), self.default
        text = next((known[field] for field in self.path.split(".")[::-1] if field in known), "")
        if value is not False and value not in (None, (), dataclasses.MISSING):
            words = shlex.join(map(str, value)) if isinstance(value, tuple) else value
            text += f" (default: {'on' if value is True else words})"
        return text.replace("`", "").replace("%", "%%")

    def declare(self, parser: argparse._ActionsContainer) -> None:
        """Adds it to a parser, whose result has its words or truth value under its path."""
        kind, number = self.words
        is_named = self.name.startswith("--")
        how: dict[str, Any] = {"dest": self.path, "default": argparse.SUPPRESS, "help": self.help}
        if kind is bool:
            how["action"] = argparse.BooleanOptionalAction
        else:
            names: dict[object, str] = {int: "INT", float: "NUMBER", Path: "PATH"}
            shown = f"{{{','.join(get_args(kind))}}}" if get_origin(kind) is Literal else None
            how["metavar"] = (shown or names.get(kind, "NAME")) if is_named else self.name
            how["nargs"] = number if is_named else number or "?"  # `read` tells if it is missing
            how["type"] = self.value
        parser.add_argument(*[self.name] * is_named, **how)

    def value(self, word: str) -> object:
        """The value of a word; one of another type stays text, which the dataclass refuses."""
        kind, _ = self.words
        if word is argparse.SUPPRESS:  # a positional argument that is missing
            return word
        if self.is_optional and word.lower() == "none":
            return None
        if kind is Path and word and word.isprintable():
            return Path(word)
        with contextlib.suppress(ValueError):
            return int(word) if kind is int else float(word) if kind is float else word
        return word


def options_of(base: object, path: str = "", place: str | None = None) -> Iterator[Option]:
    """All options of a dataclass, an instance or else the class, which holds their defaults.

    Args:
      base: the dataclass; the `PLACE` of a `Checked` one is the prefix of its options.
      path: fields and keys that lead to it.
      place: another prefix.
    """
    section = base if isinstance(base, type) else type(base)
    place = getattr(section, "PLACE", "") if place is None else place
    for field, kind, _, marks in fields_of(section):
        default = getattr(base, field, dataclasses.MISSING)
        to, inside = f"{path}.{field}".lstrip("."), f"{place}.{field}".lstrip(".")
        name = field.upper() if _POSITIONAL in marks else f"--{inside.replace('_', '-')}"
        if dataclasses.is_dataclass(default):
            yield from options_of(default, to)
        elif isinstance(default, Mapping):
            for key, each in default.items():
                if dataclasses.is_dataclass(each):
                    yield from options_of(each, f"{to}.{key}", f"{inside}.{key}")
                else:
                    entry = f"{name}.{key.replace('_', '-')}"
                    yield Option(f"{to}.{key}", entry, get_args(kind)[1], each, section)
        else:
            yield Option(to, name, kind, default, section)


class _Parser(argparse.ArgumentParser):
    """Parser of some options, by section."""

    def __init__(self, options: Iterable[Option], **texts: Any):
        form = functools.partial(argparse.HelpFormatter, max_help_position=6)
        super().__init__(add_help=False, allow_abbrev=False, formatter_class=form, **texts)
        groups: dict[str, argparse._ArgumentGroup] = {}
        for option in options:
            place = getattr(option.section, "PLACE", "")
            if place not in groups:
                description = about(option.section).replace("`", "") if place else None
                groups[place] = self.add_argument_group(place or "options", description)
            option.declare(groups[place])

    def error(self, message: str) -> NoReturn:
        """Raises a `ConfigError` about "argument NAME: REASON"; argparse would end the process."""
        name, _, reason = message.removeprefix("argument ").partition(": ")
        raise ConfigError("option", name, reason[:_LONGEST])


def read(base: T | type[T], argv: list[str]) -> T:
    """Reads a command line.

    Args:
      base: dataclass of the options; an instance, or else the class, holds their defaults.
      argv: the command line without the program.

    Raises:
      ConfigError: if an option is unknown, an option or a value is missing, or a value is wrong.
    """
    values, rest = given(base, argv)
    options = [*options_of(base)]
    if rest:
        switches = [f"--no-{option.name[2:]}" for option in options if option.kind is bool]
        raise ConfigError("option", *_unknown(rest, [*(o.name for o in options), *switches]))
    for option in options:
        if option.default is dataclasses.MISSING and option.path not in values:
            raise ConfigError("option", option.name, f"is missing: {option.help}")
    kind = base if isinstance(base, type) else type(base)
    plain: dict[str, Any] = {} if isinstance(base, type) else dataclasses.asdict(cast(Any, base))
    for path, value in values.items():
        plain = _changed(plain, path.split("."), value)
    return cast(T, _made(kind, plain))


def given(base: object, argv: list[str]) -> tuple[dict[str, object], list[str]]:
    """The values on a command line by their paths, and the words that belong to no option."""
    # Also `--num_seeds`.
    dashed = [re.sub(r"^--[^=]*", lambda name: name[0].replace("_", "-"), word) for word in argv]
    found, rest = _Parser(options_of(base)).parse_known_args(dashed)
    values = {name: tuple(x) if isinstance(x, list) else x for name, x in vars(found).items()}
    return {name: None if x == (None,) else x for name, x in values.items()}, rest


def _changed(plain: Mapping[str, Any], path: Sequence[str], value: object) -> dict[str, Any]:
    """Nested dictionaries with another value at a path."""
    name, *rest = path
    return {**plain, name: _changed(plain.get(name, {}), rest, value) if rest else value}


def _unknown(words: list[str], names: list[str]) -> tuple[str, str]:
    """A word that belongs to no option, and what would be right."""
    word = next((word for word in words if word.startswith("-")), words[0])
    if not word.startswith("-"):
        return word, "unexpected argument: options start with --"
    name = word.partition("=")[0]
    # So that nothing is suggested that switches on what should be off.
    wanted = f"no-{name[2:].replace('no-', '', 1)}" if "no-" in name else name[2:]
    near = _nearest(wanted, [each[2:] for each in names if each.startswith("--")])
    return name, f"is unknown; did you mean --{near[0]}?" if near else "is unknown; see --help-all"


def command(program: str) -> str:
    """The command line that runs a module such as "jaxsense.train" as this process was started."""
    # If the console script is in use, `python` on the path may not find the package.
    if Path(sys.argv[0]).name == "jaxsense":
        return program.replace(".", " ", 1)
    return f"python -m {program}"


def describe(program: str, base: object, common: Sequence[str] = ()) -> str:
    """Returns the help.

    Args:
      program: module to run, for example "jaxsense.train".
      base: as in `read`.
      common: options to show, in this order; by default all, by section.
    """
    options = {option.name: option for option in options_of(base)}
    named = (x for name, x in options.items() if not name.startswith("-"))
    words = (f"[{x.name} ...]" if x.words[1] else x.name for x in named)
    usage = " ".join([command(program), "[OPTIONS]", *words])
    shown = (options[name] for name in common or options)
    end = f"--help-all lists all {len(options)} options." if common else ""
    return _Parser(
        shown, usage=usage, description=about(base).replace("`", ""), epilog=end
    ).format_help()


def about(section: object) -> str:
    """Description of a dataclass in its docstring, without that of its fields."""
    return " ".join((section.__doc__ or "").partition("Attributes:")[0].split())


def docs(section: type) -> dict[str, str]:
    """Descriptions of the fields of a dataclass in its docstring, each as one line."""
    _, _, attributes = inspect.cleandoc(section.__doc__ or "").partition("Attributes:\n")
    _, *parts = re.split(r"^  (\w+): ", attributes, flags=re.MULTILINE)
    texts = (" ".join(text.split()) for text in parts[1::2])
    return dict(zip(parts[::2], texts, strict=True))

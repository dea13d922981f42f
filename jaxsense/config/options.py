"""Settings as options of a command line: fields of dataclasses, whose docstrings are the help."""

import argparse
import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import itertools
import re
import shlex
import sys
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NoReturn, TypeVar, cast, get_args, get_origin, get_type_hints

T = TypeVar("T")
_LONGEST = 300  # characters of an error of `argparse`, which repeats values
_Values = Mapping[tuple[str, ...], object]
"""Values of options, by the fields that lead to them."""


class OptionError(ValueError):
    """A command line that cannot be read; its text is one line."""


class Name(str):
    """Annotates a field that is not the option `--FIELD` on the command line.

    `Name("--config")` is another option, `Name("RUN")` a positional argument, and `Name("--")` a
    section whose options have no prefix.
    """


def read(base: T | type[T], argv: list[str]) -> T:
    """Reads a command line.

    Args:
      base: dataclass of the options; an instance, or else the class, holds their defaults.
      argv: the command line without the program.

    Returns:
      The dataclass with the values of the command line.

    Raises:
      OptionError: if an option is unknown, or an option or a value is missing.
      ConfigError: by the dataclass, for a value that is wrong.
    """
    options = _options(base)
    values, unknown = _split(options, argv)
    if unknown:
        raise OptionError(_unknown(unknown, [option.name for option in options]))
    for option in options:
        if option.default is dataclasses.MISSING and option.path not in values:
            what = option.help[:1].lower() + option.help[1:].rstrip(".")
            raise OptionError(f"missing argument {option.name}: {what}")
    return cast(T, _changed(base, values))


def read_some(arguments: type, argv: list[str], fields: Sequence[str]) -> dict[str, object]:
    """Reads some options before the defaults of the others are known.

    Args:
      arguments: dataclass of the options.
      argv: the command line without the program.
      fields: fields of the options to read.

    Returns:
      Values on the command line, by field; text where the type is wrong.

    Raises:
      OptionError: if the value of one of these options is missing.
    """
    options = [option for option in _options(arguments) if option.path[0] in fields]
    values, _ = _split(options, argv)
    return {field: value for (field,), value in values.items()}


def command(program: str) -> str:
    """The command line that runs a program, the way this process was started.

    Args:
      program: its module, for example "jaxsense.train".
    """
    # If the console script is in use, `python` on the path may not find the package.
    if Path(sys.argv[0]).name == "jaxsense":
        return program.replace(".", " ", 1)
    return f"python -m {program}"


def describe(program: str, base: object, common: Sequence[str] = ()) -> str:
    """Returns the help, set for the width of the terminal.

    Args:
      program: module to run, for example "jaxsense.train".
      base: as in `read`.
      common: options to show, in this order; by default all, by section.
    """
    shown = {option.name: option for option in _options(base)}
    words = [each.usage for name, each in shown.items() if not name.startswith("-")]
    parser = argparse.ArgumentParser(
        usage=" ".join([f"{command(program)} [OPTIONS]", *words]),
        description=_plain(base.__doc__ or ""),
        epilog=f"--help-all lists all {len(shown)} options." if common else None,
        add_help=False,
        formatter_class=_Formatter,
    )
    groups = {"": parser.add_argument_group("options")}
    for option in (shown[name] for name in common or shown):
        place = "" if common else option.place
        if place not in groups:
            groups[place] = parser.add_argument_group(place, _plain(option.section.__doc__ or ""))
        option.add_to(groups[place], _text(option), _metavar(option))
    return parser.format_help()


@dataclasses.dataclass(frozen=True)
class _Option:
    """A command-line option, a positional argument, or a section of options.

    Attributes:
      path: fields and keys that lead to its value.
      name: on the command line.
      kind: type of the value.
      default: value if it is missing; `dataclasses.MISSING` if it is required.
      section: dataclass that declares it.
      place: what precedes the section's options, such as "team.travel"; "" for the program's own.
    """

    path: tuple[str, ...]
    name: str
    kind: object
    default: object
    section: type
    place: str = ""

    @property
    def is_optional(self) -> bool:
        """Whether the value may be None."""
        return types.NoneType in get_args(self.kind)

    @property
    def words(self) -> tuple[object, str | int | None]:
        """Type of the words of the value, and their number in the form of `argparse`."""
        kind = get_args(self.kind)[0] if self.is_optional else self.kind
        if get_origin(kind) is not tuple:
            return kind, None
        inner = get_args(kind)
        return inner[0], "*" if ... in inner else len(inner)

    @property
    def usage(self) -> str:
        """A positional argument as a usage line shows it."""
        several = f"{self.name} ..." if self.words[1] == "*" else self.name
        return several if self.default is dataclasses.MISSING else f"[{several}]"

    @property
    def off(self) -> str:
        """The option that sets False, such as `--mission.no-redecides`."""
        return re.sub(r"^(.*\.|--)", r"\1no-", self.name)

    @property
    def help(self) -> str:
        """The field's docstring; of a word of a dictionary, that of the dictionary."""
        known = docs(self.section)
        return _plain(next((known[field] for field in reversed(self.path) if field in known), ""))

    def options(self) -> Iterator["_Option"]:
        """The options of a section or a dictionary; any other option itself."""
        default, prefix = self.default, self.name if self.name == "--" else f"{self.name}."
        if isinstance(default, Mapping):
            kind = get_args(self.kind)[1]
            for key, value in default.items():
                name = prefix + key.replace("_", "-")
                path = (*self.path, key)
                yield from _Option(path, name, kind, value, self.section, self.place).options()
        elif dataclasses.is_dataclass(default):
            section = default if isinstance(default, type) else type(default)
            kinds, marked = get_type_hints(section), get_type_hints(section, include_extras=True)
            for field in (each.name for each in dataclasses.fields(section)):
                kind = kinds[field]
                names = [mark for mark in get_args(marked[field]) if isinstance(mark, Name)]
                name = names[0] if names else prefix + field.replace("_", "-")
                value = getattr(default, field, dataclasses.MISSING)
                path, place = (*self.path, field), prefix.strip("-.")
                yield from _Option(path, name, kind, value, section, place).options()
        else:
            yield self

    def add_to(
        self,
        parser: argparse._ActionsContainer,
        text: str | None = None,
        metavar: str | None = None,
    ) -> None:
        """Adds the option, with its help, to a parser or to a group of one."""
        name, (_, number) = self.name, self.words
        if self.kind is bool:
            parser.add_argument(name, action="store_true", dest=name, help=text)
            hidden = argparse.SUPPRESS
            parser.add_argument(self.off, action="store_false", dest=name, help=hidden)
        elif name.startswith("-"):
            parser.add_argument(name, nargs=number, dest=name, help=text, metavar=metavar)
        else:
            parser.add_argument(name, nargs=number or "?", help=text, metavar=metavar)

    def value(self, words: bool | str | list[str]) -> object:
        """Reads the value. Words of another type stay text, which the dataclass refuses."""
        if isinstance(words, bool):
            return words
        kind, number = self.words
        words = [words] if isinstance(words, str) else words
        if self.is_optional and [word.lower() for word in words] == ["none"]:
            return None
        values = tuple(_of_type(kind, word) for word in words)
        return values[0] if number is None else values


def _options(base: object) -> list[_Option]:
    """All options of a dataclass, see `read`."""
    return list(_Option((), "--", type(base), base, type(base)).options())


def _of_type(kind: object, word: str) -> object:
    """A word as a number or a path, if it is one."""
    if kind is Path and word and word.isprintable():
        return Path(word)
    with contextlib.suppress(ValueError):
        return int(word) if kind is int else float(word) if kind is float else word
    return word


def _plain(text: str) -> str:
    """A docstring without backticks."""
    return text.replace("`", "")


@functools.cache
def docs(section: type) -> dict[str, str]:
    """Docstrings of the fields of a dataclass, each as one line.

    Args:
      section: the dataclass; its source must be available.
    """
    found: dict[str, str] = {}
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(section))).body
    for pair in itertools.pairwise(getattr(node, "body", ())):
        match pair:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
    return found


def _changed(section: object, values: _Values) -> object:
    """A section with other values at some paths; of a class, a new instance."""
    if () in values:
        return values[()]
    parts: dict[str, dict[tuple[str, ...], object]] = {path[0]: {} for path in values}
    for path, value in values.items():
        parts[path[0]][path[1:]] = value
    if isinstance(section, Mapping):
        return {**section, **{key: _changed(section[key], part) for key, part in parts.items()}}
    new = {name: _changed(getattr(section, name, None), part) for name, part in parts.items()}
    if dataclasses.is_dataclass(section) and not isinstance(section, type):
        return dataclasses.replace(section, **new)
    assert isinstance(section, type)
    return section(**new)


class _Parser(argparse.ArgumentParser):
    """Raises errors."""

    def error(self, message: str) -> NoReturn:
        raise OptionError(message if len(message) <= _LONGEST else f"{message[:_LONGEST]} ...")


def _split(options: list[_Option], argv: list[str]) -> tuple[_Values, list[str]]:
    """The values on a command line, and the words that belong to no option."""
    parser = _Parser(add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for option in options:
        option.add_to(parser)
    # `--num_seeds` is `--num-seeds`.
    words = [re.sub("^--[^=]*", lambda name: name[0].replace("_", "-"), word) for word in argv]
    if separator := next((word for word in words if re.fullmatch("--[^=]+=--", word)), None):
        # Up to Python 3.12, `argparse` drops the value.
        parser.error(f"argument {separator[:-3]}: expected a value other than --")
    found, unknown = parser.parse_known_args(words)
    values = vars(found)
    given = [option for option in options if option.name in values]
    return {option.path: option.value(values[option.name]) for option in given}, unknown


class _Formatter(argparse.HelpFormatter):
    """Sets each option above its text, and keeps the names of options in one piece."""

    def __init__(self, prog: str):
        super().__init__(prog, max_help_position=6)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)


def _metavar(option: _Option) -> str:
    """Placeholder in the help for each word of a value."""
    kind, _ = option.words
    if get_origin(kind) is Literal:
        return f"{{{','.join(get_args(kind))}}}"
    is_named = option.name.startswith("-")
    names = {int: "INT", float: "NUMBER", Path: "PATH"}
    return names.get(kind, "NAME") if is_named else option.name


def _text(option: _Option) -> str:
    """An option's docstring and default value, in the form of `argparse`."""
    value, default = option.default, ""
    if value is True:
        default = f" (default: on; {option.off} turns it off)"
    elif value not in (None, (), dataclasses.MISSING) and value is not False:
        words = shlex.join(map(str, value)) if isinstance(value, tuple) else value
        default = f" (default: {words})"
    return f"{option.help}{default}".replace("%", "%%")


def _unknown(words: list[str], names: list[str]) -> str:
    """The message about words that belong to no option."""
    word = next((word for word in words if word.startswith("-")), words[0])
    name = word.partition("=")[0][:80]
    if not name.startswith("-"):
        return f"unexpected argument {name!r}: options start with --"
    # Without a section, an option of any section may be meant; the first one is the likeliest.
    known = {each if "." in name else re.sub(r"^.*\.", "--", each): each for each in names[::-1]}
    similar = difflib.get_close_matches(name[2:], [each[2:] for each in known], 1, 0.7)
    hint = f"did you mean {known['--' + similar[0]]}?" if similar else "see --help-all"
    return f"unknown option {name}; {hint}"

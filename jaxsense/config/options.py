"""Settings as plain data, the form of `config.json`, and as options of a command line."""

import contextlib
import dataclasses
import difflib
import inspect
import json
import math
import re
import shlex
import shutil
import sys
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from jaxsense.config.section import ConfigError
from jaxsense.config.whole import Config

T = TypeVar("T")
_LONGEST = 80  # characters of a word that an error repeats


def as_plain(config: Config) -> dict[str, Any]:
    """Converts settings to dictionaries, lists, numbers and strings, for JSON."""
    return dataclasses.asdict(config)


def from_plain(stored: object, base: Config | None = None) -> Config:
    """Makes settings from plain data, the inverse of `as_plain`.

    Args:
      stored: sections and their fields.
      base: source of missing settings; the defaults by default.

    Raises:
      ConfigError: names a field that is unknown, of the wrong type, or invalid.
    """
    return cast(Config, _made(Config, stored, base or Config()))


def _made(kind: Any, stored: object, base: object = None, place: str = "") -> object:
    """A value of a type, its missing fields from `base`; dataclasses check their fields."""
    if not dataclasses.is_dataclass(kind):
        if isinstance(stored, dict) and len(inner := get_args(kind)) == 2:
            return {n: _made(inner[1], each, None, f"{place}.{n}") for n, each in stored.items()}
        return stored
    if not isinstance(stored, dict):
        raise ConfigError(place or "config", stored, "must be an object with names and values")
    kinds, given = get_type_hints(kind), {}
    for name, value in stored.items():
        path = f"{place}.{name}".lstrip(".")
        if name not in kinds:
            near = _nearest(path, [*flat(as_plain(Config()))])
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            raise ConfigError(path, value, f"unknown setting{hint}")
        default = getattr(kind if base is None else base, name, None)
        given[name] = _made(kinds[name], value, default, path)
    if base is not None:
        return dataclasses.replace(cast(Any, base), **given)
    for field in dataclasses.fields(kind):
        if field.name not in given and field.default is dataclasses.MISSING:
            raise ConfigError(place, stored, f"missing setting {field.name}")
    return kind(**given)  # pyright: ignore[reportCallIssue]


def without_former(stored: Mapping[str, Any], section: object | None = None) -> dict[str, Any]:
    """Plain settings of models that travel with the package, without what are constants now."""
    now, kept = vars(section or Config()), {}
    for name, value in stored.items():
        if dataclasses.is_dataclass(now.get(name)):
            kept[name] = without_former(value, now[name])
        elif name in now and isinstance(value, dict) == isinstance(now[name], dict):
            kept[name] = value
    return kept


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Plain settings by `section.name`."""
    found: dict[str, object] = {}
    for name, value in settings.items():
        inner = flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else None
        found |= {f"{prefix}{name}": value} if inner is None else inner
    return found


def _nearest(path: str, names: Sequence[str]) -> list[str]:
    """The names nearest to an unknown one, of its section or else of any."""
    section, _, last = path.rpartition(".")
    apart = [name.rpartition(".") for name in names]
    for known in ([name for name in apart if name[0] == section], apart):
        for near in difflib.get_close_matches(last, [name[2] for name in known], 1, 0.7):
            return ["".join(name) for name in known if name[2] == near]
    return []


def parse_json(content: bytes) -> object:
    """Parses JSON strictly: UTF-8, no deep nesting, no field twice, no half of a character.

    Raises:
      ValueError: if the content is not such JSON.
    """
    try:
        found = json.loads(content.decode(), object_pairs_hook=_without_twins)
        json.dumps(found, ensure_ascii=False).encode()
        return found
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _without_twins(fields: list[tuple[str, object]]) -> dict[str, object]:
    names = [name for name, _ in fields]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name!r} appears twice")
    return dict(fields)


class OptionError(ValueError):
    """A command line that cannot be read; its text is one line."""


class Name(str):
    """Annotates a field that is not the option `--FIELD` on the command line.

    `Name("RUN")` is a positional argument, `Name("--")` a section whose options have no prefix.
    """


@dataclasses.dataclass(frozen=True)
class Option:
    """A command-line option, or the positional argument.

    Attributes:
      path: fields and keys that lead to its value.
      name: on the command line.
      kind: type of the value.
      default: value if it is missing; `dataclasses.MISSING` if it is required.
      section: dataclass that declares it.
    """

    path: tuple[str, ...]
    name: str
    kind: object
    default: object
    section: type

    @property
    def is_optional(self) -> bool:
        """Whether the value may be None."""
        return types.NoneType in get_args(self.kind)

    @property
    def words(self) -> tuple[object, float | None]:
        """Type of the words of the value and, of a tuple, their number."""
        kind = get_args(self.kind)[0] if self.is_optional else self.kind
        if get_origin(kind) is not tuple:
            return kind, None
        inner = get_args(kind)
        return inner[0], math.inf if ... in inner else len(inner)

    @property
    def off(self) -> str:
        """The option that sets False, such as `--mission.no-auctions`."""
        return re.sub(r"^(.*\.|--)", r"\1no-", self.name)

    @property
    def help(self) -> str:
        """The field's description; of an entry of a dictionary, that of the dictionary."""
        known = docs(self.section)
        text = next((known[field] for field in reversed(self.path) if field in known), "")
        return text.replace("`", "")

    def value(self, words: list[str]) -> object:
        """Reads the value. Words of another type stay text, which the dataclass refuses."""
        kind, number = self.words
        if self.is_optional and [word.lower() for word in words] == ["none"]:
            return None
        values = tuple(_of_type(kind, word) for word in words)
        return values[0] if number is None else values


def options_of(base: object, name: str = "--", path: tuple[str, ...] = ()) -> Iterator[Option]:
    """All options of a dataclass, an instance or else the class, which holds their defaults."""
    section = base if isinstance(base, type) else type(base)
    kinds, marked = get_type_hints(section), get_type_hints(section, include_extras=True)
    prefix = name if name == "--" else f"{name}."
    for field in (each.name for each in dataclasses.fields(cast(Any, section))):
        default = getattr(base, field, dataclasses.MISSING)
        own = next((mark for mark in get_args(marked[field]) if isinstance(mark, Name)), None)
        inside, to = own or prefix + field.replace("_", "-"), (*path, field)
        if dataclasses.is_dataclass(default):
            yield from options_of(default, inside, to)
        elif isinstance(default, Mapping):
            kind = get_args(kinds[field])[1]
            for key, each in default.items():
                entry = f"{inside}.{key.replace('_', '-')}"
                if dataclasses.is_dataclass(each):
                    yield from options_of(each, entry, (*to, key))
                else:
                    yield Option((*to, key), entry, kind, each, section)
        else:
            yield Option(to, inside, kinds[field], default, section)


def read(base: T | type[T], argv: list[str]) -> T:
    """Reads a command line.

    Args:
      base: dataclass of the options; an instance, or else the class, holds their defaults.
      argv: the command line without the program.

    Raises:
      OptionError: if an option is unknown, or an option or a value is missing.
      ConfigError: by the dataclass, for a value that is wrong.
    """
    options = [*options_of(base)]
    values, rest = split(options, argv)
    for option in options:
        if not option.name.startswith("-") and rest and not _is_option(rest[0]):
            number = 1 if option.words[1] is None else len(rest)
            values[option.path], rest = option.value(rest[:number]), rest[number:]
        elif option.default is dataclasses.MISSING and not rest:
            what = option.help[:1].lower() + option.help[1:].rstrip(".")
            raise OptionError(f"missing argument {option.name}: {what}")
    if rest:
        raise OptionError(_unknown(rest, [option.name for option in options]))
    kind = base if isinstance(base, type) else type(base)
    plain: dict[str, Any] = {} if isinstance(base, type) else dataclasses.asdict(cast(Any, base))
    for path, value in values.items():
        plain = _changed(plain, path, value)
    return cast(T, _made(kind, plain))


def _changed(plain: Mapping[str, Any], path: Sequence[str], value: object) -> dict[str, Any]:
    """Nested dictionaries with another value at a path."""
    name, *rest = path
    return {**plain, name: _changed(plain.get(name, {}), rest, value) if rest else value}


def split(
    options: list[Option], argv: list[str]
) -> tuple[dict[tuple[str, ...], object], list[str]]:
    """The values on a command line by their paths, and the words that belong to no option.

    Raises:
      OptionError: if a value is missing.
    """
    named = {option.name: option for option in options}
    named |= {option.off: option for option in options if option.kind is bool}
    values: dict[tuple[str, ...], object] = {}
    rest: list[str] = []
    words = [*argv]
    while words:
        word = words.pop(0)
        name, equals, text = word.partition("=")
        name = name.replace("_", "-") if name.startswith("--") else name  # also `--num_seeds`
        option = named.get(name) if _is_option(name) else None
        if option is None:
            rest.append(word)
        elif option.kind is bool:
            if equals:
                raise OptionError(f"argument {name}: ignored explicit argument '{_cut(text)}'")
            values[option.path] = name != option.off
        else:
            most = option.words[1] or 1
            given = [text] if equals else []
            while words and not equals and len(given) < most and not _is_option(words[0]):
                given.append(words.pop(0))
            if most not in (len(given), math.inf):
                expected = "one argument" if most == 1 else f"{most} arguments"
                raise OptionError(f"argument {name}: expected {expected}")
            values[option.path] = option.value(given)
    return values, rest


def _is_option(word: str) -> bool:
    """Whether a word begins with a dash and is no negative number."""
    return len(word) > 1 and word[0] == "-" and not re.fullmatch(r"-\d+|-\d*\.\d+", word)


def _of_type(kind: object, word: str) -> object:
    """A word as a number or a path, if it is one."""
    if kind is Path and word and word.isprintable():
        return Path(word)
    with contextlib.suppress(ValueError):
        return int(word) if kind is int else float(word) if kind is float else word
    return word


def _cut(word: str) -> str:
    word = word if word.isprintable() else repr(word)[1:-1]
    return word if len(word) <= _LONGEST else f"{word[:_LONGEST]}..."


def _unknown(words: list[str], names: list[str]) -> str:
    """The message about words that belong to no option."""
    word = next((word for word in words if word.startswith("-")), words[0])
    name = word.partition("=")[0]
    if not word.startswith("-"):
        return f"unexpected argument '{_cut(word)}': options start with --"
    near = _nearest(name[2:], [each[2:] for each in names if each.startswith("--")])
    hint = f"did you mean --{near[0]}?" if near else "see --help-all"
    return f"unknown option {_cut(name)}; {hint}"


def command(program: str) -> str:
    """The command line that runs a module such as "jaxsense.train" as this process was started."""
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
    width = max(shutil.get_terminal_size().columns - 2, 20)
    options = {option.name: option for option in options_of(base)}
    usage = [f"usage: {command(program)} [OPTIONS]"]
    usage += [_usage(each) for name, each in options.items() if not name.startswith("-")]
    lines = [" ".join(usage), "", *_filled(about(base), width)]
    place = None
    for option in (options[name] for name in common or options):
        inside = "" if common else getattr(option.section, "PLACE", "")
        if inside != place:
            lines += ["", f"{inside or 'options'}:"]
            lines += [*_filled(about(option.section), width, 2), ""] if inside else []
        place = inside
        lines += [f"  {option.name} {_metavar(option)}".rstrip(), *_filled(_text(option), width, 6)]
    if common:
        lines += ["", f"--help-all lists all {len(options)} options."]
    return "\n".join(lines)


def _filled(text: str, width: int, indent: int = 0) -> list[str]:
    """A text as indented lines, without backticks."""
    lines = textwrap.wrap(text.replace("`", ""), width - indent, break_on_hyphens=False)
    return [" " * indent + line for line in lines]


def _usage(option: Option) -> str:
    """A positional argument as a usage line shows it."""
    several = f"{option.name} ..." if option.words[1] else option.name
    return several if option.default is dataclasses.MISSING else f"[{several}]"


def _metavar(option: Option) -> str:
    """Placeholder in the help for the words of a value."""
    kind, number = option.words
    if kind is bool or not option.name.startswith("-"):
        return ""
    names: dict[object, str] = {int: "INT", float: "NUMBER", Path: "PATH"}
    one = names.get(kind, "NAME")
    if get_origin(kind) is Literal:
        one = f"{{{','.join(get_args(kind))}}}"
    return f"[{one} ...]" if number == math.inf else " ".join([one] * int(number or 1))


def _text(option: Option) -> str:
    """An option's description and default value."""
    value = option.default
    if value is True:
        return f"{option.help} (default: on; {option.off} turns it off)"
    if value in (None, (), dataclasses.MISSING) or value is False:
        return option.help
    words = shlex.join(map(str, value)) if isinstance(value, tuple) else value
    return f"{option.help} (default: {words})"


def about(section: object) -> str:
    """Description of a dataclass in its docstring, without that of its fields."""
    return " ".join((section.__doc__ or "").partition("Attributes:")[0].split())


def docs(section: type) -> dict[str, str]:
    """Descriptions of the fields of a dataclass in its docstring, each as one line."""
    _, _, attributes = inspect.cleandoc(section.__doc__ or "").partition("Attributes:\n")
    _, *parts = re.split(r"^  (\w+): ", attributes, flags=re.MULTILINE)
    texts = (" ".join(text.split()) for text in parts[1::2])
    return dict(zip(parts[::2], texts, strict=True))

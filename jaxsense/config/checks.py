"""Checks of a new section, and the error of a failed check."""

import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_MOST_SHOWN = 200  # characters of a value
_LEAST, _MOST = 1e-30, 1e30  # a product of two still fits float32
_WITHIN = {"travel": "team.", "tours": "team."}  # sections that are part of another


class ConfigError(ValueError):
    """An invalid setting: `field = value: what would be right`."""

    def __init__(self, field: str, value: object, expected: str):
        super().__init__(f"{field} = {_shown(value)}: {expected}")
        self.expected = expected


def require(condition: bool, section: object, field: str, expected: str) -> None:
    """Raises `ConfigError` for a field of a section unless the condition holds."""
    if not condition:
        # All settings together, and the options of a program, have no name before their fields.
        name = type(section).__name__.removesuffix("Config").removesuffix("Arguments").lower()
        place = f"{_WITHIN.get(name, '')}{name}.{field}".lstrip(".")
        raise ConfigError(place, getattr(section, field), expected)


def require_types(section: Any, bits: int = 31) -> None:
    """Raises `ConfigError` unless each field has its declared type.

    Whole numbers in real fields become real, because JAX distinguishes them.

    Args:
      section: the dataclass.
      bits: most bits of a whole number; real numbers must be finite and fit 32 bits.
    """
    hints = get_type_hints(type(section))
    for name, kind in hints.items():
        value = getattr(section, name)
        require(_is_a(value, kind), section, name, f"must be {_described(kind)}")
        is_small = kind is not int or abs(value) < 2**bits
        require(is_small, section, name, f"must be below 2^{bits}")
        if kind is float:
            object.__setattr__(section, name, float(value))


def require_positive(section: object, *fields: str) -> None:
    """Raises `ConfigError` unless each field is greater than 0."""
    for field in fields:
        require(getattr(section, field) > 0, section, field, "must be a number greater than 0")


def require_not_negative(section: object, *fields: str) -> None:
    """Raises `ConfigError` unless each field is at least 0."""
    for field in fields:
        is_right = getattr(section, field) >= 0
        require(is_right, section, field, "must be a number that is not negative")


def require_at_most(section: object, **most: float) -> None:
    """Raises `ConfigError` for a field that exceeds its limit."""
    for field, limit in most.items():
        require(getattr(section, field) <= limit, section, field, f"must be at most {limit:,}")


def require_sizes(section: object, field: str) -> None:
    """Raises `ConfigError` unless a field holds layer sizes."""
    sizes = getattr(section, field)
    require(
        len(sizes) > 0 and all(size > 0 for size in sizes),
        section,
        field,
        "must be one or more layer sizes, each greater than 0",
    )


def require_window(section, num_rays: int) -> None:
    """Raises `ConfigError` unless a sensor's window fits its rays."""
    require_positive(section, "window", "stride")
    require_at_most(section, stride=num_rays)
    most = (num_rays - 1) // section.stride + 1
    require(
        section.window <= most,
        section,
        "window",
        f"at most {most} of {num_rays} rays fit with a stride of {section.stride}",
    )


def _is_a(value: Any, kind: Any) -> bool:
    """Whether a value is of a field's declared type."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return any(type(value) is type(each) and value == each for each in inner)
    if origin in (Union, types.UnionType):
        return any(_is_a(value, each) for each in inner)
    if origin in (tuple, dict):
        return isinstance(value, origin) and _holds(value, inner)
    if kind in (int, float):
        return _is_number(value, kind)
    return isinstance(value, kind)


def _holds(values: Any, kinds: tuple[Any, ...]) -> bool:
    """Whether the items of a tuple or a dictionary are of their declared types."""
    if isinstance(values, dict):
        return all(_holds(pair, kinds) for pair in values.items())
    kinds = kinds[:1] * len(values) if ... in kinds else kinds
    return len(values) == len(kinds) and all(map(_is_a, values, kinds))


def _is_number(value: Any, kind: Any) -> bool:
    """Whether a value is a whole number, or a real one that 32 bits can hold."""
    if isinstance(value, bool) or not isinstance(value, int if kind is int else int | float):
        return False
    return kind is int or value == 0 or _LEAST <= abs(value) <= _MOST


def _described(kind: Any, *, many: bool = False) -> str:
    """Description of a declared type, after "must be"."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin in (Union, types.UnionType):
        return " or ".join(_described(each) for each in inner)
    if origin is tuple:
        number = "" if ... in inner else f"{len(inner)} "
        return f"{'tuples' if many else 'a tuple'} of {number}{_described(inner[0], many=True)}"
    if origin is dict:
        return f"a dictionary from names to {_described(inner[1], many=True)}"
    sizes = f"of a size from {_LEAST} to {_MOST} or 0"
    one, several = {
        int: ("a whole number", "whole numbers"),
        float: (f"a finite number, {sizes}", f"finite numbers, {sizes}"),
        bool: ("True or False", "True or False"),
        str: ("text", "texts"),
        Path: ("a path of printable characters", "paths of printable characters"),
        types.NoneType: ("None", "None"),
    }.get(kind, (f"of type {kind.__name__}", f"values of type {kind.__name__}"))
    return several if many else one


def _shown(value: object) -> str:
    """A value in one short line."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # of more than 4300 digits or a thousand levels
        return f"a huge {type(value).__name__}"
    text = " ".join(line.strip() for line in text.splitlines())
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."

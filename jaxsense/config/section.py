"""Sections of the settings: frozen dataclasses that check their fields, and are pytrees.

Numbers that only enter the arithmetic are leaves, inputs of a compiled program; everything that
shapes a program is structure. Settings from Python, JSON and command lines pass one check.
"""

import contextlib
import dataclasses
import functools
import importlib
import inspect
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NoReturn,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import jax
from jax.core import Tracer

from jaxsense.core.types import register

T = TypeVar("T")
K = TypeVar("K")
V = TypeVar("V")

_LEAF = "leaf"
Traced = Annotated[T, _LEAF]
"""A setting that only enters the arithmetic: a number, or a JAX array, traced or not."""

_MAX_SHOWN = 200  # characters of a value
_SMALLEST, _LARGEST = 1e-30, 1e30  # a product of two still fits float32


class ConfigError(ValueError):
    """Raised for an invalid setting; its message is `field = value: what would be right`."""

    def __init__(self, field: str, value: object, expected: str):
        text = f"{field} = {_shown(value)}: {expected}"
        # It may quote a file, whose control characters a terminal would obey.
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))
        self.expected = expected

    def __reduce__(self):
        return type(self).__new__, (type(self), *self.args), self.__dict__


class FrozenDict(dict[K, V]):
    """A dictionary that cannot be changed. Its order counts: equal ones have the same order."""

    def __eq__(self, other: object) -> bool:
        if isinstance(other, FrozenDict):
            return tuple(self.items()) == tuple(other.items())
        return dict.__eq__(self, other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return hash(tuple(self.items()))

    def __reduce__(self):
        return type(self), (dict(self),)

    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise TypeError("settings are immutable; use dataclasses.replace")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = _refuse
    setdefault = update = _refuse  # pyright: ignore[reportAssignmentType]


class _Unknown:
    """A traced number: what it is compared with is right, what is computed from it unknown."""

    def _unknown(self, *_: object) -> "_Unknown":
        return self

    __lt__ = __le__ = __gt__ = __ge__ = _unknown
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _unknown
    __truediv__ = __rtruediv__ = __mod__ = __neg__ = __abs__ = __round__ = _unknown

    def __format__(self, spec: str) -> str:
        return "a traced number"


_UNKNOWN = _Unknown()


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of each number in a field, and of its number of items; None where there is none."""

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None
    min_items: int | None = None
    max_items: int | None = None

    def expected(self, value: object) -> str:
        """What would be right for a field with a value."""
        words = {
            "greater than": self.above,
            "at least": self.at_least,
            "below": self.below,
            "at most": self.at_most,
        }
        limits = " and ".join(f"{each} {x:,}" for each, x in words.items() if x is not None)
        if self.at_least is not None and self.at_most is not None:
            limits = f"from {self.at_least:,} to {self.at_most:,}"
        if self.min_items is not None:
            most = "or more" if self.max_items is None else f"to {self.max_items}"
            return f"must have {self.min_items} {most} values" + (limits and f", each {limits}")
        return f"must each be {limits}" if isinstance(value, tuple) else f"must be {limits}"

    def allow(self, value: object) -> bool:
        """Whether all numbers of a value, and their number, are within the limits."""
        if isinstance(value, tuple):
            most = len(value) if self.max_items is None else self.max_items
            return (self.min_items or 0) <= len(value) <= most and all(map(self.allow, value))
        return not isinstance(value, int | float) or (
            (self.above is None or value > self.above)
            and (self.at_least is None or value >= self.at_least)
            and (self.below is None or value < self.below)
            and (self.at_most is None or value <= self.at_most)
        )


def limited(default: T, **limits: float) -> T:
    """Declares a field with limits, which hold for each number in a tuple or a dictionary.

    Args:
      default: the field's default value.
      **limits: `above`, `at_least`, `below`, `at_most`; of a tuple's length `min_items` and
        `max_items`.
    """
    return cast(T, dataclasses.field(default=default, metadata={"limits": Limits(**limits)}))  # pyright: ignore[reportArgumentType]


def require(condition: object, section: object, field: str, expected: str) -> None:
    """Raises a `ConfigError` about a field of a dataclass unless a condition holds."""
    if not condition:
        raise ConfigError(_place(section, field), getattr(section, field), expected)


def check_fields(section: object, bits: int = 31) -> None:
    """Checks the type and the limits of all fields of a dataclass.

    Values take their declared form: whole numbers become real where the type is `float`, lists
    become tuples, and dictionaries become immutable.

    Args:
      section: the dataclass, possibly frozen.
      bits: all whole numbers are below `2**bits`. Real numbers must be finite and fit 32 bits.

    Raises:
      ConfigError: names the first invalid field.
    """
    for name, kind, limits in _fields(type(section)):
        value, place = getattr(section, name), _place(section, name)
        try:
            value = _converted(value, kind)
        except TypeError:
            raise ConfigError(place, value, f"must be {_described(kind)}") from None
        object.__setattr__(section, name, value)
        numbers = value if isinstance(value, tuple) else (value,)
        fits = all(abs(each) < 2**bits for each in numbers if isinstance(each, int))
        require(fits, section, name, f"must be below 2^{bits}")
        parts = {place: value}
        if isinstance(value, FrozenDict):
            parts = {f"{place}.{n}": x for n, x in value.items()}
        for each, x in parts.items():
            if limits is not None and not limits.allow(x):
                raise ConfigError(each, x, limits.expected(x))


@dataclass_transform(frozen_default=True)
class Checked:
    """Base of frozen dataclasses that check their fields when they are made.

    A subclass states its name as in `class LidarConfig(Section, place="lidar")`, which error
    messages show before the name of a field.
    """

    PLACE: ClassVar[str] = ""

    def __init_subclass__(cls, place: str = "") -> None:
        cls.PLACE = place
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self):
        check_fields(self)
        self.check()

    def check(self) -> None:
        """Checks relations between fields; raises `ConfigError`."""


class Section(Checked):
    """Base of the sections: a pytree whose leaves are the fields declared `Traced`, and sections.

    A traced value passes its own checks, and relations with other fields.
    """

    _LEAVES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, place: str = "") -> None:
        super().__init_subclass__(place)
        hints = get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls)]
        cls._LEAVES = tuple(name for name in names if _is_leaf(hints[name]))
        register(cls, cls._LEAVES, [name for name in names if name not in cls._LEAVES])

    def __post_init__(self):
        known = _known(self)
        check_fields(known)
        known.check()
        for name, value in vars(self).items():
            if not any(isinstance(x, jax.Array | jax.ShapeDtypeStruct) for x in _leaves(value)):
                object.__setattr__(self, name, getattr(known, name))


_leaves = jax.tree.leaves


def _is_leaf(kind: object) -> bool:
    """Whether a field holds leaves: it is declared `Traced` or is a section."""
    is_section = isinstance(kind, type) and issubclass(kind, Section)
    return is_section or _LEAF in getattr(kind, "__metadata__", ())


def _known(value: Any) -> Any:
    """A value of the settings, with numbers for scalar arrays and `_UNKNOWN` for traced ones."""
    if isinstance(value, Section):
        known = object.__new__(type(value))
        vars(known).update(
            {n: _known(x) if n in value._LEAVES else x for n, x in vars(value).items()}
        )
        return known
    if isinstance(value, tuple):
        return tuple(map(_known, value))
    if isinstance(value, jax.Array) and not isinstance(value, Tracer) and value.size == 1:
        return value.item()
    return _UNKNOWN if isinstance(value, jax.Array | jax.ShapeDtypeStruct) else value


def require_function(field: str, value: object, number: int, expected: str) -> None:
    """Checks that a value can be called with a number of positional arguments, without calling it.

    Raises:
      ConfigError: about the field, if it cannot, as far as Python can tell.
    """
    if not callable(value):
        raise ConfigError(field, value, expected)
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*range(number))
    except TypeError:
        raise ConfigError(field, value, expected) from None


def is_function_name(path: str) -> bool:
    """Whether a text can name a function, as `package.module:function`."""
    module, _, function = path.partition(":")
    return function.isidentifier() and all(part.isidentifier() for part in module.split("."))


def named_function(field: str, path: str) -> Callable[..., object]:
    """Imports the function `package.module:function` that a field names.

    Raises:
      ConfigError: if it cannot be imported.
    """
    module, _, function = path.partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        reason = f"must be a function that can be imported ({error})"
        raise ConfigError(field, path, reason) from None


def require_32_bits() -> None:
    """Raises a `ConfigError` if JAX computes in 64 bits, which jaxsense does not support."""
    if jax.config.read("jax_enable_x64"):
        raise ConfigError("JAX_ENABLE_X64", True, "must be off, as jaxsense computes in 32 bits")


def _place(section: object, field: str) -> str:
    """Name of a field, with its section."""
    return f"{getattr(section, 'PLACE', '')}.{field}".lstrip(".")


@functools.cache
def _fields(cls: type) -> list[tuple[str, object, Limits | None]]:
    """Name, type and limits of each field of a dataclass."""
    hints = get_type_hints(cls)
    return [(f.name, hints[f.name], f.metadata.get("limits")) for f in dataclasses.fields(cls)]


def _converted(value: object, kind: object) -> object:
    """A value in its declared form; raises `TypeError` if it is of another type."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        for each in inner:
            with contextlib.suppress(TypeError):
                return _converted(value, each)
    elif origin is tuple and isinstance(value, tuple | list):
        kinds = inner[:1] * len(value) if ... in inner else inner
        if len(kinds) == len(value):
            return tuple(map(_converted, value, kinds))
    elif origin is Mapping and isinstance(value, Mapping):
        return FrozenDict({n: _converted(x, inner[1]) for n, x in _texts(value).items()})
    elif origin is Literal and any(type(value) is type(n) and value == n for n in inner):
        return value
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if value == 0 or _SMALLEST <= abs(value) <= _LARGEST:
            return float(value)
    elif (value is _UNKNOWN and origin is None) or (
        isinstance(kind, type) and isinstance(value, kind) and (kind, type(value)) != (int, bool)
    ):
        return value
    raise TypeError


def _texts(value: Mapping) -> Mapping:
    """A dictionary whose keys are text; raises `TypeError` if they are not."""
    if all(isinstance(name, str) for name in value):
        return value
    raise TypeError


_SIZES = f"0 or of magnitude {_SMALLEST} to {_LARGEST}"
_ONE_AND_MANY: dict[object, tuple[str, str]] = {
    int: ("a whole number", "whole numbers"),
    float: (f"a number, {_SIZES}", f"numbers, each {_SIZES}"),
    bool: ("True or False", "True or False"),
    str: ("text", "texts"),
    Path: ("a path of printable characters", "paths of printable characters"),
    types.NoneType: ("None", "None"),
}


def _described(kind: object, *, many: bool = False) -> str:
    """Description of a declared type, after "must be"."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin in (Union, types.UnionType):
        return " or ".join(map(_described, inner))
    if origin is tuple:
        number = "" if ... in inner else f"{len(inner)} "
        return f"{'lists' if many else 'a list'} of {number}{_described(inner[0], many=True)}"
    if origin is Mapping:
        return f"a dictionary from names to {_described(inner[1], many=True)}"
    name = getattr(kind, "__name__", str(kind))
    return _ONE_AND_MANY.get(kind, (f"of type {name}", f"values of type {name}"))[many]


def _shown(value: object) -> str:
    """A value in one short line; a function by its name."""
    while isinstance(value, functools.partial):
        value = value.func
    if callable(value):
        return getattr(value, "__name__", type(value).__name__)
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # a thousand levels, or more than 4300 digits
        return f"a huge {type(value).__name__}"
    text = " ".join(line.strip() for line in text.splitlines())
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."

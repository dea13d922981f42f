"""Sections of the settings: frozen dataclasses that check their fields, and are pytrees.

Numbers that only enter the arithmetic are leaves, inputs of a compiled program; everything that
shapes a program is structure. Settings from Python, JSON and command lines pass one check.
"""

import contextlib
import dataclasses
import functools
import inspect
import math
import pkgutil
import types
from collections.abc import Callable, Iterable, Mapping
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

from jaxsense.core.checks import shown
from jaxsense.core.types import register

T = TypeVar("T")
K = TypeVar("K")
V = TypeVar("V")

_LEAF = "leaf"
Traced = Annotated[T, _LEAF]
"""A setting that only enters the arithmetic: a number, or a JAX array, traced or not."""


class ConfigError(ValueError):
    """Raised for an invalid setting; its message is `field = value: what would be right`."""

    def __init__(self, field: str, value: object, expected: str):
        text = f"{field} = {shown(value)}: {expected}"
        # It may quote a file, whose control characters a terminal would obey.
        super().__init__("".join(c if c.isprintable() else repr(c)[1:-1] for c in text))

    def __reduce__(self):
        return type(self).__new__, (type(self), *self.args)


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


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of each number in a field, and of its number of items."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf
    at_most: float = math.inf
    min_items: int = 0
    max_items: float = math.inf

    def __str__(self) -> str:
        """Limits of a number, such as "from 0 to 1"; empty without any."""
        if math.isfinite(self.at_least) and math.isfinite(self.at_most):
            return f"from {self.at_least:,} to {self.at_most:,}"
        words = {
            "greater than": self.above,
            "at least": self.at_least,
            "below": self.below,
            "at most": self.at_most,
        }
        return " and ".join(f"{each} {x:,}" for each, x in words.items() if math.isfinite(x))

    def allow(self, number: float, *, is_whole: bool) -> bool:
        """Whether a number is within the limits, and fits 32 bits."""
        is_large = 2**31 <= self.at_most < math.inf
        is_inside = self.above < number < self.below and self.at_least <= number <= self.at_most
        return is_inside and (is_large or _fits(number, is_whole=is_whole))


def _fits(number: float, *, is_whole: bool) -> bool:
    """Whether 32 bits hold a number, and the product of two that are not whole."""
    if is_whole:
        return abs(number) < 2**31
    return number == 0 or 1e-30 <= abs(number) <= 1e30


def _beyond_32_bits(value: object) -> str:
    """What else numbers must be that 32 bits do not hold."""
    numbers = [x for x in jax.tree.leaves(value) if isinstance(x, int | float)]
    whole = all(_fits(x, is_whole=True) for x in numbers if isinstance(x, int))
    real = all(_fits(x, is_whole=False) for x in numbers if isinstance(x, float))
    return ", below 2^31" * (not whole) + ", 0 or of magnitude 1e-30 to 1e+30" * (not real)


def limited(default: T, **limits: float) -> T:
    """Declares a field with limits, which hold for each number in a tuple or a dictionary.

    Args:
      default: the field's default value.
      **limits: `above`, `at_least`, `below`, `at_most`; of a tuple's length `min_items` and
        `max_items`.
    """
    return cast(T, dataclasses.field(default=default, metadata={"limits": Limits(**limits)}))  # pyright: ignore[reportArgumentType]


def require(condition: object, section: "Checked", field: str, expected: str) -> None:
    """Raises a `ConfigError` about a field of a dataclass unless a condition holds."""
    if not condition:
        raise _error(section, field, expected)


def _error(section: "Checked", field: str, expected: str) -> ConfigError:
    return ConfigError(f"{section.PLACE}.{field}".lstrip("."), getattr(section, field), expected)


def require_known(field: str, value: object, known: Iterable[str]) -> None:
    """Raises a `ConfigError` unless a value is one of the known names."""
    if value not in (names := [*known]):
        raise ConfigError(field, value, f"must be one of {', '.join(names)}")


@functools.cache
def fields_of(cls: type) -> list[tuple[str, Any, Limits, tuple[str, ...]]]:
    """Name, type, limits and marks, such as that of `Traced`, of each field of a dataclass."""
    kinds, marked = get_type_hints(cls), get_type_hints(cls, include_extras=True)
    limits = {f.name: f.metadata.get("limits", Limits()) for f in dataclasses.fields(cls)}
    marks = {name: getattr(marked[name], "__metadata__", ()) for name in limits}
    return [(name, kinds[name], limits[name], marks[name]) for name in limits]


def _converted(value: object, kind: object, limits: Limits, is_leaf: bool = False) -> object:
    """A value in its declared form; raises `TypeError` if it is of another type or not allowed."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        for each in inner:
            with contextlib.suppress(TypeError):
                return _converted(value, each, limits, is_leaf)
    elif origin is tuple and isinstance(value, tuple | list):
        kinds = inner[:1] * len(value) if ... in inner else inner
        if len(kinds) == len(value) and limits.min_items <= len(value) <= limits.max_items:
            each = zip(value, kinds, strict=True)
            return tuple(_converted(x, of, limits, is_leaf) for x, of in each)
    elif origin is Mapping and isinstance(value, Mapping):
        if all(isinstance(name, str) for name in value):
            return FrozenDict({n: _converted(x, inner[1], limits) for n, x in value.items()})
    elif origin is None:
        return _scalar(value, cast(type, kind), limits, is_leaf)
    elif origin is Literal and any(type(value) is type(x) and value == x for x in inner):
        return value
    raise TypeError


def _scalar(value: object, kind: type, limits: Limits, is_leaf: bool) -> object:
    """A value of a class, as `_converted`."""
    if is_leaf and (number := _number(value)) is not value:
        if not isinstance(number, _Unknown):
            _scalar(number, kind, limits, is_leaf=False)
        return value
    if kind in (int, float):
        # A whole number is real, and no truth value is a number.
        is_right = type(value) is int or (kind is float and isinstance(value, float))
        if is_right and limits.allow(number := cast(float, value), is_whole=kind is int):
            return kind(number)
    elif isinstance(value, kind):
        return value
    raise TypeError


_WORDS: dict[object, str] = {
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    str: "text",
    Path: "a path of printable characters",
    types.NoneType: "None",
}


def described(kind: object, limits: Limits) -> str:
    """Description of a declared type and its limits, after "must be"."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if origin in (Union, types.UnionType):
        return " or ".join(described(each, limits) for each in inner)
    if origin is tuple:
        number = "" if ... in inner else f"{len(inner)} "
        if limits.min_items:
            most = "or more" if limits.max_items == math.inf else f"to {limits.max_items}"
            number = f"{limits.min_items} {most} "
        return f"a list of {number}values, each {described(inner[0], limits)}"
    if origin is Mapping:
        return f"a dictionary from names to values, each {described(inner[1], limits)}"
    words = _WORDS.get(kind, f"of type {getattr(kind, '__name__', kind)}")
    range_ = str(limits) if kind in (int, float) else ""
    return f"{words}, {range_}" if range_ else words


@dataclass_transform(frozen_default=True)
class Checked:
    """Base of frozen dataclasses that check their fields when they are made.

    Values take their declared form: whole numbers become real where the type is `float`, lists
    become tuples, and dictionaries become immutable. A subclass states its name as in
    `class LidarConfig(Section, place="lidar")`, which error messages show before the name of a
    field.
    """

    PLACE: ClassVar[str] = ""

    def __init_subclass__(cls, place: str = "") -> None:
        cls.PLACE = place
        dataclasses.dataclass(frozen=True)(cls)

    def __post_init__(self):
        for name, kind, limits, marks in fields_of(type(self)):
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, _converted(value, kind, limits, _LEAF in marks))
            except TypeError:
                expected = f"must be {described(kind, limits)}{_beyond_32_bits(value)}"
                raise _error(self, name, expected) from None
        jax.tree.map(_number, self).check()

    def check(self) -> None:
        """Checks relations between fields; raises `ConfigError`."""


class Section(Checked):
    """Base of the sections: a pytree whose leaves are the fields declared `Traced`, and sections.

    A leaf that JAX traces, and a batch, pass the checks of their relations with other fields.
    """

    LEAVES: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, place: str = "") -> None:
        super().__init_subclass__(place)
        is_leaf = {
            name: _LEAF in marks or (isinstance(kind, type) and issubclass(kind, Section))
            for name, kind, _, marks in fields_of(cls)
        }
        cls.LEAVES = tuple(name for name in is_leaf if is_leaf[name])
        register(cls, cls.LEAVES, [name for name in is_leaf if not is_leaf[name]])


class _Unknown:
    """A traced number: all comparisons hold, all results are unknown."""

    def _unknown(self, *_: object) -> "_Unknown":
        return self

    __lt__ = __le__ = __gt__ = __ge__ = _unknown
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _unknown
    __truediv__ = __rtruediv__ = __mod__ = __neg__ = __abs__ = __round__ = _unknown

    def __format__(self, spec: str) -> str:
        return "a traced number"


def _number(leaf: Any) -> Any:
    """The number in an array of one; `_Unknown` of a traced array or a batch."""
    if not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct):
        return leaf
    is_known = leaf.size == 1 and not isinstance(leaf, Tracer | jax.ShapeDtypeStruct)
    return cast(jax.Array, leaf).item() if is_known else _Unknown()


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
    try:
        return pkgutil.resolve_name(path)
    except (ImportError, AttributeError, ValueError) as error:
        reason = f"must be a function that can be imported ({error})"
        raise ConfigError(field, path, reason) from None


def require_32_bits() -> None:
    """Raises a `ConfigError` if JAX computes in 64 bits, which jaxsense does not support."""
    if jax.config.read("jax_enable_x64"):
        raise ConfigError("JAX_ENABLE_X64", True, "must be off, as jaxsense computes in 32 bits")

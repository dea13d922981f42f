"""What is checked when a section is made, and the error of a check that fails."""

import dataclasses
import math
from typing import Any, Literal, get_args, get_origin


class ConfigError(ValueError):
    """A setting that cannot be used: `field = value: what would be right`."""

    def __init__(self, field: str, value: object, expected: str):
        super().__init__(f"{field} = {value!r}: {expected}")


def require(condition: bool, section: object, field: str, expected: str) -> None:
    """Raises `ConfigError` for a field of a section unless the condition holds."""
    if not condition:
        name = type(section).__name__.removesuffix("Config").lower()
        raise ConfigError(f"{name}.{field}", getattr(section, field), expected)


def require_positive(section: object, *fields: str) -> None:
    """Raises `ConfigError` unless each field is finite and greater than 0."""
    for field in fields:
        value = getattr(section, field)
        require(
            math.isfinite(value) and value > 0, section, field, "must be a number greater than 0"
        )


def require_not_negative(section: object, *fields: str) -> None:
    """Raises `ConfigError` unless each field is finite and at least 0."""
    for field in fields:
        value = getattr(section, field)
        require(
            math.isfinite(value) and value >= 0,
            section,
            field,
            "must be a number that is not negative",
        )


def require_choices(section: Any) -> None:
    """Raises `ConfigError` unless each field of a `Literal` type holds one of its values."""
    for field in dataclasses.fields(section):
        if get_origin(field.type) is Literal:
            choices = get_args(field.type)
            is_one = getattr(section, field.name) in choices
            require(is_one, section, field.name, f"must be one of {', '.join(choices)}")


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
    most = (num_rays - 1) // section.stride + 1
    require(
        section.window <= most,
        section,
        "window",
        f"at most {most} of {num_rays} rays fit with a stride of {section.stride}",
    )

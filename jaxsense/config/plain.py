"""Reading settings back from plain data."""

import dataclasses
import typing
from typing import Any


def from_plain(kind: Any, stored: Any) -> Any:
    """The inverse of `dataclasses.asdict`, through JSON, by the types of the fields.

    Args:
      kind: dataclass, or type of one of its fields.
      stored: dictionary of the fields, of which those not given keep their defaults, or a value.

    Raises:
      TypeError: if there is no such field, or one without a default is missing.
      AttributeError: if a dataclass or a dictionary is stored as something else.
    """
    if dataclasses.is_dataclass(kind):
        types = typing.get_type_hints(kind)
        return kind(**{k: from_plain(types.get(k), v) for k, v in stored.items()})  # pyright: ignore
    if typing.get_origin(kind) is dict:
        of_value = typing.get_args(kind)[1]
        return {k: from_plain(of_value, v) for k, v in stored.items()}
    return tuple(stored) if isinstance(stored, list) else stored

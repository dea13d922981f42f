"""How far exported programs are from ours, at moments of missions."""

import dataclasses
import io
from collections.abc import Callable

import jax
import numpy as np
from moments import Choice, Inputs

from jaxsense import Config, Models
from jaxsense.interfaces import robot
from jaxsense.interfaces.onboard import Function, functions

_CLOSED, _TINY = 1e5, 1e-3  # above any value of an open action; scale of an output of about 0
Arrays = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Compared:
    """A program and ours.

    Attributes:
      states: how many.
      different: in how many of them a whole number or a bool is another one.
      error: largest difference of real numbers as a share of the scale, see `relative_error`.
    """

    states: int
    different: int
    error: float


def compare(
    config: Config, models: Models, archive: bytes, found: list[Choice]
) -> dict[str, Compared]:
    """Compares all programs that a mission plays, by name.

    Args:
      config: settings of the run.
      models: its models.
      archive: from `export.archive`.
      found: moments of missions.

    Raises:
      AssertionError: if the choices of our own function are not those of the missions.
    """
    ours = functions(config)
    given = _given(config, models, ours, found)
    expected = {
        name: [
            jax.tree.map(np.asarray, apply(models, *(x[key] for key in ours[name].inputs)))
            for x in inputs
        ]
        for name, inputs in given.items()
        for apply in [jax.jit(ours[name].apply)]
    }
    actions = [int(each["action"]) for each in expected["decide"]]
    assert actions == [int(choice.action) for choice in found]
    return {
        name: _compared(program, given[name], expected[name])
        for name, program in robot.load(io.BytesIO(archive))[1].items()
        if name in given
    }


def _given(
    config: Config, models: Models, ours: dict[str, Function], found: list[Choice]
) -> dict[str, list[Inputs]]:
    """Inputs of each program in the states."""
    given: dict[str, list[Inputs]] = {"decide": [choice.inputs for choice in found]}
    given["classify"] = [{key: x[key] for key in ("mean", "std")} for x in given["decide"]]
    detect = {name: jax.jit(f.apply) for name, f in ours.items() if name.startswith("detect")}
    weigh = {name: jax.jit(f.apply) for name, f in ours.items() if name.startswith("weigh")}
    for choice in found:
        x = choice.inputs
        robot, poi = int(x["robot"]), int(choice.poi)
        m = int(x["modality"][robot])
        sensor = config.modalities[m]
        look = {key: getattr(choice, key) for key in ("readings", "bearing", "distance")}
        apart = np.linalg.norm(x["poses"][robot, None, :2] - x["looked_from"][poi, m], axis=-1)
        features = detect[f"detect_{sensor}"](models, *look.values())["features"]
        weight = weigh[f"weigh_{sensor}"](models, apart)["weight"]
        new = {"features": np.asarray(features), "weight": np.asarray(weight)}
        of_sensor = {"detect": look, "weigh": {"apart": apart}}
        if choice.sums is None:
            belief = {"mean": x["mean"][poi], "std": x["std"][poi]}
            of_sensor["write"] = {**belief, "seen": choice.seen[poi], **new}
        else:
            of_sensor["tell"] = new
            given.setdefault("merge", []).append({"sums": choice.sums})
        for name, inputs in of_sensor.items():
            given.setdefault(f"{name}_{sensor}", []).append(inputs)
    return given


def _compared(
    program: Callable[..., Arrays], given: list[Inputs], expected: list[Arrays]
) -> Compared:
    theirs = [program(**inputs) for inputs in given]
    is_other, error = np.zeros(len(given), bool), 0.0
    for key, first in expected[0].items():
        ours, found = (np.stack([each[key] for each in both]) for both in (expected, theirs))
        if first.dtype == np.float32:
            error = max(error, relative_error(found, ours))
        else:
            is_other |= (found != ours).reshape(len(given), -1).any(axis=1)
    return Compared(len(given), int(is_other.sum()), error)


def relative_error(theirs: np.ndarray, ours: np.ndarray) -> float:
    """Largest difference as a share of the scale of an output, its maximum magnitude.

    Numbers of 1e5 and more, or infinite, say that an action is not open: they are not compared, but
    must be the same ones.

    Args:
      theirs: of all states.
      ours: of the same shape.

    Returns:
      The share; infinite if other actions are open.
    """
    is_value = np.abs(ours) < _CLOSED
    if not np.array_equal(is_value, np.abs(theirs) < _CLOSED):
        return np.inf
    scale = np.abs(ours[is_value]).max(initial=_TINY)
    return float(np.abs(theirs[is_value] - ours[is_value]).max(initial=0.0) / scale)

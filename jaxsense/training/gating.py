"""What a detector and its gate are trained on, and the problem of fitting both together."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsense.config import DetectorConfig, ViewpointConfig
from jaxsense.core.networks import Params
from jaxsense.core.types import Key, pytree
from jaxsense.sim.sensors import Sensor
from jaxsense.vae import detectors
from jaxsense.vae import gate as gates
from jaxsense.vae.gate import Gate

NUM_CHECKS = 8192
"""The most looks of each kind that set a gate's threshold."""
_SPOILT_EACH = 512  # windows of each kind that are spoilt by hand
_ELSEWHERE = 0.5, 2.0  # of the distance, outside of which a PoI is not where it is expected


@pytree
class Examples:
    """What a detector and its gate are trained on.

    The windows of the looks at PoIs stay in the surveys, since they fill a lot of memory.

    Attributes:
      labels: `[L]` int32 labels of the looks at PoIs.
      distances: `[L]` expected distances of the PoIs, in metres.
      nothing: looks that show no PoI, in random order.
      checks: other looks at PoIs, for the gate's threshold.
    """

    labels: Int[Array, " L"]
    distances: Float[Array, " L"]
    nothing: gates.Looks
    checks: gates.Looks


def first(examples: Examples, number: int) -> Examples:
    """The examples with a number of looks at PoIs; the others may calibrate the detector.

    Args:
      examples: of one modality.
      number: of looks; static.
    """
    return dataclasses.replace(
        examples,
        labels=examples.labels[:number],
        distances=examples.distances[:number],
    )


def nothing(
    key: Key, viewpoint: ViewpointConfig, sensor: Sensor, shown: gates.Looks, empty: gates.Looks
) -> gates.Looks:
    """Looks that show no PoI, in random order: empty ones, and others that are spoilt by hand.

    A window of a PoI shows none if most of its readings are lost, if all are equal, or if the PoI
    is expected at another distance.

    Args:
      key: random key.
      viewpoint: the distances at which robots expect PoIs.
      sensor: the sensor.
      shown: looks at PoIs.
      empty: looks at nothing.
    """
    shown = jax.tree.map(lambda x: x[:_SPOILT_EACH], shown)
    lost_key, share_key, level_key, distance_key, order_key = jax.random.split(key, 5)
    windows, distances = shown.windows, shown.distances
    number = windows.shape[:1]
    blind = jnp.minimum(sensor.blind, sensor.window_limit)
    share = jax.random.uniform(share_key, (*number, 1), minval=0.6)
    lost = jax.random.uniform(lost_key, windows.shape) < share
    levels = jax.random.uniform(level_key, (*number, 1)) * jnp.max(windows)
    is_zero, is_blind = (jnp.arange(number[0])[:, None] % 4 == i for i in (0, 1))
    levels = jnp.where(is_zero, 0.0, jnp.where(is_blind, blind, levels))
    near, far = viewpoint.min_distance, viewpoint.max_distance
    expected = jax.random.uniform(distance_key, number, minval=near, maxval=far)
    ratio = expected / distances
    is_elsewhere = (ratio < _ELSEWHERE[0]) | (ratio > _ELSEWHERE[1])
    parts = [
        empty,
        gates.Looks(jnp.where(lost, blind, windows), distances),
        gates.Looks(jnp.broadcast_to(levels, windows.shape), distances),
        # Where it is expected about right, an empty window instead.
        gates.Looks(jnp.where(is_elsewhere[:, None], windows, blind), expected),
    ]
    together = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    order = jax.random.permutation(order_key, len(together.windows))
    return jax.tree.map(lambda x: x[order], together)


def of_gate(
    config: DetectorConfig, gate: Gate, examples: Examples, windows: Float[Array, "L F"]
) -> gates.Fitting:
    """Problem of fitting a gate, without the looks of `checks_of`.

    Args:
      config: of the fit.
      gate: untrained.
      examples: of one modality.
      windows: of the looks at PoIs.
    """
    shown = gates.Looks(windows, examples.distances)
    nothing = jax.tree.map(lambda x: x[_num_checks(examples) :], examples.nothing)
    return gates.Fitting(config, gate, shown, nothing)


def checks_of(config: DetectorConfig, gate: Gate, examples: Examples) -> gates.Fitting:
    """The same problem with other looks, which set the gate's threshold, see `gates.fitted`.

    Args:
      config: of the fit.
      gate: untrained.
      examples: of one modality.
    """
    nothing = jax.tree.map(lambda x: x[: _num_checks(examples)], examples.nothing)
    return gates.Fitting(config, gate, examples.checks, nothing)


def _num_checks(examples: Examples) -> int:
    """How many looks at nothing help to set the gate's threshold; the others train the gate."""
    return min(len(examples.nothing.windows) // 4, NUM_CHECKS)


@pytree
class FittingBoth:
    """Problem of fitting a detector and its gate together, two networks that share nothing.

    Attributes:
      detector: problem of fitting the detector.
      gate: problem of fitting the gate.
    """

    detector: detectors.Fitting
    gate: gates.Fitting

    @property
    def config(self) -> DetectorConfig:
        """Settings of the fit."""
        return self.detector.config

    def draw(self, key: Key, number: int) -> tuple[jax.Array, jax.Array]:
        """Draws the rows of both, see `Problem.draw`.

        Args:
          key: random key.
          number: of steps; static.
        """
        detector_key, gate_key = jax.random.split(key)
        return self.detector.draw(detector_key, number), self.gate.draw(gate_key, number)

    def loss(
        self,
        params: tuple[Params, Params],
        drawn: tuple[jax.Array, jax.Array],
        step: Int[Array, ""],
    ) -> Float[Array, ""]:
        """Sum of both losses.

        Args:
          params: of the detector's network, and of the gate's.
          drawn: rows for the detector, and for the gate.
          step: of the fit.
        """
        of_detector = self.detector.loss(params[0], drawn[0], step)
        return of_detector + self.gate.loss(params[1], drawn[1], step)

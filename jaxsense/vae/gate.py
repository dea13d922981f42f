"""The gate of a detector: whether a window shows its PoI at all."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import DetectorConfig
from jaxsense.core import checks, networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Key, pytree

_NETWORK = MLP((32, 16), 1)
_DEPTH = 0.2  # m, about the size of a PoI
_MAX_DEPTHS = 2.5
_MAX_LOST = 0.01  # share of the looks at PoIs
_MAX_PASSED = 0.002  # share of the looks at nothing, if few looks at PoIs are lost for it


@pytree
class Gate:
    """A network that tells windows that show their PoI from those that do not.

    Attributes:
      params: of the network.
      threshold: `[]` minimum output of the network for a window to pass; minus infinity before the
        training, so that all valid windows pass.
      offset: `[F]` mean of the windows for training.
      scale: `[]` overall standard deviation of these windows.
      measures_distance: whether the readings are distances in metres; the network then reads how
        far they are from the expected distance.
    """

    params: Params
    threshold: Float[Array, ""]
    offset: Float[Array, " F"]
    scale: Float[Array, ""]
    measures_distance: bool = struct.field(pytree_node=False)


def init(
    key: Key, offset: Float[Array, " F"], scale: Float[Array, ""], measures_distance: bool
) -> Gate:
    """Untrained gate, which every valid window passes.

    Args:
      key: random key.
      offset: mean of the windows for training.
      scale: overall standard deviation of these windows.
      measures_distance: whether the readings are distances in metres.
    """
    params = networks.init(key, _NETWORK, len(offset) + 2)
    return Gate(params, jnp.float32(-jnp.inf), offset, scale, measures_distance)


def logits(
    gate: Gate, windows: Float[Array, "F *B"], distances: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Log-odds that windows show their PoIs, if half of all windows did.

    Args:
      gate: of the sensor.
      windows: `[F]`, or `[F, B]`.
      distances: expected distances of the PoIs' centres, in metres.
    """
    if gate.measures_distance:
        read = jnp.clip((windows - distances[None]) / _DEPTH, -_MAX_DEPTHS, _MAX_DEPTHS)
    else:
        read = (windows - gate.offset.reshape(-1, *[1] * distances.ndim)) / gate.scale
    expected = jnp.stack([distances, 1 / distances])
    return networks.apply(_NETWORK, gate.params, jnp.concatenate([read, expected]))[0]


def is_valid(window: Float[Array, " F"], distance: Float[Array, ""]) -> Bool[Array, ""]:
    """Tells whether a gate can judge a window: all numbers are finite, the distance is above 0.

    Args:
      window: `[F]` readings around the PoI's bearing, see `sim.windows.as_window`.
      distance: expected distance of the PoI's centre, in metres.
    """
    checks.require_shape("distance", distance, ())
    return jnp.isfinite(window).all() & jnp.isfinite(distance) & (distance > 0)


@pytree
class Looks:
    """Windows, and where each expects its PoI.

    Attributes:
      windows: `[S, F]`.
      distances: `[S]` expected distances of the PoIs' centres, in metres.
    """

    windows: Float[Array, "S F"]
    distances: Float[Array, " S"]


@pytree
class Fitting:
    """Problem of fitting a gate, with the binary cross-entropy as loss.

    Attributes:
      config: batch, learning rate and steps.
      gate: from `init`.
      shown: looks at PoIs.
      nothing: looks that show no PoI.
    """

    config: DetectorConfig
    gate: Gate
    shown: Looks
    nothing: Looks

    def draw(self, key: Key, number: int) -> Int[Array, "{number} 2 B"]:
        """Draws rows of looks at PoIs and of looks at nothing, half a batch of each.

        Args:
          key: random key.
          number: of steps; static.
        """
        rows = jnp.array([len(self.shown.windows), len(self.nothing.windows)])
        shape = number, 2, -(-self.config.batch // 2)
        return jax.random.randint(key, shape, 0, rows[None, :, None])

    def loss(
        self, params: Params, drawn: Int[Array, "2 B"], step: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Mean binary cross-entropy of a batch.

        Args:
          params: of the network.
          drawn: `[2, B]` rows of looks at PoIs and of looks at nothing.
          step: not used.
        """
        del step
        shown = jax.tree.map(lambda x: x[drawn[0]], self.shown)
        nothing = jax.tree.map(lambda x: x[drawn[1]], self.nothing)
        both = jax.tree.map(lambda *x: jnp.concatenate(x), shown, nothing)
        found = logits(_with(self.gate, params), both.windows.T, both.distances)
        sign = jnp.repeat(jnp.array([-1.0, 1.0]), drawn.shape[1])
        return jax.nn.softplus(sign * found).mean()


def fitted(params: Params, problem: Fitting) -> Gate:
    """Gate whose threshold loses few looks at PoIs, and no more than it needs to.

    Args:
      params: of the trained network.
      problem: like that of the training, with looks that it was not trained on.
    """
    gate = _with(problem.gate, params)
    shown, nothing = (
        logits(gate, looks.windows.T, looks.distances) for looks in (problem.shown, problem.nothing)
    )
    most, enough = jnp.quantile(shown, _MAX_LOST), jnp.quantile(nothing, 1 - _MAX_PASSED)
    return dataclasses.replace(gate, threshold=jnp.minimum(most, enough))


def _with(gate: Gate, params: Params) -> Gate:
    """The gate with other parameters."""
    return dataclasses.replace(gate, params=params)

"""The gate of a detector: whether a window shows its PoI at all."""

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import DetectorConfig
from jaxsense.core import networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Key, pytree

_NETWORK = MLP((32, 16), 1)
_MAX_LOST = 0.01  # share of the looks at PoIs
_MAX_PASSED = 0.002  # share of the looks at nothing, if few looks at PoIs are lost for it


@pytree
class Gate:
    """A network that tells windows that show their PoI from those that do not.

    Attributes:
      params: of the network.
      threshold: `[]` minimum output of the network for a window to pass; minus infinity before the
        training, so that all valid windows pass.
    """

    params: Params
    threshold: Float[Array, ""]


def init(key: Key, num_readings: int) -> Gate:
    """Untrained gate, which every valid window passes.

    Args:
      key: random key.
      num_readings: F, the size of a window.
    """
    return Gate(networks.init(key, _NETWORK, num_readings + 2), jnp.float32(-jnp.inf))


def logits(
    params: Params, standard: Float[Array, "F *B"], distance: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Log-odds that windows show their PoIs.

    Args:
      params: of the network.
      standard: `[F]` standardised window, or `[F, B]`.
      distance: expected distances of the PoIs' centres, in metres.
    """
    expected = jnp.stack([distance, 1 / distance])
    return networks.apply(_NETWORK, params, jnp.concatenate([standard, expected]))[0]


def passes(gate: Gate, standard: Float[Array, " F"], distance: Float[Array, ""]) -> Bool[Array, ""]:
    """Tells whether a window shows its PoI.

    Args:
      gate: of the sensor.
      standard: `[F]` standardised window.
      distance: expected distance of the PoI's centre, in metres.

    Returns:
      False if it shows something else, or a number is not finite or the distance not above 0.
    """
    chex.assert_rank(distance, 0, custom_message="distance")
    is_valid = jnp.isfinite(standard).all() & jnp.isfinite(distance) & (distance > 0)
    return is_valid & (logits(gate.params, standard, distance) >= gate.threshold)


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
      offset: `[F]` mean of the windows, see `Detector`.
      scale: `[]` their standard deviation.
      shown: looks at PoIs.
      nothing: looks that show no PoI.
    """

    config: DetectorConfig
    offset: Float[Array, " F"]
    scale: Float[Array, ""]
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
        standard = (both.windows - self.offset[None]) / self.scale
        found = logits(params, standard.T, both.distances)
        sign = jnp.repeat(jnp.array([-1.0, 1.0]), drawn.shape[1])
        return jax.nn.softplus(sign * found).mean()


def fitted(params: Params, problem: Fitting) -> Gate:
    """Gate whose threshold loses few looks at PoIs, and no more than it needs to.

    Args:
      params: of the trained network.
      problem: like that of the training, with looks that it was not trained on.
    """

    def scores(looks: Looks) -> Float[Array, " S"]:
        standard = (looks.windows - problem.offset[None]) / problem.scale
        return logits(params, standard.T, looks.distances)

    most = jnp.quantile(scores(problem.shown), _MAX_LOST)
    enough = jnp.quantile(scores(problem.nothing), 1 - _MAX_PASSED)
    return Gate(params, jnp.minimum(most, enough))

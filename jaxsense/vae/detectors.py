"""The scanline detectors f_x and f_w: what one sensor sees of a point of interest."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxsense.config import DetectorConfig
from jaxsense.core import networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Key, pytree

_MAX_TEMPERATURE = 4.0


@pytree
class Detector:
    """A trained detector.

    Attributes:
      params: of its network.
      offset: `[F]` mean of the windows it was trained on.
      scale: `[]` their overall standard deviation.
      hidden: sizes of the hidden layers.
      num_labels: number of labels, D_m.
    """

    params: Params
    offset: jax.Array
    scale: jax.Array
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    num_labels: int = struct.field(pytree_node=False)


def init(key: Key, windows: jax.Array, num_labels: int, config: DetectorConfig) -> Detector:
    """Untrained detector, standardised to the `[S, F]` windows of its training."""
    chex.assert_rank(windows, 2, custom_message="windows")
    params = networks.init(key, MLP(config.hidden, num_labels), windows.shape[1])
    offset = jnp.mean(windows, axis=0)
    scale = jnp.std(windows - offset[None]) + 1e-6
    return Detector(params, offset, scale, config.hidden, num_labels)


def logits(detector: Detector, window: jax.Array) -> jax.Array:
    """Unnormalised log-probabilities of the labels, `[D_m]`, from one `[F]` window."""
    chex.assert_shape(window, detector.offset.shape, custom_message="window")
    standard = (window - detector.offset) / detector.scale
    return networks.apply(_network(detector), detector.params, standard)


def detect(detector: Detector, window: jax.Array) -> jax.Array:
    """Features of one look.

    Args:
      detector: a trained detector.
      window: `[F]` readings around the PoI's bearing, see `sim.sensors.as_window`.

    Returns:
      `[D_m]` probabilities of the labels, for example (red, green).
    """
    return jax.nn.softmax(logits(detector, window))


@pytree
class Fitting:
    """The fit of a detector to labelled windows: the cross-entropy of its labels.

    Attributes:
      config: batch, learning rate and steps.
      detector: from `init`.
      windows: `[S, F]` windows of simulated scans.
      labels: `[S]` int32.
    """

    config: DetectorConfig
    detector: Detector
    windows: jax.Array
    labels: jax.Array

    def draw(self, key: Key, number: int) -> jax.Array:
        """Rows of the windows for `number` steps, see `supervised.Problem.draw`."""
        shape = number, self.config.batch
        return jax.random.randint(key, shape, 0, self.windows.shape[0])

    def loss(self, params: Params, drawn: jax.Array, step: jax.Array) -> jax.Array:
        """`[]` mean cross-entropy of a batch."""
        del step
        detector = self.detector
        standard = (self.windows[drawn] - detector.offset[None]) / detector.scale
        predicted = networks.apply(_network(detector), params, standard.T)
        cross_entropy = optax.softmax_cross_entropy_with_integer_labels
        return cross_entropy(predicted, self.labels[drawn], 0).mean()


def calibrate(detector: Detector, windows: jax.Array, labels: jax.Array) -> Detector:
    """Divides logits by the temperature that suits other looks best (Guo et al. 2017, Sec. 4.2).

    Args:
      detector: a trained detector.
      windows: `[S, F]` looks that it was not trained on.
      labels: `[S]` int32.

    Returns:
      The detector whose probabilities make these labels most likely.
    """
    chex.assert_equal_shape_prefix([windows, labels], 1)
    standard = (windows - detector.offset[None]) / detector.scale
    predicted = networks.apply(_network(detector), detector.params, standard.T)

    def loss(sharpness: jax.Array) -> jax.Array:
        scaled = sharpness * predicted
        return optax.softmax_cross_entropy_with_integer_labels(scaled, labels, 0).mean()

    each = jnp.geomspace(1 / _MAX_TEMPERATURE, _MAX_TEMPERATURE, 257)
    best = each[jnp.argmin(jax.lax.map(loss, each))]
    layers = dict(detector.params["params"])
    last = f"Dense_{len(detector.hidden)}"
    layers[last] = jax.tree.map(lambda x: best * x, layers[last])
    return dataclasses.replace(detector, params={**detector.params, "params": layers})


def _network(detector: Detector) -> MLP:
    return MLP(detector.hidden, detector.num_labels)

"""The scanline detectors f_x and f_w: from one sensor's window to features, through a gate."""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import DetectorConfig
from jaxsense.core import checks, networks, supervised
from jaxsense.core.networks import MLP, Params
from jaxsense.core.types import Key, product, pytree
from jaxsense.vae import calibration
from jaxsense.vae import gate as gates
from jaxsense.vae.gate import Gate

_NEVER = -1e9  # log-odds of what is no candidate; finite, so that there may be none
_MIN_PROBABILITY = 1e-9  # whose logarithm counts


class Detector(Protocol):
    """Protocol of a sensor's detector, which maps windows to features; a frozen pytree."""

    @property
    def gate(self) -> Gate:
        """Tells which windows show a PoI."""
        ...

    @property
    def num_labels(self) -> int:
        """D_m, the number of labels."""
        ...

    def features(self, window: Float[Array, " F"]) -> Float[Array, " D_m"]:
        """Probabilities of the labels, for a window that shows its PoI.

        Args:
          window: `[F]` readings around the PoI's bearing, see `sim.windows.as_window`.
        """
        ...


@pytree
class Classifier:
    """A detector that learns from labelled windows.

    Attributes:
      params: of its network.
      offset: `[F]` mean of the windows for training.
      scale: `[]` overall standard deviation of these windows.
      hidden: sizes of the hidden layers.
      gate: tells which windows show a PoI.
      num_labels: D_m, the number of labels.
    """

    params: Params
    offset: Float[Array, " F"]
    scale: Float[Array, ""]
    gate: Gate
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    num_labels: int = struct.field(pytree_node=False)

    def features(self, window: Float[Array, " F"]) -> Float[Array, " D_m"]:
        """See `Detector.features`."""
        return jax.nn.softmax(logits(self, window))


def init(
    key: Key,
    windows: Float[Array, "S F"],
    num_labels: int,
    config: DetectorConfig,
    measures_distance: bool = False,
) -> Classifier:
    """Untrained detector.

    Args:
      key: random key.
      windows: `[S, F]` windows for training, whose statistics standardise its input.
      num_labels: D_m.
      config: sizes of the network.
      measures_distance: whether the readings are distances, see `Gate`.
    """
    checks.require_shape("windows", windows, (None, None))
    network_key, gate_key = jax.random.split(key)
    params = networks.init(network_key, MLP(config.hidden, num_labels), windows.shape[1])
    offset, scale = networks.statistics(windows)
    gate = gates.init(gate_key, offset, scale, measures_distance)
    return Classifier(params, offset, scale, gate, config.hidden, num_labels)


@pytree
class Detection:
    """Result of a look: whether the PoI is there, and its features.

    Attributes:
      is_known: `[]` whether the detector can judge the look: all readings of a window are there,
        and, from `Models.detect`, it has learned from looks like this one, see `sim.Domain`.
      is_there: `[]` whether the window shows its PoI; False of a look that is not known.
      features: `[D_m]` probabilities of the labels, all equal if it does not.
    """

    is_known: Bool[Array, ""]
    is_there: Bool[Array, ""]
    features: Float[Array, " D_m"]


def logits(detector: Classifier, window: Float[Array, " F"]) -> Float[Array, " D_m"]:
    """Unnormalised log-probabilities of the labels.

    Args:
      detector: of the sensor.
      window: `[F]`.
    """
    return networks.apply(_network(detector), detector.params, _standard(detector, window))


@checks.typed
def detect(detector: Detector, window: Float[Array, " F"]) -> Float[Array, " D_m"]:
    """Computes the features of a look that shows its PoI; `answer` also checks that it does.

    Args:
      detector: of the sensor.
      window: `[F]` readings around the PoI's bearing, see `sim.windows.as_window`.

    Returns:
      `[D_m]` probabilities of the labels, for example (red, green).
    """
    return detector.features(window)


@checks.typed
def answer(detector: Detector, window: Float[Array, " F"], distance: Float[Array, ""]) -> Detection:
    """Evaluates a look: whether the window shows its PoI, and the features.

    Args:
      detector: of the sensor.
      window: `[F]` readings around the PoI's bearing, see `sim.windows.as_window`.
      distance: expected distance of the PoI's centre, in metres.
    """
    is_known = gates.is_valid(window, distance)
    is_there = is_known & (gates.logits(detector.gate, window, distance) >= detector.gate.threshold)
    features = jnp.where(is_there, detect(detector, window), 1 / detector.num_labels)
    return Detection(is_known, is_there, features)


def search(
    detector: Detector,
    windows: Float[Array, "K F"],
    distances: Float[Array, " J"],
    log_prior: Float[Array, "J K"],
) -> Detection:
    """What a look says that shows its PoI in one of several windows, at one of several distances.

    The PoI is there if the gate's mean odds reach its threshold: of many windows that show nothing,
    the best one would pass too often. The features are the logarithmic pool of all windows (Genest
    and Zidek 1986), weighted by their posterior, from the prior and the gate: windows next to the
    best one show the PoI nearly as well, and their mean is less noisy than a single one.

    Args:
      detector: of the sensor.
      windows: `[K, F]`, of which those with a reading that is not finite count for nothing.
      distances: `[J]` expected distances of the PoI's centre, in metres.
      log_prior: `[J, K]` logarithm of the prior, up to a constant; minus infinity for what is not
        to be considered.
    """
    checks.require_shape("log_prior", log_prior, (len(distances), len(windows)))
    is_valid = jnp.isfinite(windows).all(axis=1)
    given = jnp.where(is_valid[:, None], windows, 0.0)
    is_distance = jnp.isfinite(distances) & (distances > 0)
    may_be = is_valid[None] & is_distance[:, None] & jnp.isfinite(log_prior)
    found = jax.vmap(lambda at: gates.logits(detector.gate, given.T, jnp.full(len(given), at)))(
        jnp.where(is_distance, distances, 1.0)
    )
    prior = jax.nn.log_softmax(jnp.where(may_be, log_prior, _NEVER).reshape(-1))
    odds = jnp.where(may_be.reshape(-1), found.reshape(-1) + prior, _NEVER)
    is_known = jnp.any(may_be)
    is_there = is_known & (jax.nn.logsumexp(odds) >= detector.gate.threshold)
    share = jax.nn.softmax(odds).reshape(may_be.shape).sum(axis=0)
    logs = jnp.log(jnp.maximum(jax.vmap(detector.features)(given), _MIN_PROBABILITY))
    pooled = jax.nn.softmax(product(share, logs))
    return Detection(is_known, is_there, jnp.where(is_there, pooled, 1 / detector.num_labels))


def _standard(detector: Classifier, window: Float[Array, " F"]) -> Float[Array, " F"]:
    """A window standardised by those of the training."""
    checks.require_shape("window", window, detector.offset.shape)
    return (window - detector.offset) / detector.scale


@pytree
class Fitting:
    """Problem of fitting a detector to labelled windows, with the cross-entropy as loss.

    Attributes:
      config: batch, learning rate and steps.
      detector: from `init`.
      windows: `[S, F]` windows of simulated scans.
      labels: `[S]` int32 true labels.
    """

    config: DetectorConfig
    detector: Classifier
    windows: Float[Array, "S F"]
    labels: Int[Array, " S"]

    def draw(self, key: Key, number: int) -> Int[Array, "{number} B"]:
        """Draws rows of the windows.

        Args:
          key: random key.
          number: of steps; static.
        """
        shape = number, self.config.batch
        return jax.random.randint(key, shape, 0, self.windows.shape[0])

    def loss(
        self, params: Params, drawn: Int[Array, " B"], step: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Mean cross-entropy of a batch.

        Args:
          params: of the network.
          drawn: `[B]` rows of the windows.
          step: not used.
        """
        del step
        detector = self.detector
        standard = (self.windows[drawn] - detector.offset[None]) / detector.scale
        predicted = networks.apply(_network(detector), params, standard.T)
        cross_entropy = optax.softmax_cross_entropy_with_integer_labels
        return cross_entropy(predicted, self.labels[drawn], 0).mean()


RETRAINING = DetectorConfig(steps=600, batch=64, learning_rate=3e-4, calibration=0.25)
"""Settings of `retrain`."""


def retrain(
    key: Key,
    detector: Classifier,
    windows: Float[Array, "S F"],
    labels: Int[Array, " S"],
    config: DetectorConfig = RETRAINING,
) -> Classifier:
    """Fine-tunes a detector on other windows, for example 200 recorded ones.

    Few windows may replace what many have taught. So the parameters move from the old ones towards
    the new ones (as in Wortsman et al. 2022) as far as that helps with windows kept from training.

    Args:
      key: random key.
      detector: a trained detector.
      windows: `[S, F]` windows that show PoIs, see `sim.cut_out`, in random order.
      labels: `[S]` int32 their labels.
      config: batch, learning rate, steps, and the share of windows to keep, `calibration`; static.

    Returns:
      The detector with other parameters; its gate is the same. Inside `jit`, which raises no error,
      all parameters are NaN if the training or its windows are not finite.

    Raises:
      TypeError: if the detector is an encoder of scans, which learns without labels.
      ValueError: if windows are not finite, a label is none of the detector's, the training
        diverges, or `config.calibration` leaves no window to train with, or none to judge by.
    """
    checks.require_key(key)
    if not isinstance(detector, Classifier):
        kind = type(detector).__name__
        raise TypeError(f"detector is a {kind}; must be a Classifier, which learns from labels")
    windows, labels = jnp.asarray(windows), jnp.asarray(labels)
    checks.require_shape("windows", windows, (None, len(detector.offset)))
    checks.require_finite("windows", windows, "must be finite; leave out what was not recorded")
    checks.require_shape("labels", labels, (len(windows),))
    checks.require_index("labels", labels, detector.num_labels)
    number = config.num_training(len(labels))
    if not 0 < number < len(labels):
        expected = f"must leave some of {len(labels)} windows to train with, and some to judge by"
        raise ValueError(f"config.calibration = {config.calibration}: {expected}")
    problem = Fitting(config, detector, windows[:number], labels[:number])
    fit, _ = supervised.fit(key, supervised.start(detector.params, config), problem, config.steps)
    kept = jnp.arange(number, len(labels))
    judge = Fitting(config, detector, windows, labels)

    def moved(share: jax.Array) -> Params:
        return jax.tree.map(lambda old, new: old + share * (new - old), detector.params, fit.params)

    shares = jnp.linspace(0.0, 1.0, 21)
    losses = jax.lax.map(lambda share: judge.loss(moved(share), kept, fit.step), shares)
    checks.require_finite("loss of retrained detectors", losses, "must be finite; retrain slower")
    best = jnp.where(jnp.isfinite(losses).all(), shares[jnp.argmin(losses)], jnp.nan)
    return dataclasses.replace(detector, params=moved(best))


def calibrate(
    detector: Classifier, windows: Float[Array, "S F"], labels: Int[Array, " S"]
) -> Classifier:
    """Divides logits by the best temperature for other looks (Guo et al. 2017, Sec. 4.2).

    Args:
      detector: a trained detector.
      windows: `[S, F]` that the detector was not trained on.
      labels: `[S]` int32 true labels.

    Returns:
      The detector whose probabilities make these labels most likely.
    """
    checks.require_shape("labels", labels, (len(windows),))
    standard = (windows - detector.offset[None]) / detector.scale
    predicted = networks.apply(_network(detector), detector.params, standard.T)
    best = calibration.sharpness(predicted, labels)
    params = networks.scale_last(_network(detector), detector.params, best)
    return dataclasses.replace(detector, params=params)


def _network(detector: Classifier) -> MLP:
    """The network of a detector."""
    return MLP(detector.hidden, detector.num_labels)

"""The scanline detectors f_x and f_w: from a window of a scan to a label, or "nothing there"."""

import dataclasses
from collections.abc import Callable
from typing import Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxsense.config import DetectorConfig
from jaxsense.core import checks, networks, supervised
from jaxsense.core.networks import MLP, Params
from jaxsense.core.supervised import Problem
from jaxsense.core.types import Key, product, pytree

_NEVER = -1e9  # log-odds of what is no candidate; finite, so that there may be none
_MIN_PROBABILITY = 1e-9  # whose logarithm counts in a search
_DEPTH = 0.2  # m, about the size of a PoI
_MAX_DEPTHS = 2.5
_MAX_LOST = 0.01  # share of the looks at PoIs
_MAX_PASSED = 0.002  # share of the looks at nothing, if few looks at PoIs are lost for it
_FACTORS = np.geomspace(1 / 16, 16, 513, dtype=np.float32)  # on logits, that are tried
_Rows = tuple[Int[Array, "... B"], Int[Array, "... C"]]


class Detector(Protocol):
    """Protocol of a sensor's detector; a frozen pytree."""

    @property
    def num_labels(self) -> int:
        """D_m, without "nothing there"."""
        ...

    @property
    def window_size(self) -> int:
        """F, numbers in a window."""
        ...

    @property
    def threshold(self) -> Float[Array, ""]:
        """Minimum log-odds that the PoI is there, for an answer with a label."""
        ...

    def logits(self, window: Float[Array, " F"], distance: Float[Array, ""]) -> Float[Array, " O"]:
        """Logits of the labels and, last, log-odds that the PoI is there.

        Args:
          window: readings around the PoI's bearing, see `sim.windows.as_window`.
          distance: expected distance of the PoI's centre, in metres.
        """
        ...


@pytree
class Detection:
    """Result of a look: whether the PoI is there, and its features.

    Attributes:
      is_known: `[]` whether the detector can judge the look: all readings of a window are there,
        and, from `Models.detect`, it has learned from looks like this, see `sim.windows.Domain`.
      is_there: `[]` whether the window shows its PoI; False of a look that is not known.
      features: `[D_m]` probabilities of the labels, all equal if it does not.
    """

    is_known: Bool[Array, ""]
    is_there: Bool[Array, ""]
    features: Float[Array, " D_m"]


@pytree
class Looks:
    """Windows, and the distance at which each expects the centre of its PoI, in metres."""

    windows: Float[Array, "S F"]
    distances: Float[Array, " S"]


def log_probabilities(logits: Float[Array, "O *B"]) -> Float[Array, "O *B"]:
    """Log-probabilities of labels and, last, of "nothing there", if half of all looks show nothing.

    A hierarchical softmax (Morin and Bengio 2005): the log-odds that the PoI is there do not depend
    on its label, and each level has a temperature of its own.
    """
    labels, odds = jax.nn.log_softmax(logits[:-1], axis=0), logits[-1:]
    return jnp.concatenate([labels + jax.nn.log_sigmoid(odds), jax.nn.log_sigmoid(-odds)])


@checks.typed
def features(
    detector: Detector, window: Float[Array, " F"], distance: Float[Array, ""]
) -> Float[Array, " D_m"]:
    """Probabilities of the labels in a look that shows its PoI, for example (red, green)."""
    checks.require_shape("window", window, (detector.window_size,))
    return jax.nn.softmax(detector.logits(window, distance)[:-1])


@checks.typed
def detect(detector: Detector, window: Float[Array, " F"], distance: Float[Array, ""]) -> Detection:
    """What a look says; `distance` is that of the PoI's centre, in metres."""
    checks.require_shape("window", window, (detector.window_size,))
    chex.assert_rank(distance, 0)
    found = detector.logits(window, distance)
    is_known = jnp.isfinite(window).all() & jnp.isfinite(distance) & (distance > 0)
    is_there = is_known & (found[-1] >= detector.threshold)
    of_labels = jnp.where(is_there, jax.nn.softmax(found[:-1]), 1 / detector.num_labels)
    return Detection(is_known, is_there, of_labels)


def search(
    detector: Detector,
    windows: Float[Array, "K F"],
    distances: Float[Array, " J"],
    log_prior: Float[Array, "J K"],
) -> Detection:
    """Detection from several candidate windows and distances, marginalised over both.

    The PoI is there if the mean odds reach the threshold: of many windows that show nothing, the
    best one would pass too often. The features are the logarithmic pool of all candidates (Genest
    and Zidek 1986), weighted by their posterior: windows next to the best one show the PoI nearly
    as well, and their mean is less noisy than a single one.

    Args:
      windows: those with a reading that is not finite count for nothing.
      distances: expected distances of the PoI's centre, in metres.
      log_prior: up to a constant; minus infinity for what is not to be considered.
    """
    chex.assert_shape(log_prior, (len(distances), len(windows)))
    is_valid, is_distance = jnp.isfinite(windows).all(axis=1), jnp.isfinite(distances)
    is_distance &= distances > 0
    may_be = (is_valid[None] & is_distance[:, None] & jnp.isfinite(log_prior)).reshape(-1)
    of_windows = jax.vmap(detector.logits, in_axes=(0, None), out_axes=-1)
    found = jax.vmap(of_windows, in_axes=(None, 0), out_axes=1)(
        jnp.where(is_valid[:, None], windows, 0.0), jnp.where(is_distance, distances, 1.0)
    ).reshape(detector.num_labels + 1, -1)
    prior = jax.nn.log_softmax(jnp.where(may_be, log_prior.reshape(-1), _NEVER))
    odds = jnp.where(may_be, found[-1] + prior, _NEVER)
    is_known = jnp.any(may_be)
    is_there = is_known & (jax.nn.logsumexp(odds) >= detector.threshold)
    logs = jnp.maximum(jax.nn.log_softmax(found[:-1], axis=0), jnp.log(_MIN_PROBABILITY))
    pooled = jax.nn.softmax(product(logs, jax.nn.softmax(odds)))
    return Detection(is_known, is_there, jnp.where(is_there, pooled, 1 / detector.num_labels))


@pytree
class Classifier:
    """A detector that learns from labelled windows, and from windows that show nothing.

    Its network outputs the logits of the labels, and last the log-odds that the PoI is there.

    Attributes:
      params: of its network.
      offset: `[F]` mean of the windows for training.
      scale: `[]` overall standard deviation of these windows.
      threshold: see `Detector`; the lowest number before the training.
      measures_distance: whether the readings are distances in metres; the network then also reads
        how far they are from the expected distance.
      hidden: sizes of the hidden layers.
      num_labels: D_m.
    """

    params: Params
    offset: Float[Array, " F"]
    scale: Float[Array, ""]
    threshold: Float[Array, ""]
    measures_distance: bool = struct.field(pytree_node=False)
    hidden: tuple[int, ...] = struct.field(pytree_node=False)
    num_labels: int = struct.field(pytree_node=False)

    @property
    def window_size(self) -> int:
        """F."""
        return len(self.offset)

    @property
    def network(self) -> MLP:
        """From what it reads in a look to its logits."""
        return MLP(self.hidden, self.num_labels + 1)

    def logits(
        self, window: Float[Array, "F *B"], distance: Float[Array, "*B"]
    ) -> Float[Array, "O *B"]:
        """See `Detector.logits`; also for looks in columns."""
        read = [(window - self.offset.reshape(-1, *[1] * distance.ndim)) / self.scale]
        if self.measures_distance:
            off = (window - distance[None]) / _DEPTH
            read.append(jnp.clip(off, -_MAX_DEPTHS, _MAX_DEPTHS))
        read.append(jnp.stack([distance, 1 / distance]))
        return networks.apply(self.network, self.params, jnp.concatenate(read))

    def of(self, looks: Looks) -> Float[Array, "O S"]:
        """Logits of many looks."""
        return self.logits(looks.windows.T, looks.distances)


def init(
    key: Key,
    windows: Float[Array, "S F"],
    num_labels: int,
    config: DetectorConfig,
    measures_distance: bool = False,
) -> Classifier:
    """Untrained detector, whose input is standardised by `windows` for training."""
    chex.assert_rank(windows, 2)
    offset, scale = networks.statistics(windows)
    numbers = (1 + measures_distance) * len(offset) + 2
    params = networks.init(key, MLP(config.hidden, num_labels + 1), numbers)
    threshold = jnp.float32(jnp.finfo(jnp.float32).min)
    return Classifier(
        params, offset, scale, threshold, measures_distance, config.hidden, num_labels
    )


def problem(
    config: DetectorConfig,
    detector: Classifier,
    shown: Looks,
    labels: Int[Array, " S"],
    nothing: Looks,
) -> Problem[_Rows]:
    """The fit of a detector to looks at PoIs and half as many at nothing.

    The loss is the mean cross-entropy of looks at PoIs, plus that of looks at nothing.

    Args:
      config: batch, of looks at PoIs, learning rate and steps.
      nothing: looks that show no PoI.
    """

    def draw(key: Key, number: int) -> _Rows:
        shown_key, nothing_key = jax.random.split(key)
        of_shown = jax.random.randint(shown_key, (number, config.batch), 0, len(labels))
        shape = number, -(-config.batch // 2)
        return of_shown, jax.random.randint(nothing_key, shape, 0, len(nothing.distances))

    def loss(params: Params, drawn: _Rows, step: Array) -> Float[Array, ""]:
        del step
        of_shown, of_nothing = drawn
        looks = jax.tree.map(
            lambda x, y: jnp.concatenate([x[of_shown], y[of_nothing]]), shown, nothing
        )
        of_looks = jnp.pad(labels[of_shown], (0, len(of_nothing)), constant_values=-1)
        found = log_probabilities(dataclasses.replace(detector, params=params).of(looks))
        cost = -jnp.take_along_axis(found, of_looks[None], axis=0)[0]
        return cost[: len(of_shown)].mean() + cost[len(of_shown) :].mean()

    return Problem(config.steps, config.learning_rate, draw, loss)


def fitted(detector: Classifier, shown: Looks, nothing: Looks) -> Classifier:
    """Sets the threshold and calibrates the odds with looks that training did not use.

    The threshold loses 1 % of the looks at PoIs, or fewer if that already rejects 99.8 % of those
    at nothing. Both kinds of looks count equally.
    """
    of_shown, of_nothing = detector.of(shown)[-1], detector.of(nothing)[-1]

    def loss(factor: Float[Array, ""]) -> Float[Array, ""]:
        lost, passed = (jax.nn.softplus(x) for x in (-factor * of_shown, factor * of_nothing))
        return lost.mean() + passed.mean()

    factor = _best_factor(loss)
    most, enough = jnp.quantile(of_shown, _MAX_LOST), jnp.quantile(of_nothing, 1 - _MAX_PASSED)
    scaled = _scaled(detector, jnp.ones(detector.num_labels + 1).at[-1].set(factor))
    return dataclasses.replace(scaled, threshold=factor * jnp.minimum(most, enough))


def calibrate(detector: Classifier, shown: Looks, labels: Int[Array, " S"]) -> Classifier:
    """Divides the labels' logits by the best temperature for looks that training did not use."""
    chex.assert_equal_shape([labels, shown.distances])
    best = sharpness(detector.of(shown)[:-1], labels)
    return _scaled(detector, jnp.full(detector.num_labels + 1, best).at[-1].set(1.0))


def _scaled(detector: Classifier, factors: Float[Array, " O"]) -> Classifier:
    """The detector with scaled outputs of its network."""
    params = networks.scale_last(detector.network, detector.params, factors)
    return dataclasses.replace(detector, params=params)


RETRAINING = DetectorConfig(steps=600, batch=64, learning_rate=3e-4, calibration=0.25)
"""Settings of `retrain`."""


@checks.typed
def retrain(
    key: Key,
    detector: Classifier,
    shown: Looks,
    labels: Int[Array, " S"],
    config: DetectorConfig = RETRAINING,
) -> Classifier:
    """Fine-tunes how a detector tells labels apart on other looks, for example 200 recorded ones.

    Few looks may replace what many have taught. So only the labels' outputs are trained, and move
    from the old parameters towards the new ones (as in Wortsman et al. 2022) as far as that helps
    with looks kept from training.

    Args:
      shown: looks at PoIs, see `sim.cut_out`, in random order.
      config: batch, learning rate, steps, and the share of looks to keep, `calibration`; static.

    Returns:
      The detector with other parameters, and the same log-odds that a PoI is there. Inside `jit`,
      which raises no error, the parameters are NaN if the training or its looks are not finite.

    Raises:
      ValueError: if the detector is an encoder of scans, which learns without labels, windows are
        not finite, a label is none of the detector's, the training diverges, or
        `config.calibration` leaves no look to train with, or none to judge by.
    """
    shown, labels = jax.tree.map(jnp.asarray, (shown, labels))
    checks.require_shape("windows", shown.windows, (None, detector.window_size))
    reason = "must be finite; leave out what was not recorded"
    checks.require_finite("windows", shown.windows, reason)
    chex.assert_shape([labels, shown.distances], (len(shown.windows),))
    checks.require_index("labels", labels, detector.num_labels)
    number = config.num_training(len(labels))
    if not 0 < number < len(labels):
        expected = f"must leave some of {len(labels)} looks to train with, and some to judge by"
        raise ValueError(f"config.calibration = {config.calibration}: {expected}")
    layers, last = detector.params["params"], f"Dense_{len(detector.hidden)}"

    def retrained(layer: Params) -> Classifier:
        return dataclasses.replace(detector, params={"params": {**layers, last: layer}})

    def draw(key: Key, steps: int) -> Int[Array, "T B"]:
        return jax.random.randint(key, (steps, config.batch), 0, number)

    def loss(layer: Params, rows: Int[Array, " B"], step: Array) -> Float[Array, ""]:
        del step
        found = retrained(layer).of(jax.tree.map(lambda x: x[rows], shown))[:-1]
        return _cross_entropy(found, labels[rows])

    problem = Problem(config.steps, config.learning_rate, draw, loss)
    start = supervised.start(layers[last], problem)
    fit, _ = supervised.fit(key, start, problem, config.steps)

    def moved(share: jax.Array) -> Params:
        return jax.tree.map(lambda old, new: old + share * (new - old), layers[last], fit.params)

    kept, shares = jnp.arange(number, len(labels)), jnp.linspace(0.0, 1.0, 21)
    losses = jax.lax.map(lambda share: loss(moved(share), kept, fit.step), shares)
    checks.require_finite("loss of retrained detectors", losses, "must be finite; retrain slower")
    best = jnp.where(jnp.isfinite(losses).all(), shares[jnp.argmin(losses)], jnp.nan)
    return retrained(moved(best))


def sharpness(logits: Float[Array, "L S"], labels: Int[Array, " S"]) -> Float[Array, ""]:
    """The factor on logits by which the labels are the most likely.

    Its inverse is the temperature of Guo et al. 2017, Sec. 4.2.
    """
    return _best_factor(lambda factor: _cross_entropy(factor * logits, labels))


def _cross_entropy(logits: Float[Array, "L S"], labels: Int[Array, " S"]) -> Float[Array, ""]:
    return optax.softmax_cross_entropy_with_integer_labels(logits, labels, 0).mean()


def _best_factor(loss: Callable[[Float[Array, ""]], Float[Array, ""]]) -> Float[Array, ""]:
    """The factor of the lowest loss, of 513 from 1/16 to 16."""
    return jnp.asarray(_FACTORS)[jnp.argmin(jax.lax.map(loss, jnp.asarray(_FACTORS)))]

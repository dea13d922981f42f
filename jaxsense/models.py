"""All trained networks of a run, as one pytree."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsense.config import Config
from jaxsense.config.mission import Search
from jaxsense.config.scene import MAX_BEARING
from jaxsense.core import checks, novelty
from jaxsense.core.networks import Params
from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief, Fusion, Key, pytree
from jaxsense.dqn import optimum, rewards
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.team import Travel
from jaxsense.sim import sensors, windows
from jaxsense.sim.sensors import Sensor
from jaxsense.sim.windows import Domain, make_domain
from jaxsense.vae import detectors, frames, fusion, jmvae, leave_one_out, readout
from jaxsense.vae.detectors import Classifier, Detection, Detector
from jaxsense.vae.frames import Chromaticity, Frame, Scaling
from jaxsense.vae.jmvae import Jmvae
from jaxsense.vae.leave_one_out import Encoder
from jaxsense.vae.readout import Bayes, Readout

_NO_SEARCH = Search()
_FEWEST_BEAMS = 3  # fewer show no profile
_STOPS_INSIDE = 0.02  # m, of the farthest view of a PoI
_UNSEEN_VARIANCE = 20.0  # of each latent dimension of the belief before any look


@pytree
class Models:
    """All trained networks of a run.

    Attributes:
      detectors: one for each modality.
      domains: for each modality, the looks that its detector has learned from.
      jmvae: parameters of the JMVAE.
      fusion: how looks update the map.
      bayes: the exact Bayes filter over classes, to compare with.
      novelty: how much of a look is new evidence.
      look_values: for each modality, the values of looks by dynamic programming.
      agent: how the Q-networks are used.
      q_networks: for each modality, parameters of the Q-network; of a team, one for all.
    """

    detectors: tuple[Detector, ...]
    domains: tuple[Domain, ...]
    jmvae: Params
    fusion: Fusion
    bayes: Bayes
    novelty: Novelty
    look_values: tuple[LookValues, ...]
    agent: Agent
    q_networks: tuple[Params, ...]

    def detect(
        self,
        modality: int,
        sensor: Sensor,
        readings: Float[Array | np.ndarray, "B ..."],
        bearing: Float[Array, ""],
        distance: Float[Array, ""],
        search: Search = _NO_SEARCH,
    ) -> Detection:
        """What a look says, from a whole scan.

        Unknown if distance, bearing or sensor are not as the detector has learned them, see
        `windows.Domain`, or if a reading of the window is negative, NaN or a brightness above 1. A
        distance that is infinite or 0, of a beam without a return, counts as `sensor.window_limit`.

        Args:
          modality: index of the sensor; static.
          readings: of all rays, see `sim.cut_out`.
          bearing: bearing of the PoI in the robot's frame, in radians, positive to the left; whole
            turns do not matter.
          distance: distance at which the PoI's centre is expected, in metres.
          search: largest errors of the robot's pose, within which other bearings and distances are
            tried, too; static. By default none are.

        Raises:
          ValueError: if there is no such modality, or readings have another shape.
        """
        checks.require_index("modality", modality, len(self.detectors))
        checks.require_shape(f"readings of {sensor.name}", readings, sensor.shape)
        bearing = windows.wrapped(jnp.asarray(bearing))
        of_window = windows.around(windows.widened(sensor, search), readings, bearing)
        return self.detect_in_window(modality, sensor, of_window, bearing, distance, search)

    def detect_in_window(
        self,
        modality: int,
        sensor: Sensor,
        readings: Float[Array, "W ..."],
        bearing: Float[Array, ""],
        distance: Float[Array, ""],
        search: Search = _NO_SEARCH,
    ) -> Detection:
        """What a look says, from the rays that the detector reads; otherwise as `detect`.

        `readings` are those of the window around the PoI's bearing; with a search, those of
        `sim.windows.widened`.
        """
        wide, bearing = windows.widened(sensor, search), windows.wrapped(bearing)
        window = windows.as_window(wide, jnp.where(sensor.is_valid(readings), readings, jnp.nan))
        detector, domain = self.detectors[modality], self.domains[modality]
        # What has not been learned is expected nowhere.
        expected = jnp.where(domain.contains(sensor, bearing, distance), distance, jnp.nan)
        if not search.applies:
            return detectors.detect(detector, window, expected)
        tried = windows.candidates(sensor, search, window, bearing, expected)
        return detectors.search(detector, *tried)

    def plausible_classes(self, belief: Belief) -> Bool[Array, " C"]:
        """Classes that are plausible given a belief, see `vae.readout`."""
        return readout.plausible_classes(belief, self.fusion.classes.mean)


@checks.typed
def require_fitting(config: Config, models: Models) -> None:
    """Raises `ValueError` if models are for other classes, or their fusion is no `Fusion`."""
    checks.require_members("models.fusion", models.fusion, Fusion)
    if jax.tree_util.all_leaves([models.fusion]):
        kind = type(models.fusion).__name__
        raise ValueError(f"models.fusion = {kind}: must be a pytree, its class under @pytree")
    expected = len(config.arena.classes), config.jmvae.latent_size
    found = models.fusion.classes.mean.shape
    if found != expected:
        reason = f"{expected[0]} in {expected[1]}, as in config; take both from one run"
        raise ValueError(
            f"models.fusion holds {found[0]} classes in {found[1]} dimensions: must be {reason}"
        )


@checks.typed
def make_jmvae(config: Config) -> Jmvae:
    """The shape of the JMVAE of a configuration: modalities and layer sizes."""
    sizes = tuple(len(config.labels(m)) for m in config.modalities)
    return Jmvae(config.modalities, sizes, config.jmvae.latent_size, config.jmvae.hidden)


def make_frame(config: Config, sensor: Sensor) -> Frame:
    """How a network that learns from scans sees the windows of a sensor."""
    if sensor.channels == 3:
        return Chromaticity()
    if not sensor.measures_distance or sensor.channels > 1 or sensor.window < _FEWEST_BEAMS:
        return Frame()
    span = (sensor.window - 1) * sensor.stride
    start = (len(sensor.angles) - 1 - span) // 2
    angles = sensor.angles[start : start + span + 1 : sensor.stride]
    # Near the edge of the field of view, a window ends at the last ray, off the PoI's bearing.
    margin = (np.ptp(sensor.angles) - np.ptp(angles)) / 2
    off = jnp.maximum(0.0, jnp.radians(MAX_BEARING) - margin)
    error = jnp.radians(config.viewpoint.bearing_error) + off
    return frames.profile(angles, config.arena.poi_extent, error)


def make_scan_jmvae(config: Config) -> Jmvae:
    """The shape of a JMVAE that learns from scans, whose features are looks in their frames."""

    def size(sensor: Sensor) -> int:
        window = jax.ShapeDtypeStruct((sensor.window * sensor.channels,), jnp.float32)
        return jax.eval_shape(make_frame(config, sensor), window).shape[0]

    inputs = tuple(map(size, sensors.make(config)))
    return Jmvae(config.modalities, inputs, config.jmvae.latent_size, config.jmvae.hidden)


def make_prior(config: Config) -> Belief:
    """Belief before any look, `[D]`."""
    return fusion.prior(make_jmvae(config), _UNSEEN_VARIANCE)


@checks.typed
def make_bayes(config: Config) -> Bayes:
    """The exact Bayes filter over the classes of a configuration."""
    return Bayes(jnp.array([config.label_of_class(m) for m in config.modalities]))


def make_models(config: Config, **trained: Any) -> Models:
    """Models of their trained parts; `domains`, `bayes` and `agent` follow from the settings.

    Args:
      trained: other fields of `Models`, at least `fusion`; of the rest there is nothing yet.
    """
    untrained = {
        "detectors": (),
        "jmvae": {},
        "novelty": novelty.independent(len(config.modalities)),
        "look_values": (),
        "q_networks": (),
    }
    return Models(
        domains=tuple(make_domain(config, sensor) for sensor in sensors.make(config)),
        bayes=make_bayes(config),
        agent=make_agent(config),
        **{**untrained, **trained},
    )


def make_agent(config: Config) -> Agent:
    """Agent of `config.dqn.task`."""
    dqn, is_team = config.dqn, config.dqn.task == "team"
    return Agent(
        discount=dqn.discount,
        second_cost=config.team.second_cost,
        travel=make_travel(config) if is_team else None,
        num_pois=config.team.num_pois[1] if is_team else config.arena.num_pois,
        num_modalities=len(config.modalities),
        latent_size=config.jmvae.latent_size,
        hidden=dqn.hidden,
    )


def make_travel(config: Config) -> Travel:
    """How robots travel until they are in view of a PoI."""
    return Travel(config.navigation.view_range - _STOPS_INSIDE)


def make_readout(config: Config, classes: Belief) -> Readout:
    """Readout of class probabilities from `[C, D]` mean joint posteriors of the classes."""
    return readout.make(classes, make_jmvae(config).feature_sizes)


@checks.typed
def make_in_place(config: Config, params: Params, classes: Belief) -> fusion.InPlace:
    """The paper's fusion in place, see `vae.InPlace`."""
    model, read = make_jmvae(config), make_readout(config, classes)
    return fusion.InPlace(classes, make_prior(config), read, model, params)


def make_detector(
    key: Key, config: Config, modality: int, windows: Float[Array, "S F"]
) -> Classifier:
    """Untrained detector of a modality; its input is standardised by `windows` for training.

    If the JMVAE learns from scans, it knows a single label, any PoI.
    """
    is_range = sensors.make(config)[modality].measures_distance
    labels = config.labels(config.modalities[modality])
    number = 1 if config.jmvae.reads_scans else len(labels)
    return detectors.init(key, windows, number, config.detector, is_range)


def make_encoder(
    config: Config,
    modality: int,
    presence: Classifier,
    params: Params,
    scaling: Scaling,
    classes: Belief,
) -> Encoder:
    """Encoder of a modality as a detector.

    Args:
      modality: index of the sensor.
      presence: from `make_detector`, also once trained.
      params: of the JMVAE.
      scaling: the frame in which the encoder sees windows.
      classes: `[C, D]` mean joint posterior of each class.
    """
    name = config.modalities[modality]
    return Encoder(
        params=params["encoders"][name],
        scaling=scaling,
        presence=presence,
        readout=make_readout(config, classes),
        prior=make_prior(config),
        sharpness=jnp.float32(1.0),
        model=make_scan_jmvae(config),
        label_of_class=config.label_of_class(name),
    )


@checks.typed
def init(key: Key, config: Config) -> Models:
    """Untrained models, to try functions before training."""
    detector_key, jmvae_key, dqn_key, filter_key = jax.random.split(key, 4)
    model, agent = make_jmvae(config), make_agent(config)
    dqn_keys = jax.random.split(dqn_key, len(config.modalities) if agent.travel is None else 1)
    shape = len(config.arena.classes), model.latent_size
    classes = Belief(jnp.zeros(shape), jnp.ones(shape))
    made, keys = sensors.make(config), jax.random.split(detector_key, len(config.modalities))
    untrained: tuple[Detector, ...] = tuple(
        make_detector(k, config, m, jnp.zeros((2, made[m].window * made[m].channels)))
        for m, k in enumerate(keys)
    )
    if config.jmvae.reads_scans:
        of_scans = make_scan_jmvae(config)
        params = leave_one_out.init(jmvae_key, of_scans)
        scalings = [
            Scaling(make_frame(config, sensor), jnp.zeros(size), jnp.float32(1.0))
            for sensor, size in zip(made, of_scans.feature_sizes, strict=True)
        ]
        untrained = tuple(
            make_encoder(config, m, presence, params, scalings[m], classes)
            for m, presence in enumerate(untrained)
        )
    else:
        params = jmvae.init(jmvae_key, model)
    if config.jmvae.fusion == "filter":
        fused = fusion.init_filter(filter_key, model, classes, make_prior(config))
    else:
        fused = make_in_place(config, params, classes)
    return make_models(
        config,
        detectors=untrained,
        jmvae=params,
        fusion=fused,
        look_values=tuple(_no_values(config, m) for m in config.modalities),
        q_networks=tuple(agent.init(k) for k in dqn_keys),
    )


def _no_values(config: Config, modality: str) -> LookValues:
    """Values of looks that are all 0."""
    is_of_labels = rewards.make(config.mdp).is_of_labels
    classes, labels = len(config.arena.classes), len(config.labels(modality))
    number = labels if is_of_labels else classes
    table = jnp.zeros(len(optimum.lattice(number, config.evaluation.value_points)))
    of_labels = jnp.zeros((classes, labels)) if is_of_labels else None
    return LookValues(table, table, jnp.zeros(()), jnp.zeros(()), of_labels)

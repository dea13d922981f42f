"""All sections together, and what must hold between them."""

# The defaults are frozen, which ruff does not see in another file.
# ruff: noqa: RUF009

import dataclasses

from jaxsense.config.checks import ConfigError
from jaxsense.config.learning import (
    DetectorConfig,
    DqnConfig,
    EvaluationConfig,
    JmvaeConfig,
    MdpConfig,
)
from jaxsense.config.mission import MissionConfig, NavigationConfig
from jaxsense.config.objects import require_words
from jaxsense.config.scene import (
    MODALITIES,
    ROBOT_RADIUS,
    ArenaConfig,
    CameraConfig,
    LidarConfig,
    SensorConfig,
    ViewpointConfig,
)


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of a run but its seed."""

    modalities: tuple[str, ...] = ("camera", "lidar")
    """The sensors, one robot each."""
    sensors: dict[str, SensorConfig] = dataclasses.field(default_factory=dict, hash=False)
    """Sensors of one's own, by the name of their modality."""
    arena: ArenaConfig = ArenaConfig()
    lidar: LidarConfig = LidarConfig()
    camera: CameraConfig = CameraConfig()
    viewpoint: ViewpointConfig = ViewpointConfig()
    detector: DetectorConfig = DetectorConfig()
    jmvae: JmvaeConfig = JmvaeConfig()
    mdp: MdpConfig = MdpConfig()
    dqn: DqnConfig = DqnConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    navigation: NavigationConfig = NavigationConfig()
    mission: MissionConfig = MissionConfig()

    def __post_init__(self):
        self._check_modalities()
        weights = self.jmvae.reconstruction_weights
        if len(weights) != len(self.modalities):
            raise ConfigError(
                "jmvae.reconstruction_weights",
                weights,
                f"must hold one weight for each of modalities = {self.modalities}",
            )
        nearest = self.arena.poi_extent + ROBOT_RADIUS + self.viewpoint.clearance
        if self.viewpoint.min_distance < nearest:
            raise ConfigError(
                "viewpoint.min_distance",
                self.viewpoint.min_distance,
                f"must be at least {nearest:.3f} m, where the robot is clear of the PoI",
            )
        if self.viewpoint.max_distance > self.arena.side / 2:
            raise ConfigError(
                "viewpoint.max_distance",
                self.viewpoint.max_distance,
                f"must be at most half the arena's side, {self.arena.side / 2} m",
            )
        nearest = max(
            self.arena.poi_extent + self.navigation.robot_radius, self.viewpoint.min_distance
        )
        distances = self.navigation.view_distances
        farthest = self.navigation.view_range
        if farthest > self.viewpoint.max_distance:
            raise ConfigError(
                "navigation.view_range",
                farthest,
                f"must be at most viewpoint.max_distance = {self.viewpoint.max_distance} m, up to "
                "where the detectors are trained",
            )
        if not nearest <= min(distances) <= max(distances) <= farthest:
            raise ConfigError(
                "navigation.view_distances",
                distances,
                f"must lie between {nearest:.3f} m, where the robot is clear of the PoI, and "
                f"navigation.view_range = {farthest} m",
            )
        looks = self.arena.num_pois * len(self.modalities)
        if self.mdp.partly_seen_starts and not 2 <= looks <= 30:
            raise ConfigError(
                "mdp.partly_seen_starts",
                True,
                f"needs 2 to 30 pairs of PoI and modality, not {looks}; must be False",
            )

    def _check_modalities(self) -> None:
        known = ", ".join([*MODALITIES, *self.sensors])
        if self.sensors:
            require_words(self.sensors, "sensors")
        attributes = ("colour", "shape", *self.arena.attributes)
        for name, sensor in self.sensors.items():
            if name in (*MODALITIES, "joint"):
                raise ConfigError("sensors", name, "is there already; must be a new name")
            if sensor.attribute not in attributes:
                raise ConfigError(
                    f"sensors.{name}.attribute",
                    sensor.attribute,
                    f"must be one of {', '.join(attributes)}",
                )
        if not self.modalities:
            raise ConfigError("modalities", self.modalities, f"must name one or more of {known}")
        for modality in self.modalities:
            if modality not in MODALITIES and modality not in self.sensors:
                raise ConfigError("modalities", self.modalities, f"must be some of {known}")
        if len(set(self.modalities)) != len(self.modalities):
            raise ConfigError("modalities", self.modalities, "must name no modality twice")

    def attribute(self, modality: str) -> str:
        """What a modality tells apart: `colour`, `shape` or one of `arena.attributes`."""
        own = self.sensors.get(modality)
        return MODALITIES[modality] if own is None else own.attribute

    def labels(self, modality: str) -> tuple[str, ...]:
        """The words that a modality tells apart, in the order of its features."""
        return self.arena.labels(self.attribute(modality))

    def label_of_class(self, modality: str) -> tuple[int, ...]:
        """For each class, the index of what a modality detects of it."""
        return self.arena.label_of_class(self.attribute(modality))

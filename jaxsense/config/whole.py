"""All sections together, and the checks between them."""

# The defaults are frozen, which ruff does not see in another file.

import dataclasses
import itertools
import math
import operator

from jaxsense.config.checks import ConfigError, require_types
from jaxsense.config.learning import (
    DetectorConfig,
    DqnConfig,
    EvaluationConfig,
    FilterConfig,
    JmvaeConfig,
    MdpConfig,
    TeamConfig,
)
from jaxsense.config.mission import (
    MISSIONS_AT_ONCE,
    NODES_PER_POI,
    MissionConfig,
    NavigationConfig,
)
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
from jaxsense.config.section import section

_MOST_NUMBERS = 2**32
"""Numbers of 32 bits in an array or a network, 16 GiB."""
_MOST_MODALITIES = 8  # the JMVAE has an encoder for each subset
_MOST_ROBOTS = 64


@section
class Config:
    """All settings of a run but its seed."""

    modalities: tuple[str, ...] = ("camera", "lidar")
    """The sensors that are trained."""
    robots: tuple[str, ...] | None = None
    """The robots of missions: for each the modality of its sensor, which several may share. By
    default one robot for each of `modalities`."""
    sensors: dict[str, SensorConfig] = dataclasses.field(default_factory=dict, hash=False)
    """Custom sensors, by the name of their modality."""
    arena: ArenaConfig = ArenaConfig()
    lidar: LidarConfig = LidarConfig()
    camera: CameraConfig = CameraConfig()
    viewpoint: ViewpointConfig = ViewpointConfig()
    detector: DetectorConfig = DetectorConfig()
    jmvae: JmvaeConfig = JmvaeConfig()
    filter: FilterConfig = FilterConfig()
    mdp: MdpConfig = MdpConfig()
    team: TeamConfig = TeamConfig()
    dqn: DqnConfig = DqnConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    navigation: NavigationConfig = NavigationConfig()
    mission: MissionConfig = MissionConfig()

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        self._check_modalities()
        self._check_classes()
        self._check_robots()
        weights = self.jmvae.reconstruction_weights
        if len(weights) != len(self.modalities):
            raise ConfigError(
                "jmvae.reconstruction_weights",
                weights,
                f"must hold one weight for each of modalities = {self.modalities}",
            )
        if self.mdp.reward == "nats" and self.jmvae.fusion != "filter":
            reason = f"needs jmvae.fusion = 'filter', not {self.jmvae.fusion!r}"
            raise ConfigError("mdp.reward", self.mdp.reward, reason)
        self._check_task()
        self._check_learning()
        self._check_viewpoints()
        self._check_views()
        of_team = self.team.num_pois if self.dqn.task == "team" else ()
        most = max(self.arena.num_pois, *of_team, *self.evaluation.num_pois, 0)
        looks = most * len(self.modalities)
        if self.mdp.partly_seen_starts and not 2 <= looks <= 30:
            raise ConfigError(
                "mdp.partly_seen_starts",
                True,
                f"needs 2 to 30 pairs of PoI and modality, not {looks}; must be False",
            )
        self._check_fields_of_view()
        self._check_memory()

    def _check_task(self) -> None:
        """A team learns from stored detections; a dense network is for one number of PoIs."""
        if self.dqn.task == "team":
            if self.dqn.observe != "bank":
                reason = "must be 'bank' with dqn.task = 'team', whose MDP has no scans"
                raise ConfigError("dqn.observe", self.dqn.observe, reason)
            least = self.team.cells_per_side * self.arena.poi_pitch
            if self.team.sides[0] < least:
                reason = f"must be at least {least:.2f} m, where {self.team.num_pois[1]} PoIs fit"
                raise ConfigError("team.sides", self.team.sides, reason)
        elif self.evaluation.num_pois:
            reason = "needs dqn.task = 'team', whose policy is for any number; must be empty"
            raise ConfigError("evaluation.num_pois", self.evaluation.num_pois, reason)

    def _check_learning(self) -> None:
        """A filter must hold all classes, and a detector have scans to train on."""
        number, size = len(self.arena.classes), self.jmvae.latent_size
        if self.jmvae.fusion == "filter" and number > 2 * size + 1:
            reason = f"must be at least {number // 2}, so that a filter can hold {number} classes"
            raise ConfigError("jmvae.latent_size", size, reason)
        # Whole scenes are surveyed.
        scans = -(-self.detector.num_scans // self.arena.num_pois) * self.arena.num_pois
        if self.detector.num_training(scans) < 1:
            reason = f"leaves no scan to train on, of {scans}; must be less"
            raise ConfigError("detector.calibration", self.detector.calibration, reason)

    def _check_viewpoints(self) -> None:
        """Viewpoints for training must be clear of the PoI and inside the arena."""
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

    def _check_views(self) -> None:
        """Viewpoints in missions must be clear of the PoI and within the range of training."""
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
        if not 1 <= len(self.modalities) <= _MOST_MODALITIES:
            reason = f"must name 1 to {_MOST_MODALITIES} of {known}"
            raise ConfigError("modalities", self.modalities, reason)
        for modality in self.modalities:
            if modality not in MODALITIES and modality not in self.sensors:
                raise ConfigError("modalities", self.modalities, f"must be some of {known}")
        if len(set(self.modalities)) != len(self.modalities):
            raise ConfigError("modalities", self.modalities, "must name no modality twice")

    def _check_classes(self) -> None:
        """Classes must differ in something that a sensor, of this team or not, distinguishes."""
        of_sensors = zip(*map(self.label_of_class, [*MODALITIES, *self.sensors]), strict=True)
        seen: dict[tuple[int, ...], str] = {}
        for name, labels in zip(self.arena.classes, of_sensors, strict=True):
            if (twin := seen.setdefault(labels, name)) != name:
                raise ConfigError(
                    "arena.classes",
                    self.arena.classes,
                    f"must not have both {twin!r} and {name!r}, which no sensor can distinguish",
                )

    def _check_robots(self) -> None:
        """The robots must carry trained sensors, which together distinguish some classes."""
        known = ", ".join(self.modalities)
        if not 1 <= len(self.carried) <= _MOST_ROBOTS:
            reason = f"must name 1 to {_MOST_ROBOTS} robots, each one of {known}"
            raise ConfigError("robots", self.carried, reason)
        for modality in self.carried:
            if modality not in self.modalities:
                raise ConfigError(
                    "robots", self.carried, f"must each be one of modalities: {known}"
                )
        told = set(zip(*map(self.label_of_class, self.carried), strict=True))
        if len(told) == 1 < len(self.arena.classes):
            reason = (
                f"cannot distinguish any of {', '.join(self.arena.classes)}; must be robots that do"
            )
            raise ConfigError("robots", self.carried, reason)

    def _check_fields_of_view(self) -> None:
        """Sensors must have the PoIs that they look at in view."""
        viewpoint = self.viewpoint
        for name, sensor in {"camera": self.camera, "lidar": self.lidar}.items():
            most = sensor.field_of_view / 2 - viewpoint.bearing_error
            if name in self.modalities and viewpoint.max_bearing > most:
                raise ConfigError(
                    "viewpoint.max_bearing",
                    viewpoint.max_bearing,
                    f"must be at most half of {name}.field_of_view less viewpoint.bearing_error, "
                    f"{most:g} degrees",
                )

    def _check_memory(self) -> None:
        """No array that can become large may exceed a computer's memory."""
        for fields, number in self._numbers_of_arrays().items():
            if number > _MOST_NUMBERS:
                values = {field: operator.attrgetter(field)(self) for field in fields.split()}
                field = max(values, key=lambda field: values[field])
                raise ConfigError(
                    field,
                    values[field],
                    f"takes {4 * number / 2**30:,.0f} GiB with the other settings; must take at "
                    f"most {4 * _MOST_NUMBERS / 2**30:.0f} GiB",
                )

    def _numbers_of_arrays(self) -> dict[str, int]:
        """How many numbers each large array holds, by the field or fields that make it large."""
        arena, jmvae, dqn, ways = self.arena, self.jmvae, self.dqn, self.navigation
        num_pois, num_classes = arena.num_pois, len(arena.classes)
        num_labels = sum(len(self.labels(name)) for name in self.modalities)
        windows = {"camera": 3 * self.camera.window, "lidar": self.lidar.window}
        window = max(windows.get(name, 1) for name in self.modalities)
        of_poi = 2 * jmvae.latent_size
        state, scene = num_pois * of_poi, num_pois * window
        if dqn.task == "team":
            of_poi += 3 * len(self.modalities) + 4
            state = max(self.team.num_pois[1], num_pois) * of_poi
        views = num_pois * ways.view_sides * len(ways.view_distances)
        trajectories = ways.speed_samples * ways.turn_samples * math.ceil(10 * ways.horizon)
        encoders = 2 ** len(self.modalities)
        detector, evaluation, tours = self.detector, self.evaluation, self.team.tours
        return {
            "detector.hidden": _weights(window, *detector.hidden, num_labels),
            "detector.num_scans": detector.num_scans * window,
            "detector.num_held_out": detector.num_held_out * window,
            "detector.batch detector.steps": detector.batch * max(detector.steps, window),
            "jmvae.hidden": encoders * _weights(num_labels, *jmvae.hidden, 2 * jmvae.latent_size),
            "jmvae.samples_per_class": jmvae.samples_per_class * num_classes * window,
            "jmvae.batch jmvae.steps": jmvae.batch * jmvae.steps * (jmvae.latent_size + num_labels),
            "filter.hidden": _weights(num_labels, *self.filter.hidden, num_classes),
            "filter.batch filter.looks filter.steps": self.filter.batch
            * self.filter.looks
            * self.filter.steps
            * num_labels,
            "dqn.hidden": _weights(state, *dqn.hidden, num_pois + 1),
            "dqn.replay_capacity": dqn.replay_capacity * (2 * state + 3),
            "dqn.num_starts": dqn.num_starts * max(state, scene),
            "dqn.num_envs dqn.chunk": dqn.num_envs * max(5 * dqn.chunk, state, scene),
            "dqn.batch dqn.updates dqn.chunk": 2 * dqn.batch * max(dqn.chunk * dqn.updates, state),
            "team.tours.states team.tours.tries": tours.states * max(2, tours.tries) * state,
            "team.tours.batch team.tours.steps": tours.batch * max(tours.steps, 2 * state),
            "evaluation.num_starts evaluation.num_repeats": evaluation.num_starts
            * evaluation.num_repeats
            * state,
            "evaluation.value_points evaluation.value_looks": 2
            * evaluation.value_points
            * evaluation.value_looks
            * len(arena.classes) ** 2,
            "navigation.turn_samples": trajectories * num_pois * MISSIONS_AT_ONCE,
            "mission.episodes": self.mission.episodes * views * num_pois * NODES_PER_POI,
        }

    @property
    def carried(self) -> tuple[str, ...]:
        """Modality of each robot of a mission, R of them."""
        return self.modalities if self.robots is None else self.robots

    @property
    def robot_names(self) -> tuple[str, ...]:
        """Names of the robots: the modality, numbered if several robots share it."""
        return tuple(
            modality if self.carried.count(modality) == 1 else f"{modality}_{number}"
            for modality, number in zip(self.carried, self._numbers(), strict=True)
        )

    def _numbers(self) -> list[int]:
        """For each robot, its number among those that share its modality, from 1."""
        return [self.carried[: r + 1].count(modality) for r, modality in enumerate(self.carried)]

    @property
    def modality_of_robot(self) -> tuple[int, ...]:
        """For each robot, the index of its modality."""
        return tuple(map(self.modalities.index, self.carried))

    def attribute(self, modality: str) -> str:
        """Attribute that a modality reads: `colour`, `shape` or one of `arena.attributes`."""
        own = self.sensors.get(modality)
        return MODALITIES[modality] if own is None else own.attribute

    def labels(self, modality: str) -> tuple[str, ...]:
        """Words that a modality distinguishes, in the order of its features."""
        return self.arena.labels(self.attribute(modality))

    def label_of_class(self, modality: str) -> tuple[int, ...]:
        """For each class, the index of its label in a modality."""
        return self.arena.label_of_class(self.attribute(modality))


def _weights(*sizes: int) -> int:
    """Weights of a dense network with layers of these sizes."""
    return sum(before * after for before, after in itertools.pairwise(sizes))

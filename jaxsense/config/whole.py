"""All sections together, the checks between them, and presets."""

import math
from collections.abc import Mapping, Sequence

from jaxsense.config.learning import (
    LOOK_SECONDS,
    DetectorConfig,
    DqnConfig,
    EvaluationConfig,
    FilterConfig,
    JmvaeConfig,
    MdpConfig,
    TeamConfig,
)
from jaxsense.config.mission import PLANNING_RADIUS, MissionConfig, NavigationConfig
from jaxsense.config.scene import (
    CLEARANCE,
    MAX_BEARING,
    MODALITIES,
    ROBOT_RADIUS,
    ArenaConfig,
    CameraConfig,
    LidarConfig,
    SensorConfig,
    ViewpointConfig,
    require_words,
)
from jaxsense.config.section import (
    ConfigError,
    FrozenDict,
    Section,
    limited,
    require,
    require_known,
)

_MAX_MODALITIES = 8  # the JMVAE has an encoder for each subset
_MAX_ROBOTS = 64


class Config(Section):
    """All settings of a run except its seed.

    Attributes:
      modalities: Sensors to train: `camera`, `lidar` and the names of custom `sensors`.
      robots: Sensors of the robots in missions, one per robot, for example `camera camera lidar`;
        by default, one robot for each modality.
      sensors: Custom sensors, by the name of their modality.
    """

    modalities: tuple[str, ...] = limited(
        ("camera", "lidar"), min_items=1, max_items=_MAX_MODALITIES
    )
    robots: tuple[str, ...] | None = limited(None, min_items=1, max_items=_MAX_ROBOTS)
    sensors: Mapping[str, SensorConfig] = FrozenDict()
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

    @property
    def named_code(self) -> dict[str, str]:
        """Functions that the settings name, by field."""
        named = {f"sensors.{name}.make": sensor.make for name, sensor in self.sensors.items()}
        return {**named, "mdp.reward": self.mdp.reward} if ":" in self.mdp.reward else named

    def require_trust(self) -> None:
        """Raises a `ConfigError` if settings name custom sensors or rewards, which run code."""
        for field, path in self.named_code.items():
            reason = "names code that would be run; pass --trust (trust=True) if you trust it"
            raise ConfigError(field, path, reason)

    def check(self) -> None:
        """Checks relations between sections; raises `ConfigError`."""
        self._check_modalities()
        self._check_learning()
        self._check_task()
        self._check_viewpoints()
        if self.jmvae.reads_scans and "lidar" in self.modalities:
            self._check_profile()

    def _check_modalities(self) -> None:
        """Modalities and robots must be known, and custom sensors read every attribute."""
        require_words(self.sensors, "sensors")
        attributes = ("colour", "shape", *self.arena.attributes)
        for name, sensor in self.sensors.items():
            if name in (*MODALITIES, "joint"):
                raise ConfigError("sensors", name, "already exists")
            require_known(f"sensors.{name}.attribute", sensor.attribute, attributes)
        for name in self.arena.attributes:
            if name not in (sensor.attribute for sensor in self.sensors.values()):
                reason = "no sensor reads it; add one to sensors"
                raise ConfigError("arena.attributes", name, reason)
        known, names = [*MODALITIES, *self.sensors], self.modalities
        is_known = set(names) <= set(known)
        require(is_known, self, "modalities", f"must be among {', '.join(known)}")
        require(len(set(names)) == len(names), self, "modalities", "must name no modality twice")
        weights = self.jmvae.reconstruction_weights
        expected = f"must have one value for each of modalities = {names}"
        require(len(weights) == len(names), self.jmvae, "reconstruction_weights", expected)
        expected = f"must each be one of modalities: {', '.join(names)}"
        require(set(self.carried) <= set(names), self, "robots", expected)
        if len(set(zip(*map(self.label_of_class, self.carried), strict=True))) == 1:
            expected = f"must distinguish some of {', '.join(self.arena.classes)}"
            raise ConfigError("robots", self.carried, expected)

    def _check_learning(self) -> None:
        """Beliefs must hold all labels, and calibration must leave scans to train on."""
        jmvae, detector, num_classes = self.jmvae, self.detector, len(self.arena.classes)
        least = self._least_latent_size()
        expected = f"must be at least {least}, so that beliefs can hold {num_classes} classes"
        require(jmvae.latent_size >= least, jmvae, "latent_size", expected)
        # Scans come in whole scenes, and these in groups that show the same PoIs.
        in_group = self.arena.num_pois * jmvae.num_together
        groups = -(-detector.num_scans // in_group)
        scans = groups * in_group
        leaves_some = detector.num_training(groups if jmvae.reads_scans else scans) > 0
        expected = f"leaves none of {scans} scans to train on; lower it"
        require(leaves_some, detector, "calibration", expected)
        for section, field, number in (
            (detector, "num_held_out", -(-detector.num_held_out // num_classes)),
            (jmvae, "samples_per_class", jmvae.samples_per_class),
        ):
            groups = -(-number * num_classes // in_group)
            expected = f"leaves some of {num_classes} classes without a look; raise it"
            require(groups * self.arena.num_pois >= num_classes, section, field, expected)
        most, is_nats = math.log(num_classes), self.mdp.reward == "nats"
        expected = f"must be below {most:.3g}, all the nats that looks can tell: none would pay"
        require(not is_nats or self.mdp.look_cost < most, self.mdp, "look_cost", expected)
        is_timed, left = self.dqn.task == "team", most - self.mdp.look_cost
        expected = f"must be below {left / LOOK_SECONDS:g}: a look tells less than its time costs"
        pays = not (is_nats and is_timed) or self.team.second_cost * LOOK_SECONDS < left
        require(pays, self.team, "second_cost", expected)
        adds_up = jmvae.fusion == "filter" or not self.mission.communication.own_maps
        expected = "must be off unless jmvae.fusion is 'filter', which accumulates looks"
        require(adds_up, self.mission.communication, "own_maps", expected)

    def _least_latent_size(self) -> int:
        """Minimum size that gives the labels of each attribute dimensions of their own.

        A dimension has two moments and so holds three labels. Few classes need no axes: it also
        holds any three classes.
        """
        of_labels = {self.attribute(m): len(self.labels(m)) for m in self.modalities}
        apart = sum(number // 2 for number in of_labels.values())
        distinct = len(set(zip(*map(self.label_of_class, self.modalities), strict=True)))
        return max(1, min(apart, distinct // 2))

    def _check_task(self) -> None:
        """What is learned must fit the task, and states that are partly seen a number."""
        team, most = self.team, self.arena.num_pois
        if self.dqn.task == "team":
            expected = "must be 'bank' with dqn.task = 'team', whose MDP has no scans"
            require(self.dqn.observe == "bank", self.dqn, "observe", expected)
            least = team.cells_per_side * self.arena.poi_pitch
            expected = f"must be at least {least:.2f} m, so that {team.num_pois[1]} PoIs fit"
            require(team.sides[0] >= least, team, "sides", expected)
            most = max(team.num_pois[1], most, *self.evaluation.num_pois)
        else:
            expected = "must be empty unless dqn.task is 'team', which handles any number of PoIs"
            require(not self.evaluation.num_pois, self.evaluation, "num_pois", expected)
        looks = most * len(self.modalities)
        is_right = not self.mdp.partly_seen_starts or 2 <= looks <= 30
        expected = f"must be off: it needs 2 to 30 pairs of PoI and modality, and there are {looks}"
        require(is_right, self.mdp, "partly_seen_starts", expected)

    def _check_viewpoints(self) -> None:
        """Viewpoints must be clear of the PoI, in range of the detectors, and show the PoI."""
        viewpoint, navigation = self.viewpoint, self.navigation
        clear = self.arena.poi_extent + ROBOT_RADIUS + CLEARANCE
        expected = f"must be at least {clear:.3f} m, where the robot is clear of the PoI"
        require(viewpoint.min_distance >= clear, viewpoint, "min_distance", expected)
        most = self.arena.side / 2
        expected = f"must be at most half the arena's side, {most} m"
        require(viewpoint.max_distance <= most, viewpoint, "max_distance", expected)
        farthest = navigation.view_range
        expected = f"must be at most viewpoint.max_distance = {viewpoint.max_distance} m"
        require(farthest <= viewpoint.max_distance, navigation, "view_range", expected)
        # A robot that searches keeps away by the error of its position.
        nearest = viewpoint.min_distance + self.mission.localisation.search[0]
        nearest = max(self.arena.poi_extent + PLANNING_RADIUS, nearest)
        expected = f"must be at least {nearest:.3f} m, where the robot is clear of the PoI"
        require(nearest <= farthest, navigation, "view_range", expected)
        least = 2 * (MAX_BEARING + viewpoint.bearing_error)
        for name, sensor in {"camera": self.camera, "lidar": self.lidar}.items():
            shows = name not in self.modalities or sensor.field_of_view >= least
            expected = f"must be at least {least:g} degrees, or robots miss the PoIs they look at"
            require(shows, sensor, "field_of_view", expected)

    def _check_profile(self) -> None:
        """A profile needs three beams on a PoI, and a window that reaches it and not behind."""
        lidar, farthest = self.lidar, self.viewpoint.max_distance
        expected = f"must be at least viewpoint.max_distance = {farthest} m to learn from scans"
        require(lidar.window_range >= farthest, lidar, "window_range", expected)
        sine = min(self.arena.poi_half_width / farthest, 1.0)
        widest = math.degrees(2 * math.asin(sine)) / 3
        least = math.ceil(lidar.field_of_view / widest) + 1
        expected = (
            f"must be at least {least} to learn from scans: so that three beams hit a "
            f"PoI at viewpoint.max_distance = {farthest} m"
        )
        require(lidar.num_beams >= least, lidar, "num_beams", expected)
        pitch = lidar.field_of_view / (lidar.num_beams - 1)
        most = math.floor(180 / pitch) + 1
        expected = f"must be from 3 to {most} to learn from scans: at most 180 degrees"
        require(3 <= lidar.window <= most, lidar, "window", expected)

    @property
    def carried(self) -> tuple[str, ...]:
        """Modality of each robot of a mission, R of them."""
        return self.modalities if self.robots is None else self.robots

    @property
    def robot_names(self) -> tuple[str, ...]:
        """Names of the robots: the modality, numbered if several robots share it."""
        return names_of_robots(self.carried)

    @property
    def modality_of_robot(self) -> tuple[int, ...]:
        """For each robot, the index of its modality."""
        return tuple(map(self.modalities.index, self.carried))

    def attribute(self, modality: str) -> str:
        """Attribute that a modality reads: `colour`, `shape` or one of `arena.attributes`."""
        require_known("modality", modality, [*MODALITIES, *self.sensors])
        own = self.sensors.get(modality)
        return MODALITIES[modality] if own is None else own.attribute

    def labels(self, modality: str) -> tuple[str, ...]:
        """Words that a modality distinguishes, in the order of its features."""
        return self.arena.labels(self.attribute(modality))

    def label_of_class(self, modality: str) -> tuple[int, ...]:
        """For each class, the index of its label in a modality."""
        return self.arena.label_of_class(self.attribute(modality))


def names_of_robots(carried: Sequence[str]) -> tuple[str, ...]:
    """Names robots by their modality, numbered from 1 if several share it.

    Args:
      carried: modality of each robot.
    """

    def name(robot: int, modality: str) -> str:
        number = carried[: robot + 1].count(modality)
        return modality if carried.count(modality) == 1 else f"{modality}_{number}"

    return tuple(name(robot, modality) for robot, modality in enumerate(carried))

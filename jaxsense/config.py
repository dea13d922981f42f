"""Every setting of a run: frozen dataclasses, checked when made, and the presets.

A value that makes no sense raises `ConfigError`, a `ValueError` whose one line names the field, its
value and what would be right. The attribute docstrings are the text of `--help`.
"""

import dataclasses
import math
from typing import Literal

COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.8, 0.1, 0.1),
    "green": (0.1, 0.7, 0.1),
    "blue": (0.1, 0.2, 0.8),
    "yellow": (0.8, 0.7, 0.1),
}
"""Albedo of each colour name that a PoI class can have, linear RGB in [0, 1]."""

ROBOT_RADIUS = 0.0495
"""Radius of an AMiRo, in metres."""

SHAPES: tuple[str, ...] = ("cylinder", "cube")
"""Shapes that a PoI class can have; the index is the shape code of `sim.arena.Layout`."""

MODALITIES: dict[str, Literal["colour", "shape"]] = {"camera": "colour", "lidar": "shape"}
"""The sensors that `sim` knows, and the attribute of a PoI that each one tells apart."""


_MOST_SHARES = 32


class ConfigError(ValueError):
    """A setting that cannot be used: `field = value: what would be right`."""

    def __init__(self, field: str, value: object, expected: str):
        super().__init__(f"{field} = {value!r}: {expected}")


def _require(condition: bool, section: object, field: str, expected: str) -> None:
    if not condition:
        name = type(section).__name__.removesuffix("Config").lower()
        raise ConfigError(f"{name}.{field}", getattr(section, field), expected)


def _require_positive(section: object, *fields: str) -> None:
    for field in fields:
        value = getattr(section, field)
        _require(
            math.isfinite(value) and value > 0, section, field, "must be a number greater than 0"
        )


def _require_not_negative(section: object, *fields: str) -> None:
    for field in fields:
        value = getattr(section, field)
        _require(
            math.isfinite(value) and value >= 0,
            section,
            field,
            "must be a number that is not negative",
        )


def _require_sizes(section: object, field: str) -> None:
    sizes = getattr(section, field)
    _require(
        len(sizes) > 0 and all(size > 0 for size in sizes),
        section,
        field,
        "must be one or more layer sizes, each greater than 0",
    )


def _require_window(section, num_rays: int) -> None:
    _require_positive(section, "window", "stride")
    most = (num_rays - 1) // section.stride + 1
    _require(
        section.window <= most,
        section,
        "window",
        f"at most {most} of {num_rays} rays fit with a stride of {section.stride}",
    )


@dataclasses.dataclass(frozen=True)
class ArenaConfig:
    """The square arena, its points of interest (PoIs) and the classes they are drawn from."""

    side: float = 3.0
    """Inner length and width of the arena, in metres."""
    num_pois: int = 3
    """Number of points of interest."""
    poi_radius: float = 0.1
    """Radius of a cylinder and half the side of a cube, in metres."""
    poi_height: float = 0.2
    """Height of a PoI, in metres; more than 0.152, or the LiDAR looks over it."""
    poi_gap: float = 0.3
    """Smallest free gap between two PoIs, in metres; a robot needs 0.1 to pass."""
    classes: tuple[str, ...] = ("green cylinder", "red cylinder", "red cube")
    """Classes of PoIs, each `"COLOUR SHAPE"`, drawn with equal chance."""

    def __post_init__(self):
        _require_positive(self, "side", "num_pois", "poi_radius", "poi_height", "poi_gap")
        _require(self.poi_height > 0.152, self, "poi_height", "must be more than 0.152 m")
        _require(len(self.classes) > 0, self, "classes", 'must name a class, "COLOUR SHAPE"')
        for name in self.classes:
            colour, _, shape = name.partition(" ")
            _require(
                colour in COLOURS and shape in SHAPES,
                self,
                "classes",
                f'{name!r} must be "COLOUR SHAPE" with a colour of {", ".join(COLOURS)} '
                f"and a shape of {', '.join(SHAPES)}",
            )
        _require(
            len(set(self.classes)) == len(self.classes), self, "classes", "must name no class twice"
        )
        most = math.floor(self.side / self.poi_pitch) ** 2
        _require(
            self.num_pois <= most,
            self,
            "num_pois",
            f"at most {most} PoIs of radius {self.poi_radius} m with gaps of {self.poi_gap} m "
            f"fit an arena of side {self.side} m",
        )

    @property
    def poi_extent(self) -> float:
        """Radius of the circle that holds a PoI of any shape at any yaw, in metres."""
        return math.sqrt(2.0) * self.poi_radius

    @property
    def poi_pitch(self) -> float:
        """Distance of two PoIs' centres that leaves the gap between them free, in metres."""
        return 2.0 * self.poi_extent + self.poi_gap

    def labels(self, attribute: Literal["colour", "shape"]) -> tuple[str, ...]:
        """The distinct colours or shapes of the classes, in order of first appearance.

        Green and red come as ("red", "green"), round and edgy as ("cylinder", "cube"): the order of
        the paper's feature vectors, which is the order of `COLOURS` and `SHAPES`.
        """
        known = COLOURS if attribute == "colour" else SHAPES
        used = {name.split(" ")[0 if attribute == "colour" else 1] for name in self.classes}
        return tuple(label for label in known if label in used)

    def label_of_class(self, attribute: Literal["colour", "shape"]) -> tuple[int, ...]:
        """For each class, the index of its colour or shape in `labels(attribute)`."""
        labels = self.labels(attribute)
        position = 0 if attribute == "colour" else 1
        return tuple(labels.index(name.split(" ")[position]) for name in self.classes)


@dataclasses.dataclass(frozen=True)
class LidarConfig:
    """The Hokuyo URG-04LX on the AMiRo."""

    num_beams: int = 683
    """Beams of one scan."""
    field_of_view: float = 240.0
    """Angle between the first and the last beam, in degrees."""
    min_range: float = 0.08
    """Shortest distance that is measured, in metres."""
    max_range: float = 5.0
    """Longest distance that is measured, in metres; also what a beam without a return reads."""
    range_noise: float = 0.01
    """Standard deviation of a distance, in metres."""
    window: int = 128
    """Beams around the PoI's bearing that the detector reads."""
    stride: int = 1
    """From each beam that the detector reads to the next, in beams."""
    window_range: float = 1.5
    """Longest distance that the detector is shown, in metres: what is behind a PoI is cut off."""

    def __post_init__(self):
        _require_positive(
            self, "num_beams", "field_of_view", "min_range", "max_range", "window_range"
        )
        _require_not_negative(self, "range_noise")
        _require(self.field_of_view <= 360.0, self, "field_of_view", "must be at most 360 degrees")
        _require(self.max_range > self.min_range, self, "max_range", "must be above min_range")
        _require(
            self.window_range > self.min_range, self, "window_range", "must be above min_range"
        )
        _require_window(self, self.num_beams)


@dataclasses.dataclass(frozen=True)
class CameraConfig:
    """The camera on the AMiRo, of which one line of pixels is used."""

    num_pixels: int = 640
    """Pixels of the scanline."""
    field_of_view: float = 80.0
    """Horizontal field of view, in degrees."""
    pixel_noise: float = 0.007
    """Standard deviation of a pixel's value, where 1 is full scale."""
    window: int = 80
    """Pixels around the PoI's bearing that the detector reads."""
    stride: int = 4
    """From each pixel that the detector reads to the next, in pixels."""

    def __post_init__(self):
        _require_positive(self, "num_pixels", "field_of_view")
        _require_not_negative(self, "pixel_noise")
        _require(self.field_of_view < 180.0, self, "field_of_view", "must be below 180 degrees")
        _require_window(self, self.num_pixels)


@dataclasses.dataclass(frozen=True)
class ViewpointConfig:
    """Where a robot stands when it looks at a PoI."""

    min_distance: float = 0.3
    """Shortest distance from the sensor to the PoI's centre, in metres."""
    max_distance: float = 1.2
    """Longest distance from the sensor to the PoI's centre, in metres."""
    max_bearing: float = 20.0
    """Largest angle between the robot's heading and the PoI, to either side, in degrees."""
    bearing_error: float = 1.0
    """Largest error of the bearing at which the detector's window is centred, in degrees."""
    clearance: float = 0.03
    """Free space around the robot at a viewpoint, in metres."""

    def __post_init__(self):
        _require_positive(self, "min_distance", "max_distance")
        _require_not_negative(self, "max_bearing", "bearing_error", "clearance")
        _require(self.max_bearing <= 30, self, "max_bearing", "must be at most 30 degrees")
        _require(self.bearing_error <= 10, self, "bearing_error", "must be at most 10 degrees")
        _require(
            self.max_distance > self.min_distance,
            self,
            "max_distance",
            "must be above min_distance",
        )


@dataclasses.dataclass(frozen=True)
class DetectorConfig:
    """The scanline detectors f_x and f_w."""

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    num_scans: int = 98304
    """Simulated scans to train on, for each modality."""
    num_held_out: int = 8192
    """Further simulated scans, on which accuracy is measured."""
    steps: int = 4000
    """Gradient steps."""
    batch: int = 512
    """Scans of one gradient step."""
    learning_rate: float = 2e-3
    """Highest learning rate of Adam; decays to zero by a cosine."""

    def __post_init__(self):
        _require_sizes(self, "hidden")
        _require_positive(self, "num_scans", "num_held_out", "steps", "batch", "learning_rate")


@dataclasses.dataclass(frozen=True)
class JmvaeConfig:
    """The joint multi-modal VAE."""

    latent_size: int = 2
    """Dimensions of the latent space, D_z."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of every encoder and decoder."""
    alpha: float = 0.1
    """Weight of the divergence from the joint posterior to each uni-modal one."""
    beta: float = 0.001
    """Weight of the divergence from the joint posterior to the prior."""
    initial_beta: float = 0.7
    """Where beta starts: from far above, one latent dimension after the other comes into use."""
    annealing: float = 0.5
    """Share of the training in which beta falls from initial_beta to beta."""
    reconstruction_weights: tuple[float, ...] = (10.0, 10.0)
    """Weight of each modality's reconstruction, in the order of `modalities`."""
    restarts: int = 3
    """Trainings from different random parameters, of which the one with the lowest loss is kept."""
    samples_per_class: int = 10000
    """Detections of each class and modality in the training set."""
    steps: int = 3000
    """Gradient steps."""
    batch: int = 256
    """Pairs of detections in one gradient step."""
    learning_rate: float = 2e-3
    """Highest learning rate of Adam; decays to zero by a cosine."""

    def __post_init__(self):
        _require_sizes(self, "hidden")
        _require_positive(self, "latent_size", "samples_per_class", "steps", "batch")
        _require_positive(self, "learning_rate", "restarts")
        _require_positive(self, "beta", "initial_beta")
        _require_not_negative(self, "alpha")
        _require(0 <= self.annealing <= 1, self, "annealing", "must be within 0 and 1")
        _require(
            all(math.isfinite(w) and w >= 0 for w in self.reconstruction_weights),
            self,
            "reconstruction_weights",
            "must be numbers that are not negative",
        )


@dataclasses.dataclass(frozen=True)
class MdpConfig:
    """The map of beliefs as a Markov decision process."""

    unseen_variance: float = 20.0
    """Variance of each latent dimension of a PoI that nobody has seen."""
    min_increase: float = 0.05
    """Information that a look must gain, in inverse latent units, or its reward is -1."""
    max_steps: int = 20
    """Actions after which an episode is cut off."""
    partly_seen_starts: bool = False
    """Leave out the starts in which every PoI has been seen by all modalities, or none by any."""

    def __post_init__(self):
        _require_positive(self, "unseen_variance", "max_steps")
        _require_not_negative(self, "min_increase")


@dataclasses.dataclass(frozen=True)
class DqnConfig:
    """The deep Q-network of each modality."""

    observe: Literal["live", "bank"] = "live"
    """`live` casts a scan in the environment's own arena at every step; `bank` draws from stored
    detections."""
    hidden: tuple[int, ...] = (24, 24)
    """Sizes of the hidden layers."""
    num_envs: int = 512
    """Environments that are stepped side by side."""
    epochs: int = 1000
    """Epochs; in each, every environment makes one step, and the network `updates` steps."""
    updates: int = 48
    """Gradient steps of one epoch."""
    batch: int = 512
    """Transitions of one gradient step."""
    replay_capacity: int = 512000
    """Transitions that the replay holds; a multiple of num_envs."""
    discount: float = 0.5
    """Discount factor, gamma."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    final_learning_rate: float = 1e-5
    """Learning rate of the last epoch; the way there is a cosine."""
    epsilon_start: float = 1.0
    """Chance of a random action in the first epoch."""
    epsilon_min: float = 0.01
    """Lowest chance of a random action."""
    epsilon_decay: float = 0.99
    """Factor on epsilon for each epoch."""
    target_period: int = 50
    """Epochs between two copies of the network to the target network."""
    num_starts: int = 8192
    """Start states that are prepared; each environment has a share of them, from which its episodes
    start. A multiple of num_envs."""
    chunk: int = 100
    """Epochs between two reports of progress."""

    def __post_init__(self):
        _require_sizes(self, "hidden")
        _require_positive(self, "num_envs", "epochs", "updates", "batch", "replay_capacity")
        _require_positive(self, "learning_rate", "target_period", "num_starts", "chunk")
        _require_not_negative(self, "final_learning_rate", "epsilon_start", "epsilon_min")
        _require(0 <= self.discount <= 1, self, "discount", "must be within 0 and 1")
        _require(0 < self.epsilon_decay <= 1, self, "epsilon_decay", "must be above 0, at most 1")
        _require(self.epsilon_start <= 1, self, "epsilon_start", "must be at most 1")
        _require(self.epsilon_min <= 1, self, "epsilon_min", "must be at most 1")
        _require(
            self.replay_capacity % self.num_envs == 0,
            self,
            "replay_capacity",
            f"must be a multiple of num_envs = {self.num_envs}",
        )
        _require(
            self.num_starts % self.num_envs == 0,
            self,
            "num_starts",
            f"must be a multiple of num_envs = {self.num_envs}",
        )
        _require(
            self.epochs % self.chunk == 0,
            self,
            "epochs",
            f"must be a multiple of chunk = {self.chunk}",
        )

    @property
    def shares(self) -> int:
        """Shares that environments and batch can be cut into, for example for several devices."""
        return math.gcd(self.num_envs, self.batch, _MOST_SHARES)

    @property
    def block(self) -> int:
        """Neighbouring environments whose transitions are drawn together, see `dqn.replay`."""
        return math.gcd(self.num_envs, self.batch) // self.shares


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """How the trained policies are examined."""

    num_starts: int = 512
    """Start states from which whole episodes are played."""
    num_repeats: int = 192
    """Episodes from each start state, over which the noise of detections is averaged; for
    the naive and the random policy an eighth of them."""

    def __post_init__(self):
        _require_positive(self, "num_starts", "num_repeats")


@dataclasses.dataclass(frozen=True)
class NavigationConfig:
    """How a robot finds its way: the paper's move_base, with the AMiRo's numbers."""

    horizon: float = 2.0
    """How far ahead a trajectory is rolled out, in seconds."""
    speed_samples: int = 6
    """Forward speeds that are tried, one of them backwards."""
    turn_samples: int = 21
    """Turn rates that are tried."""
    robot_radius: float = 0.1
    """Radius that a robot is given in planning, in metres; it measures 0.05."""
    inflation: float = 0.1
    """Distance to obstacles below which a way is held to be worse, in metres."""
    goal_distance: float = 0.2
    """How near a viewpoint counts as reached if the PoI is in view, in metres."""
    goal_angle: float = 6.0
    """Largest angle to the PoI at which a robot scans it, in degrees."""
    view_distances: tuple[float, ...] = (0.5, 0.9)
    """Distances of viewpoints from a PoI's centre, in metres."""
    view_sides: int = 16
    """Directions of viewpoints around a PoI."""
    view_range: float = 1.0
    """Longest distance from which a robot scans a PoI, in metres."""
    stuck_time: float = 6.0
    """Seconds without progress after which a robot backs off and tries another viewpoint."""
    recovery_time: float = 1.0
    """Seconds for which a robot backs off."""

    def __post_init__(self):
        _require_positive(self, "horizon", "robot_radius", "goal_distance", "goal_angle")
        _require(self.horizon >= 1.0, self, "horizon", "must be at least 1 s")
        _require_positive(self, "view_sides", "view_range", "stuck_time", "recovery_time")
        _require_not_negative(self, "inflation")
        _require(self.speed_samples >= 3, self, "speed_samples", "must be at least 3")
        odd = self.turn_samples >= 3 and self.turn_samples % 2 == 1
        _require(odd, self, "turn_samples", "must be odd and at least 3, so that one goes straight")
        _require(
            self.robot_radius > ROBOT_RADIUS, self, "robot_radius", f"must be above {ROBOT_RADIUS}"
        )
        _require(self.goal_angle <= 10, self, "goal_angle", "must be at most 10 degrees")
        _require(
            len(self.view_distances) > 0 and all(d > 0 for d in self.view_distances),
            self,
            "view_distances",
            "must be one or more distances, each greater than 0",
        )


@dataclasses.dataclass(frozen=True)
class MissionConfig:
    """The closed loop of all robots in one arena."""

    episodes: int = 128
    """Missions that are played with each policy at the end of a run."""
    time_limit: float = 120.0
    """Seconds after which a mission ends in any case."""
    control_period: float = 0.1
    """Seconds between two decisions of a robot; also between two scans."""
    equal_values: float = 0.1
    """Actions whose values differ by less than this from the best count as equally good, in inverse
    latent units; the robot takes the PoI that no other robot is heading for, and of these the
    nearest."""
    least_confidence: float = 0.95
    """Probability that a detector must give to its answer for it to be written into the map."""
    attempts: int = 3
    """Looks that detect nothing, or goals that are not reached, after which a robot gives a PoI
    up."""

    def __post_init__(self):
        _require_positive(self, "episodes", "time_limit", "control_period", "attempts")
        steps = self.control_period / 0.01
        _require(
            abs(steps - round(steps)) < 1e-6 and 5 <= round(steps) <= 20,
            self,
            "control_period",
            "must be a multiple of 0.01 s within 0.05 and 0.2 s",
        )
        _require(
            self.time_limit >= self.control_period, self, "time_limit", "must be a period or more"
        )
        _require_not_negative(self, "equal_values")
        _require(
            0 <= self.least_confidence < 1, self, "least_confidence", "must be at least 0, below 1"
        )


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of a run but its seed."""

    modalities: tuple[str, ...] = ("camera", "lidar")
    """The sensors, one robot each."""
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
        known = ", ".join(MODALITIES)
        if not self.modalities:
            raise ConfigError("modalities", self.modalities, f"must name one or more of {known}")
        for modality in self.modalities:
            if modality not in MODALITIES:
                raise ConfigError("modalities", self.modalities, f"must be some of {known}")
        if len(set(self.modalities)) != len(self.modalities):
            raise ConfigError("modalities", self.modalities, "must name no modality twice")
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


_PAPER = Config(
    jmvae=JmvaeConfig(
        alpha=1.0,
        beta=0.1,
        initial_beta=1.0,
        restarts=1,
        reconstruction_weights=(4.5, 4.5),
    ),
    mdp=MdpConfig(min_increase=0.01, partly_seen_starts=True),
    dqn=DqnConfig(
        observe="bank",
        discount=0.95,
        epochs=2000,
        updates=48,
        batch=512,
        replay_capacity=1024000,
        target_period=100,
    ),
)

_SMOKE = Config(
    detector=DetectorConfig(num_scans=3072, num_held_out=1536, steps=300, batch=128),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=512, steps=300, batch=128),
    dqn=DqnConfig(
        observe="bank",
        num_envs=32,
        epochs=60,
        chunk=20,
        batch=64,
        replay_capacity=2048,
        num_starts=64,
    ),
    evaluation=EvaluationConfig(num_starts=32, num_repeats=1),
    mission=MissionConfig(episodes=4, time_limit=60.0),
)

PRESETS: dict[str, Config] = {"default": Config(), "paper": _PAPER, "smoke": _SMOKE}
"""`default`: the best settings we know. `paper`: those of the paper, and those of its authors' code
where the paper is silent. `smoke`: the whole pipeline in seconds, for tests."""

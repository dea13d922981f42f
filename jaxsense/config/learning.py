"""Settings of learning: detectors, the JMVAE, the map MDP and its Q-networks."""

import math
from typing import Literal

from jaxsense.config.checks import (
    require,
    require_at_most,
    require_not_negative,
    require_positive,
    require_sizes,
    require_types,
)
from jaxsense.config.section import Traced, section

_MOST_BLOCKS = 32
_MOST_WEIGHT = 1_000_000


@section
class DetectorConfig:
    """The scanline detectors f_x and f_w."""

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    num_scans: int = 98304
    """Simulated scans to train on, per modality."""
    calibration: float = 0.0
    """Share of these scans that calibrates the detector instead: their likelihood sets the
    temperature of its probabilities."""
    num_held_out: int = 8192
    """Held-out simulated scans, to measure accuracy."""
    steps: int = 4000
    """Gradient steps."""
    batch: int = 512
    """Scans per gradient step."""
    learning_rate: Traced[float] = 2e-3
    """Highest learning rate of Adam; decays to zero by a cosine."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_sizes(self, "hidden")
        require_positive(self, "num_scans", "num_held_out", "steps", "batch", "learning_rate")
        require_at_most(self, learning_rate=1)
        reason = "must be at least 0, at most 0.5"
        require(0 <= self.calibration <= 0.5, self, "calibration", reason)

    def num_training(self, number: int) -> int:
        """How many of a number of scans are left to train on."""
        return number - math.ceil(self.calibration * number)


@section
class JmvaeConfig:
    """The joint multi-modal VAE."""

    latent_size: int = 2
    """Dimensions of the latent space, D_z."""
    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers of every encoder and decoder."""
    alpha: Traced[float] = 0.1
    """Weight of the divergence from the joint posterior to each subset's."""
    beta: Traced[float] = 0.001
    """Weight of the divergence from the joint posterior to the prior."""
    initial_beta: Traced[float] = 0.7
    """Start value of beta; far above beta, latent dimensions come into use one by one."""
    annealing: Traced[float] = 0.5
    """Share of the training during which beta falls from initial_beta to beta."""
    reconstruction_weights: Traced[tuple[float, ...]] = (10.0, 10.0)
    """Weight of each modality's reconstruction, in the order of `modalities`."""
    fusion: Literal["in_place", "filter"] = "in_place"
    """How a look is written into the map. `in_place` is the paper's: it replaces the entry.
    `filter` accumulates looks, see the section filter."""
    restarts: int = 3
    """Trainings from different random parameters; the one with the lowest loss is kept."""
    samples_per_class: int = 10000
    """Detections per class and modality in the training set."""
    steps: int = 3000
    """Gradient steps."""
    batch: int = 256
    """Sets of detections, one of each modality, per gradient step."""
    learning_rate: Traced[float] = 2e-3
    """Highest learning rate of Adam; decays to zero by a cosine."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_sizes(self, "hidden")
        require_positive(self, "latent_size", "samples_per_class", "steps", "batch")
        require_positive(self, "learning_rate", "restarts")
        require_positive(self, "beta", "initial_beta")
        require_not_negative(self, "alpha")
        require_at_most(self, latent_size=256, restarts=1000, learning_rate=1)
        require_at_most(self, alpha=_MOST_WEIGHT, beta=_MOST_WEIGHT, initial_beta=_MOST_WEIGHT)
        require(0 <= self.annealing <= 1, self, "annealing", "must be within 0 and 1")
        require(
            all(0 <= weight <= _MOST_WEIGHT for weight in self.reconstruction_weights),
            self,
            "reconstruction_weights",
            f"must be numbers within 0 and {_MOST_WEIGHT:,}",
        )


@section
class FilterConfig:
    """The filter, trained after the JMVAE if `jmvae.fusion` is `filter`."""

    hidden: tuple[int, ...] = (32,)
    """Sizes of the hidden layers of each modality's network."""
    looks: int = 6
    """Looks of a history in training."""
    steps: int = 2000
    """Gradient steps."""
    batch: int = 256
    """Histories per gradient step."""
    learning_rate: Traced[float] = 5e-3
    """Highest learning rate of Adam; decays to zero by a cosine."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_sizes(self, "hidden")
        require_positive(self, "looks", "steps", "batch", "learning_rate")
        require_at_most(self, looks=100, learning_rate=1)


@section
class MdpConfig:
    """The map of beliefs as a Markov decision process."""

    unseen_variance: Traced[float] = 20.0
    """Variance of each latent dimension of an unseen PoI."""
    reward: Literal["paper", "nats"] = "paper"
    """What a look is rewarded for. `paper`: the gain of 1 / ||sigma||, or -1, see `min_increase`.
    `nats`: the entropy of the classes that it removes, less `look_cost`; needs the filter."""
    look_cost: Traced[float] = 0.05
    """Cost of a look with the reward in nats."""
    min_increase: Traced[float] = 0.05
    """Gain of information, in inverse latent units, up to which a look's reward is -1."""
    max_steps: Traced[int] = 20
    """Longest episode, in actions."""
    partly_seen_starts: bool = False
    """Exclude starts in which all modalities have seen all PoIs, or none any."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "unseen_variance", "max_steps")
        require_not_negative(self, "min_increase", "look_cost")
        require_at_most(
            self, look_cost=_MOST_WEIGHT, unseen_variance=_MOST_WEIGHT, max_steps=10_000
        )


@section
class TravelConfig:
    """The model of travel: a robot turns to a PoI, drives straight until it is near, and looks."""

    speed: Traced[float] = 0.2
    """Speed of driving, in metres per second."""
    turn_rate: Traced[float] = 1.2
    """Rate of turning, in radians per second."""
    view_distance: Traced[float] = 0.96
    """Distance from which a robot looks at a PoI, in metres."""
    look_seconds: Traced[float] = 0.7
    """Time of a look itself, in seconds."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "speed", "turn_rate", "look_seconds")
        require_not_negative(self, "view_distance")


@section
class ToursConfig:
    """How a team learns in which order to visit its points, see `jaxsense.dqn.tours`."""

    states: int = 65536
    """States in which choices are tried, and a few more that fill the last chunk."""
    tries: int = 4
    """Choices tried in each state."""
    walk: Traced[int] = 8
    """Most choices before such a state."""
    steps: int = 3200
    """Gradient steps."""
    batch: int = 1024
    """States in one gradient step."""
    learning_rate: Traced[float] = 2e-3
    """Learning rate of Adam at the start; it falls to zero along a cosine."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "states", "steps", "batch", "learning_rate")
        require_not_negative(self, "walk")
        require(self.tries >= 2, self, "tries", "must be at least 2, to compare choices")
        require_at_most(self, walk=10_000, learning_rate=1)


@section
class TeamConfig:
    """The map MDP in which a team learns with `dqn.task` = team: with places, robots and time."""

    travel: TravelConfig = TravelConfig()
    """How long a robot takes to look at a point."""
    tours: ToursConfig = ToursConfig()
    """How it learns which point comes first."""
    num_pois: tuple[int, int] = (3, 8)
    """Fewest and most points of interest in an episode."""
    robots_each: int = 2
    """Most robots of each modality in an episode; the fewest is one."""
    sides: Traced[tuple[float, float]] = (3.0, 6.0)
    """Shortest and longest side of the arena of an episode, in metres."""
    alone: Traced[float] = 0.25
    """Share of episodes of the paper's MDP: one robot is alone, and nothing is far away."""
    partly_seen: Traced[float] = 0.5
    """Share of the other episodes that start with some looks taken."""
    second_cost: Traced[float] = 0.0
    """Price of a second, in units of the reward."""
    max_steps: Traced[int] = 300
    """Longest episode, in choices."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        fewest, most = self.num_pois
        expected = "must be a number greater than 0 and one that is not below it"
        require(1 <= fewest <= most, self, "num_pois", expected)
        require(most <= 64, self, "num_pois", "must be numbers from 1 to 64")
        require_positive(self, "robots_each", "max_steps")
        require_at_most(self, robots_each=8, max_steps=100_000)
        is_right = 0 < self.sides[0] <= self.sides[1] <= 100
        require(is_right, self, "sides", "must be two lengths of at most 100 m, the shorter first")
        for name in ("alone", "partly_seen"):
            require(0 <= getattr(self, name) <= 1, self, name, "must be within 0 and 1")
        require_not_negative(self, "second_cost")

    @property
    def cells_per_side(self) -> int:
        """Cells along a side of an arena, one of which each PoI has to itself."""
        return math.ceil(math.sqrt(2 * self.num_pois[1]))


@section
class DqnConfig:
    """The deep Q-network of each modality."""

    task: Literal["map", "team"] = "map"
    """`map`: an agent looks alone at `arena.num_pois` PoIs and looks take no time, as in the paper;
    a dense network for each modality. `team`: robots share the map, see the section team; one
    network for any number of PoIs and robots."""
    observe: Literal["live", "bank"] = "live"
    """`live` casts a scan in the environment's own arena at every step; `bank` draws from stored
    detections."""
    hidden: tuple[int, ...] = (24, 24)
    """Sizes of the hidden layers."""
    num_envs: int = 512
    """Environments that step side by side."""
    epochs: int = 800
    """Epochs, each of one step per environment and `updates` gradient steps."""
    updates: int = 64
    """Gradient steps per epoch."""
    batch: int = 512
    """Transitions per gradient step."""
    replay_capacity: int = 512000
    """Capacity of the replay, in transitions; a multiple of num_envs."""
    discount: Traced[float] = 0.5
    """Discount factor, gamma: of a step, or with `task` = team of a second."""
    learning_rate: Traced[float] = 1e-3
    """Learning rate of Adam."""
    final_learning_rate: Traced[float] = 1e-5
    """Learning rate of the last epoch, reached along a cosine."""
    epsilon_start: Traced[float] = 1.0
    """Probability of a random action in the first epoch, epsilon."""
    epsilon_min: Traced[float] = 0.01
    """Lowest probability of a random action."""
    epsilon_decay: Traced[float] = 0.99
    """Factor on epsilon per epoch."""
    target_period: Traced[int] = 50
    """Epochs between updates of the target network."""
    num_starts: int = 8192
    """Start states, prepared once and shared out among the environments; a multiple of num_envs."""
    chunk: int = 100
    """Epochs between reports of progress."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_sizes(self, "hidden")
        require_positive(self, "num_envs", "epochs", "updates", "batch", "replay_capacity")
        require_positive(self, "learning_rate", "target_period", "num_starts", "chunk")
        require_not_negative(self, "final_learning_rate", "epsilon_start", "epsilon_min")
        require(0 <= self.discount <= 1, self, "discount", "must be within 0 and 1")
        require(0 < self.epsilon_decay <= 1, self, "epsilon_decay", "must be above 0, at most 1")
        require_at_most(self, learning_rate=1, final_learning_rate=1)
        require_at_most(self, epsilon_start=1)
        require(
            self.epsilon_min <= self.epsilon_start,
            self,
            "epsilon_min",
            f"must be at most epsilon_start = {self.epsilon_start}",
        )
        require(
            self.replay_capacity % self.num_envs == 0,
            self,
            "replay_capacity",
            f"must be a multiple of num_envs = {self.num_envs}",
        )
        require(
            self.num_starts % self.num_envs == 0,
            self,
            "num_starts",
            f"must be a multiple of num_envs = {self.num_envs}",
        )
        require(
            self.epochs % self.chunk == 0,
            self,
            "epochs",
            f"must be a multiple of chunk = {self.chunk}",
        )

    @property
    def block(self) -> int:
        """Size of a block of environments in the replay, see `dqn.replay`."""
        return math.gcd(self.num_envs, self.batch) // math.gcd(
            self.num_envs, self.batch, _MOST_BLOCKS
        )


@section
class EvaluationConfig:
    """Evaluation of the trained policies."""

    num_starts: int = 512
    """Start states of the episodes."""
    num_repeats: Traced[int] = 96
    """Episodes per start state, to average over the noise of detections; an eighth as many for the
    naive and the random policy."""

    num_histories: int = 8190
    """Random histories of looks at a PoI, after which the map is compared with exact Bayes."""
    num_pois: tuple[int, ...] = ()
    """Further numbers of PoIs for which a team's policy is compared with the optimum of the map
    MDP."""
    num_states: int = 4096
    """Most states of the map in which policies are compared, one by one; of more, as many at even
    distances."""
    value_points: int = 2048
    """Most points of the lattice on which the values of looks stand, see `dqn.optimum`."""
    value_looks: int = 32
    """Looks at each class that stand for all looks in these values."""

    def check(self) -> None:
        """Raises `ConfigError` for an invalid field."""
        require_types(self)
        require_positive(self, "num_starts", "num_repeats", "num_states", "num_histories")
        require_positive(self, "value_points", "value_looks")
        is_right = all(0 < number <= 64 for number in self.num_pois)
        require(is_right, self, "num_pois", "must be numbers from 1 to 64")
        require_at_most(
            self,
            num_histories=10_000_000,
            num_states=100_000,
            value_points=100_000,
            value_looks=10_000,
        )

"""Settings of learning: detectors, the JMVAE, the MDPs and their Q-networks."""

import math
from typing import Literal

from jaxsense.config.section import Section, Traced, is_function_name, limited, require

PROFILE = 64
"""Numbers in a LiDAR's window as a network of scans sees it, see `vae.frames`."""
LOOKS_TOGETHER = 4
"""Looks by each sensor at a PoI in an example for a JMVAE that learns from scans."""
LOOK_SECONDS = 0.45
"""Duration of a robot's look, in seconds."""
_MAX_BLOCKS = 32
_MOST_IN_CHUNK = 100  # epochs
_STARTS_EACH = 16
_POINTS_PER_LOOK = 64
_MAX_WEIGHT = 1_000_000
_MAX_UNITS = 65_536  # of a layer; XLA aborts where a product of sizes overflows


class DetectorConfig(Section, place="detector"):
    """The detectors, which classify scanlines; f_x and f_w in the paper.

    Attributes:
      hidden: Sizes of the hidden layers; not used if the JMVAE learns from scans.
      num_scans: Simulated scans to train on, per modality.
      calibration: Share of these scans that is set aside to calibrate the detector, or the encoder
        if the JMVAE learns from scans: the temperature of its probabilities is fitted by maximum
        likelihood.
      num_held_out: Simulated scans for measuring the accuracy.
      num_repeats: Scenes in which each sensor looks at a PoI several times, to learn how much of a
        look is new after others nearby, see `core.novelty`. With 0, every look counts in full.
      steps: Gradient steps.
      batch: Scans per gradient step.
      learning_rate: Initial learning rate of Adam; decays to zero along a cosine.
    """

    hidden: tuple[int, ...] = limited((64, 64), at_least=1, at_most=_MAX_UNITS, min_items=1)
    num_scans: int = limited(98304, at_least=1)
    calibration: float = limited(0.0, at_least=0, at_most=0.5)
    num_held_out: int = limited(8192, at_least=1)
    num_repeats: int = limited(0, at_least=0, at_most=1_000_000)
    steps: int = limited(4000, at_least=1)
    batch: int = limited(512, at_least=1)
    learning_rate: Traced[float] = limited(2e-3, above=0, at_most=1)

    def num_training(self, number: int) -> int:
        """How many of a number of scans are left to train on, or of groups of them."""
        return number - math.ceil(self.calibration * number)


class JmvaeConfig(Section, place="jmvae"):
    """The joint multi-modal VAE.

    Attributes:
      learns_from: Training data of the JMVAE. `scans` needs neither detectors nor labels: looks are
        grouped by PoI, and the encoders serve as detectors, see `jaxsense.vae.leave_one_out`.
        `jmvae.fusion` must then be `filter`.
      latent_size: Dimensions of the latent space, D_z.
      hidden: Sizes of the hidden layers of every encoder and decoder.
      alpha: Weight of the divergence from the joint posterior to each subset's.
      beta: Weight of the divergence from the joint posterior to the prior.
      initial_beta: Initial value of beta. If far above `beta`, latent dimensions come into use one
        by one.
      annealing: Share of the training during which beta changes from `initial_beta` to `beta`.
      reconstruction_weights: Weight of each modality's reconstruction, in the order of
        `modalities`.
      fusion: How a look updates a belief. `in_place`, as in the paper, keeps the last look of each
        sensor. `filter` accumulates looks, see section `filter`.
      restarts: Number of times to train, from different random parameters. The run keeps the result
        with the lowest loss among those whose beliefs reproduce class probabilities exactly, or
        among all if the JMVAE learns from scans.
      samples_per_class: Detections per class and modality in the training set.
      steps: Gradient steps.
      batch: Sets of detections, one of each modality, per gradient step; if the JMVAE learns from
        scans, PoIs per gradient step.
      learning_rate: Initial learning rate of Adam; decays to zero along a cosine.
    """

    learns_from: Literal["detections", "scans"] = "detections"
    latent_size: int = limited(2, at_least=1, at_most=256)
    hidden: tuple[int, ...] = limited((64, 64), at_least=1, at_most=_MAX_UNITS, min_items=1)
    alpha: Traced[float] = limited(0.1, at_least=0, at_most=_MAX_WEIGHT)
    beta: Traced[float] = limited(0.001, above=0, at_most=_MAX_WEIGHT)
    initial_beta: Traced[float] = limited(0.7, above=0, at_most=_MAX_WEIGHT)
    annealing: Traced[float] = limited(0.5, at_least=0, at_most=1)
    reconstruction_weights: Traced[tuple[float, ...]] = limited(
        (10.0, 10.0), at_least=0, at_most=_MAX_WEIGHT, min_items=1
    )
    fusion: Literal["in_place", "filter"] = "in_place"
    restarts: int = limited(3, at_least=1, at_most=1000)
    samples_per_class: int = limited(10000, at_least=1)
    steps: int = limited(3000, at_least=1)
    batch: int = limited(256, at_least=1)
    learning_rate: Traced[float] = limited(2e-3, above=0, at_most=1)

    def check(self) -> None:
        """Checks that the fusion fits what is learned; raises `ConfigError`."""
        fits = not self.reads_scans or self.fusion == "filter"
        expected = f"must be filter, because learns_from = {self.learns_from}"
        require(fits, self, "fusion", expected)

    @property
    def reads_scans(self) -> bool:
        """Whether the JMVAE learns from scans, so that its encoders read no features."""
        return self.learns_from == "scans"

    @property
    def num_together(self) -> int:
        """Looks by each sensor at a PoI in one training example."""
        return LOOKS_TOGETHER if self.reads_scans else 1


class FilterConfig(Section, place="filter"):
    """The filter, trained after the JMVAE if `jmvae.fusion` is `filter`.

    Attributes:
      steps: Gradient steps.
    """

    steps: int = limited(2000, at_least=1)


class MdpConfig(Section, place="mdp"):
    """The map MDP, a Markov decision process whose states are maps of beliefs.

    Attributes:
      reward: Reward of a look. `paper`: the gain of 1 / ||sigma||, or -1, see `min_increase`.
        `nats`: the information gained about the class, minus `look_cost`.
        `package.module:function`: the `dqn.Reward` that this function makes from an `MdpConfig`.
      look_cost: Cost of a look, in nats; only with the reward `nats`.
      min_increase: Threshold of the reward `paper`: a look that gains no more information than
        this, in inverse latent units, is rewarded with -1.
      max_steps: Maximum length of an episode with `dqn.task` = `map`, in actions.
      partly_seen_starts: Whether to exclude starts where every modality has seen every PoI, or none
        has seen any.
    """

    reward: str = "paper"
    look_cost: Traced[float] = limited(0.05, at_least=0, at_most=_MAX_WEIGHT)
    min_increase: Traced[float] = limited(0.05, at_least=0)
    max_steps: Traced[int] = limited(20, at_least=1, at_most=10_000)
    partly_seen_starts: bool = False

    def check(self) -> None:
        """Checks that `reward` is known or can be the name of a function; raises `ConfigError`."""
        is_named = self.reward in ("paper", "nats") or is_function_name(self.reward)
        require(is_named, self, "reward", "must be paper, nats or package.module:function")


class TeamConfig(Section, place="team"):
    """The MDP with travel (`dqn.task` = team), in which robots have positions and looks take time.

    Attributes:
      num_pois: Minimum and maximum number of PoIs in an episode.
      sides: Shortest and longest side of an episode's arena, in metres.
      second_cost: Cost of each second in which a robot works, in units of the reward.
    """

    num_pois: tuple[int, int] = limited((2, 4), at_least=1, at_most=64)
    sides: Traced[tuple[float, float]] = limited((3.0, 4.0), above=0, at_most=100)
    second_cost: Traced[float] = limited(0.0, at_least=0)

    def check(self) -> None:
        """Checks that each minimum is at most its maximum; raises `ConfigError`."""
        for field, (least, most) in {"num_pois": self.num_pois, "sides": self.sides}.items():
            require(least <= most, self, field, "must be a minimum and a maximum, in this order")

    @property
    def cells_per_side(self) -> int:
        """Cells along a side of an arena, each of which holds at most one PoI."""
        return math.ceil(math.sqrt(2 * self.num_pois[1]))


class DqnConfig(Section, place="dqn"):
    """Deep Q-learning, with one network for each modality or for a team.

    Attributes:
      task: MDP to learn. `map`: a single agent looks at `arena.num_pois` PoIs, and looks take no
        time, as in the paper; each modality has a dense network. `team`: robots share the map, see
        section `team`; one network serves any number of PoIs and robots.
      observe: Source of looks. `live` casts a scan in the environment's own arena at every step;
        `bank` draws stored detections, which is faster.
      hidden: Sizes of the hidden layers.
      num_envs: Number of environments that step in parallel.
      epochs: Number of epochs, each of one step per environment and `dqn.updates` gradient steps.
      updates: Gradient steps per epoch.
      batch: Transitions per gradient step.
      replay_capacity: Capacity of the replay memory, in transitions; a multiple of `num_envs`.
      discount: Discount factor, gamma: per step, or per second with `dqn.task` = `team`.
      learning_rate: Initial learning rate of Adam; decays to a hundredth along a cosine.
      epsilon_min: Minimum probability of a random action, epsilon, which starts at 1.
      epsilon_decay: Factor on epsilon per epoch.
      target_period: Epochs between updates of the target network.
    """

    task: Literal["map", "team"] = "team"
    observe: Literal["live", "bank"] = "bank"
    hidden: tuple[int, ...] = limited((32, 32), at_least=1, at_most=_MAX_UNITS, min_items=1)
    num_envs: int = limited(512, at_least=1)
    epochs: int = limited(150, at_least=1)
    updates: int = limited(16, at_least=1)
    batch: int = limited(512, at_least=1)
    replay_capacity: int = limited(131072, at_least=1)
    discount: Traced[float] = limited(0.2, at_least=0, at_most=1)
    learning_rate: Traced[float] = limited(1e-3, above=0, at_most=1)
    epsilon_min: Traced[float] = limited(0.05, at_least=0, at_most=1)
    epsilon_decay: Traced[float] = limited(0.99, above=0, at_most=1)
    target_period: Traced[int] = limited(5, at_least=1)

    def check(self) -> None:
        """Checks that chunks are long and all environments fill the replay together."""
        is_even = self.epochs <= _MOST_IN_CHUNK or self.chunk >= 10
        require(is_even, self, "epochs", f"must have a divisor from 10 to {_MOST_IN_CHUNK}")
        is_multiple = self.replay_capacity % self.num_envs == 0
        expected = f"must be a multiple of num_envs = {self.num_envs}"
        require(is_multiple, self, "replay_capacity", expected)

    @property
    def chunk(self) -> int:
        """Epochs between reports of progress, which divide all epochs."""
        if self.epochs <= _MOST_IN_CHUNK or self.epochs % 10 == 0:
            return math.gcd(self.epochs, _MOST_IN_CHUNK)
        return max(n for n in range(1, _MOST_IN_CHUNK + 1) if self.epochs % n == 0)

    @property
    def num_starts(self) -> int:
        """Start states, prepared once and divided among the environments."""
        return _STARTS_EACH * self.num_envs

    @property
    def block(self) -> int:
        """Size of a block of environments in the replay, see `dqn.replay`."""
        shared = math.gcd(self.num_envs, self.batch)
        return shared // math.gcd(shared, _MAX_BLOCKS)


class EvaluationConfig(Section, place="evaluation"):
    """Evaluation of the trained policies.

    Attributes:
      num_starts: Number of start states of the episodes.
      num_repeats: Episodes per start state, to average over the noise of detections; an eighth as
        many for all policies but the learned and the optimal one.
      num_histories: Random sequences of looks at a PoI, after which the map is compared with exact
        Bayes.
      num_pois: Further numbers of PoIs for which a team's policy is compared with the optimum of
        the map MDP.
      num_states: Maximum number of map states in which policies are compared; if there are more, a
        stratified sample of them.
      value_looks: Sample looks per class that approximate the distribution of looks.
    """

    num_starts: int = limited(512, at_least=1)
    num_repeats: Traced[int] = limited(48, at_least=1)
    num_histories: int = limited(8190, at_least=1, at_most=10_000_000)
    num_pois: tuple[int, ...] = limited((), at_least=1, at_most=64)
    num_states: int = limited(4096, at_least=1, at_most=100_000)
    value_looks: int = limited(32, at_least=1, at_most=10_000)

    @property
    def value_points(self) -> int:
        """Maximum size of the grid on which look values are tabulated, see `dqn.optimum`."""
        return _POINTS_PER_LOOK * self.value_looks

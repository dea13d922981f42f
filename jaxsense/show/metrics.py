"""The table of metrics, shared by the terminal, the page, the plots and the docs."""

import dataclasses
from collections.abc import Iterable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Metric:
    """A metric in a block of `summary.json`.

    Attributes:
      key: its place in the block; a dot leads into an inner block.
      label: its name.
      meaning: what it measures; empty if the label is enough.
      paper: the paper's value; with a star, the output of its authors' code.
      digits: after the point.
    """

    key: str
    label: str
    meaning: str = ""
    paper: str = ""
    digits: int = 3

    @property
    def block(self) -> str:
        """The first part of its key."""
        return self.key.split(".")[0]

    def text(self, block: dict[str, Any]) -> str:
        """Its value in a block, or of several seeds the mean and its 95% interval."""
        value: Any = block
        for part in self.key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return text(value, self.digits)


DETECTORS = (
    Metric(
        "accuracy",
        "detector: accuracy",
        "Share of scans, from scenes it was not trained on, that it labels correctly.",
        digits=4,
    ),
    Metric(
        "ece",
        "detector: calibration error",
        "Expected difference between a detector's confidence and its accuracy.",
        digits=4,
    ),
    Metric(
        "nll",
        "detector: NLL",
        "Mean negative logarithm of the right label's probability, in nats.",
        digits=4,
    ),
)
"""`summary["detectors"][MODALITY]`."""

AGENTS = (
    Metric(
        "return",
        "episode: DQN, greedy",
        "Total reward of the Q-network's greedy policy in an episode.",
        "Fig. 5",
    ),
    Metric(
        "optimal",
        "episode: optimal",
        "The policy that knows what each look is worth on average; of a filter's map, by dynamic "
        "programming.",
        "0.550*",
    ),
    Metric("naive", "episode: naive", "Looks at every point once, whatever the map holds."),
    Metric("random", "episode: random", "Looks anywhere, or ends, at random."),
    Metric("fraction_of_optimal", "fraction of optimal", "DQN over optimal."),
    Metric(
        "optimal_states",
        "optimal in states",
        "States of the map where the policy's reward is within 0.01 of the optimum.",
        digits=1,
    ),
    Metric(
        "num_states",
        "states of the map",
        "Every combination of classes and looks; at most 4,096 are examined.",
        digits=0,
    ),
    Metric(
        "optimal_permutations",
        "optimal in permutations",
        "Of these states, those in which all points are of different classes.",
        digits=1,
    ),
    Metric("num_permutations", "permutations", paper="384", digits=0),
    Metric(
        "one_step.policy",
        "one step: DQN",
        "Reward of the first step alone, as in the authors' code, which has other features.",
        "0.340, 0.385*",
    ),
    Metric("one_step.optimal", "one step: optimal", "The optimal policy's first step.", "0.426*"),
    Metric("one_step.random", "one step: random", "A random first step.", "-0.302*"),
    Metric("env_steps", "steps of training", "Of all environments together.", "2,000 epochs", 0),
    Metric("env_steps_per_s", "steps per second", "Of all environments, with learning.", digits=0),
)
"""`summary["dqn"][MODALITY]`."""

LATENT_SPACE = (
    Metric(
        "active_units",
        "dimensions in use",
        "Of the latent space; one of two in the paper's Fig. 4.",
        "1",
        1,
    ),
    Metric(
        "fusion.accuracy",
        "fusion: right class",
        "Share of map entries that show the true class, after one sensor and then another.",
        digits=4,
    ),
    Metric(
        "fusion.mean_error",
        "fusion: error",
        "Distance of these entries from both sensors' joint belief, in standard deviations.",
    ),
    Metric(
        "fusion.std_error",
        "fusion: error of sigma",
        "Mean of |log(sigma ratio)| between these entries and the joint belief.",
    ),
    Metric(
        "moment_matching_error",
        "error of moments",
        "Distance of a sensor's belief from the best single Gaussian over the classes that remain "
        "possible.",
        "0 in theory",
    ),
)
"""`summary["jmvae"]`."""

SIGMA_NORM = (
    Metric(
        "unambiguous",
        "sigma norm, unambiguous",
        "Uncertainty of beliefs in a single class (Fig. 4); the preset paper is fitted to it.",
        "from 1.05",
    ),
    Metric(
        "ambiguous",
        "sigma norm, ambiguous",
        "Uncertainty of beliefs between classes that a sensor cannot distinguish.",
        "to 1.25",
    ),
)
"""The range of `summary["jmvae"]["sigma_norm"]`, over the classes that each row is about."""

BELIEFS = (
    Metric(
        "doubt_correlation",
        "doubt",
        "Correlation of the norm of sigma with the entropy of the exact posterior.",
    ),
)
"""`summary["belief"]`."""

MISSIONS = (
    Metric(
        "accuracy",
        "accuracy",
        "Share of points whose most likely class in the finished map is right.",
    ),
    Metric(
        "observations_per_poi",
        "looks per point",
        "Fewer are better.",
        digits=2,
    ),
    Metric("time_s", "time [s]", "Median time until all robots have ended.", digits=1),
    Metric(
        "mean_time_s",
        "mean time [s]",
        "The same as a mean, which long missions lift above the median.",
        digits=1,
    ),
    Metric(
        "of_naive.observations_per_poi",
        "looks of naive's",
        "Looks over those that naive exploration needs for the same accuracy, between its one, two "
        "and three looks of each robot at each point; over three if these are less accurate.",
        digits=2,
    ),
    Metric("of_naive.time_s", "time of naive's", "The same for the median time.", digits=2),
    Metric("of_naive.mean_time_s", "mean time of naive's", "The same for the mean time.", digits=2),
    Metric(
        "collisions", "collisions", "Control periods in which a robot touched something.", digits=0
    ),
    Metric(
        "goals_reached_fraction",
        "goals reached",
        "Share of chosen viewpoints that robots reached.",
    ),
    Metric(
        "intervals.accuracy",
        "accuracy, difference",
        "From the latent policy, arena by arena: mean and 95% interval.",
    ),
    Metric("intervals.observations_per_poi", "looks, difference", "The same.", digits=2),
    Metric("intervals.time_s", "time, difference [s]", "The same, of the mean.", digits=1),
    Metric("information", "information", "Sum of 1 / sigma norm over the finished map.", digits=2),
    Metric(
        "told",
        "right labels",
        "One robot alone: share of points whose colour, or shape, the map shows rightly.",
    ),
    Metric(
        "ambiguous_reported",
        "ambiguous",
        "One robot alone: of the points that it cannot distinguish, the share shown as ambiguous.",
    ),
    Metric("episodes", "missions", digits=0),
    Metric("seed", "seed", "Of the arenas; none if the run itself played the missions.", digits=0),
)
"""`summary["mission"][POLICY]`."""

BLOCKS = {
    "detectors.MODALITY": DETECTORS,
    "jmvae": LATENT_SPACE,
    "jmvae.sigma_norm": SIGMA_NORM,
    "belief": BELIEFS,
    "dqn.MODALITY": AGENTS,
    "mission.POLICY": MISSIONS,
}
"""The metrics by their block of `summary.json`."""

_PAGE_ONLY = {
    *("one_step.policy", "one_step.optimal", "one_step.random", "env_steps"),
    *("intervals.accuracy", "intervals.observations_per_poi", "intervals.time_s"),
    *("mean_time_s", "of_naive.mean_time_s"),
    *("information", "told", "ambiguous_reported", "episodes", "seed"),
}


def headline(metrics: Iterable[Metric]) -> list[Metric]:
    """The metrics that fit into a terminal."""
    return [metric for metric in metrics if metric.key not in _PAGE_ONLY]


def label(key: str) -> str:
    """The name of one of `AGENTS`."""
    return next(metric.label for metric in AGENTS if metric.key == key)


def cases(block: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The cases in a summary's block `mission`."""
    return {name: case for name, case in block.items() if name != "bytes_per_detection"}


def mean(value: Any) -> float:
    """A number, or the mean of several seeds."""
    return value["mean"] if isinstance(value, dict) else value


def text(value: Any, digits: int = 3) -> str:
    """A number, or a mean and its interval if it has one, as text; a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        ends = (mean(value.get(name)) for name in ("mean", "low", "high"))
        average, low, high = (text(None if x is None else float(x), digits) for x in ends)
        return average if low == high else f"{average} ({low} to {high})"
    return f"{value:,}" if isinstance(value, int) else f"{value:,.{digits}f}"

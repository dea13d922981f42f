"""What `summary.json` holds: each key with its type, its name, its meaning and its digits.

The page, the plots, the terminal and the docs read this table. Of several seeds, an `Interval`
stands in place of each number.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, NotRequired, TypedDict, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_block

from jaxsense.mission.outcome import is_fault


class Interval(TypedDict):
    """A mean and its 95% interval by Student's t; a single value has no interval."""

    mean: float
    low: float | None
    high: float | None


Maybe = float | None
Number = float | Interval
"""A number of a run, or the mean and the interval of several seeds."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """One value of a block.

    Attributes:
      label: its name.
      meaning: what it measures; empty if the label is enough.
      digits: after the point.
      key: its place in the block, which names it; a dot leads into an inner block.
    """

    label: str
    meaning: str = ""
    digits: int = 3
    key: str = ""

    def value(self, block: Mapping[str, object]) -> object:
        """Its value in a block; None if there is none."""
        value: object = block
        for part in self.key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def text(self, block: Mapping[str, object]) -> str:
        """Its value in a block as text, see `text`."""
        return text(self.value(block), self.digits)


def mean(value: Number) -> float:
    """A number, or the mean of several seeds."""
    return value if isinstance(value, int | float) else value["mean"]


def text(value: object, digits: int = 3) -> str:
    """A number, with its interval, which no line breaks, if it has one; a hyphen for None.

    Whole numbers have no digits after the point.
    """
    if isinstance(value, Mapping):
        middle, low, high = (text(value.get(name), digits) for name in ("mean", "low", "high"))
        return middle if low == "-" else f"{middle} ({low}\u00a0to\u00a0{high})"
    if isinstance(value, float):
        return f"{round(value, digits) + 0.0:,.{digits}f}"  # no "-0.00"
    return f"{value:,}" if isinstance(value, int) else "-"


PerClass = dict[str, list[float]]
"""For `joint` and for each modality `[C]` numbers, in the order of `arena.classes`."""


class StageTiming(TypedDict):
    """`timing.stages.STAGE`; stages of one program share an entry."""

    compile_s: Annotated[float, Metric("compile [s]", digits=2)]
    run_s: Annotated[float, Metric("run [s]", digits=2)]


class Timing(TypedDict):
    """`timing`; stages overlap."""

    total_s: Annotated[float, Metric("total time [s]", "Duration after imports.", 1)]
    stages: dict[str, StageTiming]


class Detector(TypedDict):
    """`detectors.MODALITY`, on looks at held-out scenes."""

    accuracy: Annotated[float, Metric("accuracy", "Share of looks with the right label.", 4)]
    ece: Annotated[float, Metric("calibration error", "Expected calibration error (ECE).", 4)]
    nll: Annotated[float, Metric("NLL", "Mean -log p of the right label, in nats.", 4)]


class Fusion(TypedDict):
    """`jmvae.fusion`: beliefs after one sensor's look and then another's; null with one sensor."""

    accuracy: Annotated[Maybe, Metric("fusion: right", "Share of right classes.", 4)]
    mean_error: Annotated[Maybe, Metric("fusion: error", "From the joint mean, in sigmas.")]
    std_error: Annotated[Maybe, Metric("fusion: error of sigma", "Log-ratio to the joint one.")]


class Jmvae(TypedDict):
    """`jmvae`: the latent space."""

    active_units: Annotated[int, Metric("dimensions in use", "They vary between classes.")]
    sigma_norm: Annotated[PerClass, Metric("sigma norm", "By all sensors (`joint`) and by each.")]
    unambiguous: Annotated[
        dict[str, list[bool]],
        Metric("unambiguous", "Whether over 90% of looks leave only this class (Table I)."),
    ]
    consistent: Annotated[PerClass, Metric("consistent", "Looks that leave what looks alike.")]
    moment_matching_error: Annotated[float, Metric("error of moments", "From the best Gaussian.")]
    readout_error: Annotated[float, Metric("error of the readout", "Nats lost by storing.", 4)]
    fusion: Fusion


class Beliefs(TypedDict):
    """`belief`: the map after random looks at one PoI, compared with exact Bayes on them."""

    looks: Annotated[list[int], Metric("looks", "Number of looks at the PoI, 1 to 6.")]
    nll: Annotated[list[float], Metric("NLL of the map", "Mean -log p of the true class.")]
    bayes_nll: Annotated[list[float], Metric("NLL of exact Bayes")]
    accuracy: Annotated[list[float], Metric("accuracy of the map")]
    bayes_accuracy: Annotated[list[float], Metric("accuracy of exact Bayes")]
    doubt_correlation: Annotated[float, Metric("sigma and uncertainty", "Their correlation.")]


Returns = TypedDict(
    "Returns",
    {
        "return": Annotated[float, Metric("Q-network", "Reward without exploration.")],
        "optimal": Annotated[Maybe, Metric("optimal", "Null if it is unknown.")],
        "greedy": Annotated[float, Metric("greedy", "Takes the look with the highest gain.")],
        "naive": Annotated[float, Metric("naive", "Looks once at each PoI.")],
        "random": Annotated[float, Metric("random", "Takes any action.")],
        "fraction_of_optimal": Annotated[Maybe, Metric("of optimal", "Share of the optimum.")],
    },
)
"""Mean rewards of episodes on the map, from random starts."""


class OneStep(TypedDict):
    """`dqn.MODALITY.one_step`: the reward of the first step, as in the authors' code."""

    policy: Annotated[float, Metric("one step: Q-network", "Reward of the first step.")]
    optimal: Annotated[Maybe, Metric("one step: optimal")]
    random: Annotated[float, Metric("one step: random")]


class Agent(Returns):
    """`dqn.MODALITY`: a robot alone on the map."""

    one_step: OneStep
    optimal_states: Annotated[int | None, Metric("optimal in", "States, within 0.01.", 1)]
    num_states: Annotated[int, Metric("states", "Combinations of classes and looks.", 0)]
    optimal_permutations: Annotated[int | None, Metric("optimal permutations", digits=1)]
    num_permutations: Annotated[int, Metric("permutations", "All classes differ.", 0)]
    other_numbers: NotRequired[
        Annotated[dict[str, Returns], Metric("other numbers", "With `evaluation.num_pois` PoIs.")]
    ]
    env_steps: Annotated[int, Metric("steps of training", "Of all environments.", 0)]
    env_steps_per_s: Annotated[float, Metric("steps per second", "Of training.", 0)]


class Differences(TypedDict):
    """`mission.POLICY.intervals`: from the latent policy, arena by arena, with 95% intervals."""

    accuracy: Annotated[Interval, Metric("right, difference")]
    observations_per_poi: Annotated[Interval, Metric("looks, difference", "In looks per PoI.", 2)]
    time_s: Annotated[Interval, Metric("mean time, difference [s]", digits=1)]


class Calibration(TypedDict):
    """`mission.POLICY.calibration`: maps at the end of missions, PoIs that were detected."""

    confidence: Annotated[Maybe, Metric("confidence", "Mean, of the most likely class.")]
    accuracy: Annotated[Maybe, Metric("right, of detected", "Share of detected PoIs.")]
    nll: Annotated[Maybe, Metric("NLL of the maps", "Mean -log p of the true class.")]


class Case(TypedDict):
    """`mission.POLICY`: missions of one policy, or with a robot that fails."""

    accuracy: Annotated[float, Metric("right", "Share of PoIs whose most likely class is right.")]
    observations_per_poi: Annotated[float, Metric("looks per PoI", "Mean number of looks.", 2)]
    time_s: Annotated[float, Metric("median time [s]", "Until all robots are done.", 1)]
    mean_time_s: Annotated[float, Metric("mean time [s]", "Until all robots are done.", 1)]
    collisions: Annotated[int, Metric("collisions", "Number of control periods with contact.", 0)]
    goals_reached_fraction: Annotated[Maybe, Metric("goals reached", "Share of all goals.")]
    information: Annotated[float, Metric("information", "Sum of 1 / sigma norm over the map.", 2)]
    calibration: Calibration
    episodes: Annotated[int, Metric("missions", "Number of missions.", 0)]
    ended: Annotated[dict[str, int], Metric("ends", "Number of missions with each kind of end.")]
    told: NotRequired[Annotated[float, Metric("right labels", "Of a robot alone.")]]
    ambiguous_reported: NotRequired[
        Annotated[Maybe, Metric("reported as ambiguous", "Share of PoIs of confusable classes.")]
    ]
    seed: NotRequired[Annotated[int, Metric("seed", "Seed of the arenas of an evaluation.")]]
    intervals: NotRequired[Differences]


Missions = dict[str, Case]
"""`mission`: the cases by name, policies and robots that fail."""


class TrainingBlocks(TypedDict):
    """The blocks of a summary that come from a training."""

    detectors: dict[str, Detector]
    jmvae: Jmvae
    belief: Beliefs
    dqn: dict[str, Agent]


class Results(TrainingBlocks):
    """The blocks of a summary that come from a training and its missions."""

    mission: Missions


class Origin(TypedDict):
    """How figures were made."""

    versions: Annotated[dict[str, str], Metric("versions", "Versions of Python and of libraries.")]
    devices: Annotated[list[str], Metric("devices", "Kind of each accelerator, or `cpu`.")]
    # Figures of earlier versions lack the next four; the last is only known in a checkout.
    cores: NotRequired[Annotated[int, Metric("cores", "CPU cores of the machine.", 0)]]
    date: NotRequired[Annotated[str, Metric("date", "Day on which the figures were finished.")]]
    source: NotRequired[Annotated[str, Metric("source", "Digest of the code of jaxsense.")]]
    commit: NotRequired[Annotated[str, Metric("commit", "Commit of the source tree.")]]


class Evaluation(TypedDict):
    """Missions of `evaluate` in the same arenas: `RUN/evaluations/NAME.json`."""

    num_pois: Annotated[int, Metric("PoIs", "Number of points of interest.", 0)]
    side: Annotated[float, Metric("side [m]", "Side of the arena.", 2)]
    robots: Annotated[list[str], Metric("robots", "Modality of each robot.")]
    # Those of earlier versions may lack it.
    origin: NotRequired[Origin]
    mission: Missions


class Gospa(TypedDict):
    """`found.POLICY.gospa`, with a cutoff of .3 m and p = 1, in metres a mission."""

    total: Annotated[float, Metric("GOSPA [m]", "Sum of the three errors of the map.")]
    localisation: Annotated[float, Metric("of places [m]")]
    missed: Annotated[float, Metric("of what is missing [m]")]
    false: Annotated[float, Metric("of what is not there [m]")]


class PositionError(TypedDict):
    """`found.POLICY.position_error`, of the PoIs found."""

    median: Annotated[Maybe, Metric("off, median [m]")]
    p95: Annotated[Maybe, Metric("off, 95 % [m]")]


class Existence(TypedDict):
    """`found.POLICY.existence`: probabilities that slots hold an object."""

    nll: Annotated[float, Metric("NLL of existence", "Mean -log p of whether there is one.")]
    calibration: Annotated[float, Metric("existence, excess", "Mean probability less share.")]


class Found(TypedDict):
    """`found.POLICY`: missions of `explore`, for each PoI; late ones count with all their time."""

    found: Annotated[float, Metric("found", "PoIs that the map shows within .3 m.")]
    false: Annotated[float, Metric("false", "Objects on the map that are none, or duplicates.")]
    duplicates: Annotated[float, Metric("duplicates", "Further objects for one PoI.")]
    right: Annotated[float, Metric("right", "PoIs found whose most likely class is right.")]
    confidence: Annotated[float, Metric("confidence", "Mean, of the most likely class.")]
    observations_per_poi: Annotated[float, Metric("looks per PoI", digits=2)]
    mean_time_s: Annotated[float, Metric("mean time [s]", digits=1)]
    known_time_s: Annotated[float, Metric("known places [s]", "If all places are told.", 1)]
    time_over_known: Annotated[Maybe, Metric("time over known", "Null if these are late.", 2)]
    late: Annotated[float, Metric("late", "Share of missions that the time limit ends.")]
    collisions: Annotated[int, Metric("collisions", "Control periods with contact.", 0)]
    position_error: PositionError
    gospa: Gospa
    existence: Existence
    overflow: Annotated[int, Metric("left out", "Candidates for which the map had no slot.", 0)]
    found_and_right: Annotated[
        list[float], Metric("over time", "Found and right, after every 10 s.")
    ]
    episodes: Annotated[int, Metric("missions", digits=0)]


class Header(Origin):
    """The keys of a summary about the run itself."""

    preset: Annotated[str, Metric("preset", "Preset that the settings started from.")]
    seed: Annotated[int, Metric("seed", "Source of all randomness; the first of several seeds.")]
    origins: NotRequired[Annotated[list[Origin], Metric("origins", "Of all, if they differ.")]]
    seeds: NotRequired[Annotated[dict[str, Results], Metric("seeds", "Results of each seed.")]]
    failed: NotRequired[Annotated[dict[str, str], Metric("failed", "Seeds that failed, and why.")]]


class Timed(Header):
    """The keys of a summary that are not results."""

    timing: Timing


class Summary(Timed, Results):
    """The whole file."""


def policies(missions: Missions) -> Missions:
    """The cases in which no robot fails, by policy."""
    return {name: case for name, case in missions.items() if not is_fault(name)}


def _metrics(block: type, prefix: str = "") -> Iterator[Metric]:
    for name, hint in get_type_hints(block, include_extras=True).items():
        inner = get_args(hint)[0] if get_origin(hint) is NotRequired else hint
        if is_block(inner):
            yield from _metrics(inner, f"{prefix}{name}.")
        elif get_origin(inner) is Annotated:
            metric: Metric = inner.__metadata__[0]
            yield dataclasses.replace(metric, key=f"{prefix}{name}")


def _table(block: type) -> dict[str, Metric]:
    return {metric.key: metric for metric in _metrics(block)}


DETECTORS, JMVAE, BELIEF, AGENTS = map(_table, (Detector, Jmvae, Beliefs, Agent))
MISSIONS, STAGES, FOUND = map(_table, (Case, StageTiming, Found))
BLOCKS = {
    "": _table(Header),
    "timing.": _table(Timing),
    "timing.stages.STAGE.": STAGES,
    "detectors.MODALITY.": DETECTORS,
    "jmvae.": JMVAE,
    "belief.": BELIEF,
    "dqn.MODALITY.": AGENTS,
    "mission.POLICY.": MISSIONS,
    "evaluations.NAME.": _table(Evaluation),
    "found.POLICY.": FOUND,
}
"""All metrics, by the prefix of their key in `summary.json` and then by the rest of it. Evaluations
have files `evaluations/NAME.json`, each with its own block `mission`; `explore` writes `found`."""

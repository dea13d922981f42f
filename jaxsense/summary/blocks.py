"""What `summary.json` holds: each key with its type, its name, its meaning and its digits.

The page, the plots, the terminal and the docs read this table. Of several seeds, an `Interval`
stands in place of each number.
"""

import dataclasses
from collections.abc import Iterator
from typing import Annotated, NotRequired, TypedDict, cast, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_block

from jaxsense.mission import is_fault
from jaxsense.summary.metrics import Interval, Metric

PerClass = dict[str, list[float]]
"""For `joint` and for each modality `[C]` numbers, in the order of `arena.classes`."""


class StageTiming(TypedDict):
    """`timing.stages.STAGE`; stages of one program share an entry."""

    compile_s: Annotated[float, Metric("compile [s]", digits=2)]
    run_s: Annotated[float, Metric("run [s]", digits=2)]


class Timing(TypedDict):
    """`timing`."""

    total_s: Annotated[
        float,
        Metric("total time [s]", "Duration of the command after its imports; stages overlap.", 1),
    ]
    stages: dict[str, StageTiming]


class Detector(TypedDict):
    """`detectors.MODALITY`."""

    accuracy: Annotated[
        float, Metric("accuracy", "Share of looks at held-out scenes with the right label.", 4)
    ]
    ece: Annotated[
        float, Metric("calibration error", "Mean gap between confidence and accuracy (ECE).", 4)
    ]
    nll: Annotated[float, Metric("NLL", "Mean -log p of the right label, in nats.", 4)]


class Fusion(TypedDict):
    """`jmvae.fusion`: beliefs after one sensor's look and then another's; null with one sensor."""

    accuracy: Annotated[
        float | None,
        Metric("fusion: right", "Share of fused beliefs nearest to the right class.", 4),
    ]
    mean_error: Annotated[
        float | None,
        Metric("fusion: error", "Distance of the mean from the joint belief, in sigmas."),
    ]
    std_error: Annotated[
        float | None,
        Metric(
            "fusion: error of sigma", "Mean absolute log-ratio to the sigma of the joint belief."
        ),
    ]


class Grouped(TypedDict):
    """`jmvae.grouped`: joint posteriors of a JMVAE that learns from scans, at held-out PoIs."""

    pair: Annotated[
        float, Metric("right, one look each", "Share of PoIs nearest to the right cluster.", 4)
    ]
    all_looks: Annotated[
        float, Metric("right, all looks", "The same after `jmvae.looks` looks by each sensor.", 4)
    ]


class Jmvae(TypedDict):
    """`jmvae`: the latent space."""

    active_units: Annotated[
        int,
        Metric(
            "dimensions in use",
            "Number of latent dimensions that vary between classes; one in the paper.",
        ),
    ]
    sigma_norm: Annotated[
        PerClass,
        Metric(
            "sigma norm", "Mean for each class, with all sensors (`joint`) and with each alone."
        ),
    ]
    unambiguous: Annotated[
        dict[str, list[bool]],
        Metric(
            "unambiguous",
            "Whether over 90% of looks leave this class, and no other, plausible (Table I).",
        ),
    ]
    consistent: Annotated[
        PerClass,
        Metric(
            "consistent",
            "Share of looks that leave exactly the classes that the sensor cannot distinguish.",
        ),
    ]
    moment_matching_error: Annotated[
        float,
        Metric("error of moments", "Distance from the best Gaussian over the classes left open."),
    ]
    readout_error: Annotated[
        float,
        Metric(
            "error of the readout",
            "Nats lost when a belief stores exact probabilities and they are read back.",
            digits=4,
        ),
    ]
    fusion: Fusion
    grouped: NotRequired[Grouped]


class Beliefs(TypedDict):
    """`belief`: the map after random looks at one PoI, compared with exact Bayes on them."""

    looks: Annotated[list[int], Metric("looks", "Number of looks at the PoI, 1 to 6.")]
    nll: Annotated[list[float], Metric("NLL of the map", "Mean -log p of the true class.")]
    bayes_nll: Annotated[list[float], Metric("NLL of exact Bayes", "The same with exact Bayes.")]
    accuracy: Annotated[
        list[float],
        Metric("accuracy of the map", "Share of histories with the right most likely class."),
    ]
    bayes_accuracy: Annotated[
        list[float], Metric("accuracy of exact Bayes", "The same with exact Bayes.")
    ]
    doubt_correlation: Annotated[
        float,
        Metric("sigma and uncertainty", "Correlation of the sigma norm with the exact entropy."),
    ]


Returns = TypedDict(
    "Returns",
    {
        "return": Annotated[
            float, Metric("Q-network", "Reward of an episode, without exploration.")
        ],
        "optimal": Annotated[
            float | None, Metric("optimal", "The optimal policy; null if it is unknown.")
        ],
        "greedy": Annotated[
            float, Metric("greedy", "Takes the look with the highest expected gain.")
        ],
        "naive": Annotated[
            float, Metric("naive", "Looks once at each PoI, whatever the map holds.")
        ],
        "random": Annotated[float, Metric("random", "Takes any action.")],
        "fraction_of_optimal": Annotated[
            float | None, Metric("of optimal", "Reward as a share of the optimal one.")
        ],
    },
)
"""Mean rewards of episodes on the map, from random starts."""


class OneStep(TypedDict):
    """`dqn.MODALITY.one_step`: the reward of the first step, as in the authors' code."""

    policy: Annotated[float, Metric("one step: Q-network", "Reward of the first step.")]
    optimal: Annotated[float | None, Metric("one step: optimal")]
    random: Annotated[float, Metric("one step: random")]


class Agent(Returns):
    """`dqn.MODALITY`: a robot alone on the map."""

    one_step: OneStep
    optimal_states: Annotated[
        int | None,
        Metric("optimal in", "Number of states with a reward within 0.01 of optimal.", 1),
    ]
    num_states: Annotated[
        int, Metric("states", "Number of combinations of classes and looks, or of a sample.", 0)
    ]
    optimal_permutations: Annotated[int | None, Metric("optimal permutations", digits=1)]
    num_permutations: Annotated[
        int, Metric("permutations", "Number of states in which all classes differ.", 0)
    ]
    other_numbers: NotRequired[
        Annotated[
            dict[str, Returns], Metric("other numbers", "Rewards with `evaluation.num_pois` PoIs.")
        ]
    ]
    env_steps: Annotated[
        int, Metric("steps of training", "Environment steps, over all environments.", 0)
    ]
    env_steps_per_s: Annotated[
        float, Metric("steps per second", "Environment steps per second of training.", 0)
    ]


class Differences(TypedDict):
    """`mission.POLICY.intervals`: from the latent policy, arena by arena, with 95% intervals."""

    accuracy: Annotated[
        Interval, Metric("right, difference", "Difference from `latent`, with 95 % interval.")
    ]
    observations_per_poi: Annotated[
        Interval, Metric("looks, difference", "Difference from `latent` in looks per PoI.", 2)
    ]
    time_s: Annotated[Interval, Metric("mean time, difference [s]", "Difference from `latent`.", 1)]


class OfNaive(TypedDict):
    """`mission.POLICY.of_naive`: ratios to naive exploration, see `compare.of_naive`."""

    observations_per_poi: Annotated[
        float,
        Metric("looks, relative to naive", "Ratio to naive exploration with the same accuracy.", 2),
    ]
    time_s: Annotated[
        float, Metric("median time, relative to naive", "The same, of the median times.", 2)
    ]
    mean_time_s: Annotated[
        float, Metric("mean time, relative to naive", "The same, of the mean times.", 2)
    ]


class Calibration(TypedDict):
    """`mission.POLICY.calibration`: maps at the end of missions, PoIs that were detected."""

    confidence: Annotated[
        float | None,
        Metric(
            "confidence",
            "Mean probability of the most likely class; equals the share right if calibrated.",
        ),
    ]
    accuracy: Annotated[
        float | None,
        Metric("right, of detected", "Share of detected PoIs whose most likely class is right."),
    ]
    nll: Annotated[float | None, Metric("NLL of the maps", "Mean -log p of the true class.")]


class Case(TypedDict):
    """`mission.POLICY`: missions of one policy, or with a robot that fails."""

    accuracy: Annotated[float, Metric("right", "Share of PoIs whose most likely class is right.")]
    observations_per_poi: Annotated[float, Metric("looks per PoI", "Mean number of looks.", 2)]
    time_s: Annotated[float, Metric("median time [s]", "Median time until all robots are done.", 1)]
    mean_time_s: Annotated[
        float,
        Metric("mean time [s]", "Mean time until all robots are done.", 1),
    ]
    collisions: Annotated[int, Metric("collisions", "Number of control periods with contact.", 0)]
    goals_reached_fraction: Annotated[
        float | None, Metric("goals reached", "Share of goals that robots reached.")
    ]
    information: Annotated[float, Metric("information", "Sum of 1 / sigma norm over the map.", 2)]
    calibration: Calibration
    episodes: Annotated[int, Metric("missions", "Number of missions.", 0)]
    ended: Annotated[dict[str, int], Metric("ends", "Number of missions with each kind of end.")]
    told: NotRequired[
        Annotated[
            float, Metric("right labels", "For a robot alone: share of PoIs with the right label.")
        ]
    ]
    ambiguous_reported: NotRequired[
        Annotated[
            float | None,
            Metric(
                "reported as ambiguous",
                "For a robot alone: share of the PoIs of confusable classes that the map shows as "
                "ambiguous.",
            ),
        ]
    ]
    seed: NotRequired[Annotated[int, Metric("seed", "Seed of the arenas of an evaluation.")]]
    intervals: NotRequired[Differences]
    of_naive: NotRequired[OfNaive]


class Traffic(TypedDict):
    """`mission.bytes_per_detection`."""

    latent: Annotated[float, Metric("bytes in the map", "Size of one belief.", 0)]
    features: Annotated[
        float, Metric("bytes of features", "Mean size of a detection's features.", 0)
    ]
    raw: Annotated[float, Metric("bytes of a scan", "Mean size of a detection's scan.", 0)]


TRAFFIC = "bytes_per_detection"
Missions = dict[str, Case | Traffic]
"""`mission`: a `Case` for each policy, and `bytes_per_detection`."""


class Learned(TypedDict):
    """The blocks of a summary that come from a training."""

    detectors: dict[str, Detector]
    jmvae: Jmvae
    belief: Beliefs
    dqn: dict[str, Agent]


class Results(Learned):
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


class Made(Origin):
    """What made a stage of a run, or a part of it."""

    stage: str


class Evaluation(TypedDict):
    """Missions of `evaluate` in the same arenas: `RUN/evaluations/NAME.json`."""

    num_pois: Annotated[int, Metric("PoIs", "Number of points of interest.", 0)]
    side: Annotated[float, Metric("side [m]", "Side of the arena.", 2)]
    robots: Annotated[list[str], Metric("robots", "Modality of each robot.")]
    # Those of earlier versions may lack it.
    origin: NotRequired[Origin]
    mission: Missions


class Header(Origin):
    """The keys of a summary about the run itself."""

    preset: Annotated[str, Metric("preset", "Preset that the settings started from.")]
    seed: Annotated[int, Metric("seed", "Source of all randomness; the first of several seeds.")]
    origins: NotRequired[
        Annotated[list[Made], Metric("origins", "Origins of the stages, if several.")]
    ]
    seeds: NotRequired[
        Annotated[dict[str, Results], Metric("seeds", "Results of each of several seeds.")]
    ]
    failed: NotRequired[Annotated[dict[str, str], Metric("failed", "Seeds that failed, and why.")]]


class Timed(Header):
    """The keys of a summary that are not results."""

    timing: Timing


class Summary(Timed, Results):
    """The whole file."""


def cases(missions: Missions) -> dict[str, Case]:
    """The cases of a block `mission`, by name."""
    return {name: cast(Case, case) for name, case in missions.items() if name != TRAFFIC}


def policies(missions: Missions) -> dict[str, Case]:
    """The cases of a block `mission` in which no robot fails, by policy."""
    return {name: case for name, case in cases(missions).items() if not is_fault(name)}


def traffic(missions: Missions) -> Traffic:
    """The bytes of a detection in a block `mission`."""
    return cast(Traffic, missions[TRAFFIC])


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
MISSIONS, STAGES = _table(Case), _table(StageTiming)
BLOCKS = {
    "": _table(Header),
    "timing.": _table(Timing),
    "timing.stages.STAGE.": STAGES,
    "detectors.MODALITY.": DETECTORS,
    "jmvae.": JMVAE,
    "belief.": BELIEF,
    "dqn.MODALITY.": AGENTS,
    "mission.POLICY.": MISSIONS,
    f"mission.{TRAFFIC}.": _table(Traffic),
    "evaluations.NAME.": _table(Evaluation),
}
"""All metrics, by the prefix of their key in `summary.json` and then by the rest of it. Evaluations
have files `evaluations/NAME.json`, each with its own block `mission`."""

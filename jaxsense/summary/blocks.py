"""What `summary.json` holds: a type for each block, and the meaning of each key beside it.

The page, the plots, the terminal and the docs read names and meanings from here. Of several seeds,
an `Interval` stands in place of each number.
"""

import dataclasses
from collections.abc import Iterator
from typing import Annotated, NotRequired, TypedDict, cast, get_args, get_origin, get_type_hints
from typing import is_typeddict as is_block

from jaxsense.summary.metrics import Interval, Metric

PerClass = dict[str, list[float]]
"""For `joint` and for each modality `[C]` numbers, in the order of `arena.classes`."""


class StageTiming(TypedDict):
    """`timing.stages.STAGE`."""

    compile_s: Annotated[float, Metric("compile [s]", "Seconds of compiling.", digits=2)]
    run_s: Annotated[
        float,
        Metric("run [s]", "Seconds of running. Stages of one program share an entry.", digits=2),
    ]


class Timing(TypedDict):
    """`timing`."""

    total_s: Annotated[
        float, Metric("total time [s]", "The whole command; its stages overlap.", digits=1)
    ]
    stages: dict[str, StageTiming]


class Detector(TypedDict):
    """`detectors.MODALITY`."""

    accuracy: Annotated[
        float, Metric("accuracy", "Share of right labels in scenes kept from training.", digits=4)
    ]
    ece: Annotated[
        float,
        Metric("calibration error", "Expected gap between confidence and accuracy.", digits=4),
    ]
    nll: Annotated[
        float, Metric("NLL", "Mean negative log-probability of the right label, in nats.", digits=4)
    ]


class Fusion(TypedDict):
    """`jmvae.fusion`: beliefs after one sensor's look and then another's; null with one sensor."""

    accuracy: Annotated[
        float | None,
        Metric("fusion: right class", "Share of beliefs closest to the true class.", digits=4),
    ]
    mean_error: Annotated[
        float | None,
        Metric("fusion: error", "Distance from the joint belief, in standard deviations."),
    ]
    std_error: Annotated[
        float | None,
        Metric("fusion: error of sigma", "Mean |log(sigma ratio)| to the joint belief."),
    ]


class Jmvae(TypedDict):
    """`jmvae`: the latent space."""

    active_units: Annotated[
        int, Metric("dimensions in use", "One of two in the paper's Fig. 4.", "1", 1)
    ]
    sigma_norm: Annotated[
        PerClass,
        Metric(
            "sigma norm", "Mean ||sigma|| of each class, `joint` and by sensor.", "1.05 to 1.25"
        ),
    ]
    unambiguous: Annotated[
        dict[str, list[bool]],
        Metric(
            "unambiguous",
            "Whether over 90% of a class's looks leave the true class plausible and no other.",
            "Table I",
        ),
    ]
    consistent: Annotated[
        PerClass,
        Metric(
            "consistent",
            "Share of a class's looks that leave exactly the classes that the sensor cannot tell "
            "apart. Stricter than Table I: the true class must be among them.",
        ),
    ]
    moment_matching_error: Annotated[
        float,
        Metric(
            "error of moments",
            "Distance of a sensor's belief from the best Gaussian over the possible classes.",
            "0 in theory",
        ),
    ]
    fusion: Fusion


class Beliefs(TypedDict):
    """`belief`: the map after random looks at one PoI, beside exact Bayes."""

    looks: Annotated[list[int], Metric("looks", "Numbers of looks, 1 to 6.")]
    nll: Annotated[
        list[float], Metric("NLL of the map", "Mean -log p of the true class, as the map has it.")
    ]
    bayes_nll: Annotated[
        list[float], Metric("NLL of exact Bayes", "The same for the exact filter over classes.")
    ]
    accuracy: Annotated[
        list[float], Metric("accuracy of the map", "Share of PoIs whose likeliest class is right.")
    ]
    bayes_accuracy: Annotated[
        list[float], Metric("accuracy of exact Bayes", "The same for the exact filter.")
    ]
    doubt_correlation: Annotated[
        float,
        Metric(
            "sigma and uncertainty",
            "Correlation of ||sigma|| with the entropy of the exact posterior.",
        ),
    ]


Returns = TypedDict(
    "Returns",
    {
        "return": Annotated[
            float,
            Metric("Q-network", "Total reward of its greedy policy in an episode.", "Fig. 5"),
        ],
        "optimal": Annotated[
            float,
            Metric(
                "optimal",
                "Knows the mean reward of each look; with a filter, by dynamic programming.",
                "0.550*",
            ),
        ],
        "naive": Annotated[float, Metric("naive", "Looks at each PoI once, whatever it knows.")],
        "random": Annotated[float, Metric("random", "Random looks, and a random end.")],
        "fraction_of_optimal": Annotated[
            float | None, Metric("fraction of optimal", "Q-network over optimal.")
        ],
    },
)
"""Mean rewards of episodes on the map, from random starts."""


class OneStep(TypedDict):
    """`dqn.MODALITY.one_step`: the reward of the first step, as in the authors' code."""

    policy: Annotated[float, Metric("one step: Q-network", "", "0.340, 0.385*")]
    optimal: Annotated[float, Metric("one step: optimal", "", "0.426*")]
    random: Annotated[float, Metric("one step: random", "", "-0.302*")]


class Agent(Returns):
    """`dqn.MODALITY`: a robot alone on the map."""

    one_step: OneStep
    optimal_states: Annotated[
        int, Metric("optimal in", "States with a reward within 0.01 of the optimum's.", digits=1)
    ]
    num_states: Annotated[
        int, Metric("states", "Combinations of classes and looks; a sample of 4,096 if more.")
    ]
    optimal_permutations: Annotated[
        int, Metric("optimal permutations", "The same where all PoIs differ in class.", digits=1)
    ]
    num_permutations: Annotated[int, Metric("permutations", "States of different classes.", "384")]
    other_numbers: NotRequired[
        Annotated[
            dict[str, Returns],
            Metric("other numbers", "Rewards with the numbers of PoIs in `evaluation.num_pois`."),
        ]
    ]
    env_steps: Annotated[
        int, Metric("steps of training", "In all environments together.", "2,000 epochs")
    ]
    env_steps_per_s: Annotated[
        float, Metric("steps per second", "In all environments, with learning.", digits=0)
    ]


class Differences(TypedDict):
    """`mission.POLICY.intervals`: differences from the latent policy, arena by arena."""

    accuracy: Annotated[Interval, Metric("right, difference", "From `latent`, with 95% interval.")]
    observations_per_poi: Annotated[
        Interval, Metric("looks, difference", "From `latent`, with 95% interval.", digits=2)
    ]
    time_s: Annotated[
        Interval,
        Metric("mean time, difference [s]", "From `latent`, with 95% interval.", digits=1),
    ]


class OfNaive(TypedDict):
    """`mission.POLICY.of_naive`: ratios to naive exploration of the same accuracy."""

    observations_per_poi: Annotated[
        float,
        Metric(
            "looks, of naive",
            "Ratio to naive exploration of the same accuracy, between its one, two and three "
            "looks; to three if these are less accurate.",
            digits=2,
        ),
    ]
    time_s: Annotated[float, Metric("time, of naive", "The same for the median time.", digits=2)]
    mean_time_s: Annotated[
        float, Metric("mean time, of naive", "The same for the mean time.", digits=2)
    ]


class Case(TypedDict):
    """`mission.POLICY`: missions of one policy, or with a robot that fails."""

    accuracy: Annotated[float, Metric("right", "Share of PoIs whose likeliest class is right.")]
    observations_per_poi: Annotated[float, Metric("looks per PoI", digits=2)]
    time_s: Annotated[float, Metric("time [s]", "Median time until all robots are done.", digits=1)]
    mean_time_s: Annotated[
        float, Metric("mean time [s]", "Long missions lift it above the median.", digits=1)
    ]
    collisions: Annotated[
        int, Metric("collisions", "Control periods in which a robot touched something.", digits=0)
    ]
    goals_reached_fraction: Annotated[
        float | None, Metric("goals reached", "Share of chosen viewpoints that were reached.")
    ]
    information: Annotated[
        float, Metric("information", "Sum of 1 / sigma norm over the map.", digits=2)
    ]
    episodes: Annotated[int, Metric("missions", digits=0)]
    ended: Annotated[dict[str, int], Metric("ends", "Number of missions by how they ended.")]
    told: NotRequired[
        Annotated[
            float, Metric("right labels", "A robot alone: share of PoIs with the right label.")
        ]
    ]
    ambiguous_reported: NotRequired[
        Annotated[
            float | None,
            Metric(
                "reported as ambiguous",
                "A robot alone: share of the PoIs that it cannot tell apart which the map shows as "
                "ambiguous.",
            ),
        ]
    ]
    seed: NotRequired[Annotated[int, Metric("seed", "Of the arenas of an evaluation.")]]
    intervals: NotRequired[Differences]
    of_naive: NotRequired[OfNaive]


class Traffic(TypedDict):
    """`mission.bytes_per_detection`."""

    latent: Annotated[float, Metric("bytes in the map", "Size of a belief.", digits=0)]
    features: Annotated[
        float, Metric("bytes of features", "Mean size of the detections' features.", digits=0)
    ]
    raw: Annotated[
        float, Metric("bytes of a scan", "Mean size of the detections' scans.", digits=0)
    ]


_TRAFFIC = "bytes_per_detection"
Missions = dict[str, Case | Traffic]
"""`mission`: a `Case` for each policy, and `bytes_per_detection`."""


class Results(TypedDict):
    """The blocks of a summary that come from a training and its missions."""

    detectors: dict[str, Detector]
    jmvae: Jmvae
    belief: Beliefs
    dqn: dict[str, Agent]
    mission: Missions


class Place(TypedDict):
    """Missions in one arena, of one team; `elsewhere.NAME` in summaries of older versions."""

    num_pois: int
    side: float
    robots: list[str]
    mission: Missions


class Evaluation(Place):
    """Missions of `evaluate` in the same arenas: `RUN/evaluations/NAME.json`."""

    seed: int
    episodes: int


class Header(TypedDict):
    """The keys of a summary about the run itself."""

    preset: Annotated[str, Metric("preset", "Origin of the settings.")]
    seed: Annotated[int, Metric("seed", "Of all randomness; of several, the first.")]
    versions: Annotated[dict[str, str], Metric("versions", "Of Python and of libraries.")]
    devices: Annotated[list[str], Metric("devices", "Kinds of the accelerators, or `cpu`.")]
    seeds: NotRequired[
        Annotated[dict[str, Results], Metric("seeds", "The results of each of several seeds.")]
    ]
    failed: NotRequired[
        Annotated[dict[str, str], Metric("failed", "Seeds whose training failed, and why.")]
    ]


class Summary(Header, Results):
    """The whole file."""

    timing: Timing
    elsewhere: NotRequired[dict[str, Place]]


def cases(missions: Missions) -> dict[str, Case]:
    """The cases of a block `mission`, by their names."""
    return {name: cast(Case, case) for name, case in missions.items() if name != _TRAFFIC}


def traffic(missions: Missions) -> Traffic:
    """The bytes of a detection in a block `mission`."""
    return cast(Traffic, missions[_TRAFFIC])


def _metrics(block: type, prefix: str = "") -> Iterator[Metric]:
    for name, hint in get_type_hints(block, include_extras=True).items():
        inner = get_args(hint)[0] if get_origin(hint) is NotRequired else hint
        if is_block(inner):
            yield from _metrics(inner, f"{prefix}{name}.")
        elif get_origin(inner) is Annotated:
            yield dataclasses.replace(inner.__metadata__[0], key=f"{prefix}{name}")


BLOCKS = {
    place: {metric.key: metric for metric in _metrics(block)}
    for place, block in {
        "": Header,
        "timing": Timing,
        "timing.stages.STAGE": StageTiming,
        "detectors.MODALITY": Detector,
        "jmvae": Jmvae,
        "belief": Beliefs,
        "dqn.MODALITY": Agent,
        "mission.POLICY": Case,
        "mission.bytes_per_detection": Traffic,
    }.items()
}
"""The metrics of each block of `summary.json`, by their keys: the one table of all."""
DETECTORS, JMVAE, BELIEF, AGENTS, MISSIONS, STAGES = (
    BLOCKS[place]
    for place in (
        *("detectors.MODALITY", "jmvae", "belief", "dqn.MODALITY", "mission.POLICY"),
        "timing.stages.STAGE",
    )
)

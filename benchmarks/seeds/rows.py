"""Rows of the tables that compare presets: which figures of a run they show, and how."""

import dataclasses
from collections.abc import Callable
from typing import Any

from benchmarks.seeds.runs import Figures

Value = Callable[[Figures], Any]
"""Reads a number of a run, or one for each agent or policy; None if the run has none."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a table that compares presets.

    Attributes:
      label: its first cell.
      value: of a run: a number, one for each agent, or numbers of which the range is shown.
      form: how a number is written.
      paper: what the paper says.
      fitted: whether the preset `paper` was fitted to it.
      pooled: whether the numbers of a run belong to one range.
    """

    label: str
    value: Value
    form: str
    paper: str = ""
    fitted: bool = False
    pooled: bool = False


def _key(name: str) -> Value:
    return lambda figures: figures[name]


_TABLE_ONE = Row(
    "what each sensor distinguishes, Table I", _key("table_one"), "{} of 9", paper="9 cells"
)
_SIGMAS = [
    Row(
        f"sigma norm, {name}, Fig. 4",
        _key(name),
        "{:.2f}",
        paper=paper,
        fitted=True,
        pooled=True,
    )
    for name, paper in (("unambiguous", "from 1.05"), ("ambiguous", "to 1.25"))
]
_CONSISTENT = Row(
    "minimum share of looks that leave exactly the right classes open (`consistent`)",
    lambda figures: min(x for each in figures["consistent"].values() for x in each),
    "{:.3f}",
)
_NEAREST = Row("fused beliefs nearest to the right class", _key("fusion_accuracy"), "{:.4f}")
_STATES = [
    Row("start states within 0.01 of the optimal return, of 1,728", _key("optimal_states"), "{:,}"),
    Row("... of the 384 with different classes", _key("optimal_permutations"), "{}"),
]
_FRACTION = Row(
    "reward of an episode, as a share of the optimal policy's",
    _key("fraction_of_optimal"),
    "{:.3f}",
)
OF_README = [_TABLE_ONE, *_SIGMAS, _NEAREST, _FRACTION, *_STATES]
OF_FIGURES = [
    _TABLE_ONE,
    _CONSISTENT,
    *_SIGMAS,
    Row(
        "latent dimensions in use, of 2",
        _key("active_units"),
        "{}",
        paper="1, by the scale of Fig. 4",
    ),
    Row("detectors' accuracy on held-out scans", _key("detectors"), "{:.4f}"),
    Row(
        "moment-matching error of one sensor's posteriors",
        _key("moment_matching_error"),
        "{:.4f}",
        paper="0 in theory",
    ),
    _NEAREST,
    Row(
        "distance of fused means from true pairs, in standard deviations",
        _key("fusion_mean_error"),
        "{:.4f}",
    ),
    Row("mean \\|log\\| of the ratio of their sigmas", _key("fusion_std_error"), "{:.4f}"),
    _FRACTION,
    Row("... DQN", _key("return"), "{:.3f}"),
    Row("... naive exploration", _key("naive"), "{:.3f}"),
    Row("... random", _key("random"), "{:.3f}"),
    *_STATES,
]


def _of_policy(key: str, *policies: str) -> Value:
    return lambda figures: [figures["mission"][policy][key] for policy in policies]


def _last_nll_over_bayes(figures: Figures) -> float:
    return figures["nll_over_bayes"][-1]


def _grouped(key: str) -> Value:
    return lambda figures: figures["grouped"] and figures["grouped"][key]


OF_RAW = [
    Row(
        "right at held-out PoIs, joint posterior of one look by each sensor",
        _grouped("pair"),
        "{:.4f}",
    ),
    Row("... of four looks by each", _grouped("all_looks"), "{:.4f}"),
    _TABLE_ONE,
    _CONSISTENT,
    Row("latent dimensions in use, of 2", _key("active_units"), "{}"),
    Row("accuracy of single looks, camera, LiDAR", _key("detectors"), "{:.4f}"),
    Row(
        "NLL after six random looks minus that of exact Bayes",
        _last_nll_over_bayes,
        "{:.4f}",
    ),
    Row("accuracy of the finished map, latent", _of_policy("accuracy", "latent"), "{:.4f}"),
    Row(
        "looks per PoI, latent, naive",
        _of_policy("observations_per_poi", "latent", "naive"),
        "{:.2f}",
    ),
    Row("time, median, latent, naive", _of_policy("time_s", "latent", "naive"), "{:.1f} s"),
]
_CHOOSING, _COUNTING = ("latent", "greedy"), ("naive", "naive_2", "naive_3")
OF_RAW_AND_LABELLED = [
    Row("accuracy of single looks, camera, LiDAR", _key("detectors"), "{:.3f}"),
    Row("right at held-out PoIs, one look by each sensor", _grouped("pair"), "{:.3f}"),
    Row("... four looks by each", _grouped("all_looks"), "{:.3f}"),
    Row(
        "NLL of the map minus that of exact Bayes, after six random looks",
        _last_nll_over_bayes,
        "{:.3f}",
    ),
    _CONSISTENT,
    Row("missions", _of_policy("episodes", "latent"), "{:,}"),
    *(
        row
        for label, key, form in (
            ("accuracy of the finished map", "accuracy", "{:.3f}"),
            ("looks per PoI", "observations_per_poi", "{:.2f}"),
        )
        for row in (
            Row(f"{label}, {', '.join(_CHOOSING)}", _of_policy(key, *_CHOOSING), form),
            Row(f"... {', '.join(_COUNTING)}", _of_policy(key, *_COUNTING), form),
        )
    ),
    Row(
        "confidence minus accuracy, latent",
        _of_policy("overconfidence", "latent"),
        "{:.3f}",
    ),
]
OF_MAPS = [
    Row("accuracy of single looks, camera, LiDAR", _key("detectors"), "{:.3f}"),
    Row(
        "NLL of the map minus that of exact Bayes, after one to six random looks",
        _key("nll_over_bayes"),
        "{:.3f}",
        pooled=True,
    ),
    Row(
        "correlation of sigma norm with the entropy of exact Bayes",
        _key("doubt_correlation"),
        "{:.3f}",
    ),
    Row(
        "return of the Q-network over the optimum, camera, LiDAR",
        _key("fraction_of_optimal"),
        "{:.3f}",
    ),
]

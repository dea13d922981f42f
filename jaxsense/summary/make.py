"""Makes the blocks of `summary.json` from arrays."""

from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jaxtyping import PyTree

from jaxsense.config import Config
from jaxsense.mission.outcome import REASONS
from jaxsense.summary import blocks
from jaxsense.summary.blocks import Case, Missions
from jaxsense.summary.compare import REFERENCE, Measured, differences
from jaxsense.training.comparison import permutations

_AS_GOOD = 0.01  # tolerance of the reward below the optimum
_ERROR = 0.01  # of the optimum, as a share of it

_Rewards = Mapping[str, tuple[np.ndarray, np.ndarray]]


def plain(measured: PyTree) -> PyTree:
    """Arrays as lists and numbers."""
    return jax.tree.map(lambda x: np.asarray(x).tolist(), measured)


def agent(
    config: Config,
    rewards: _Rewards,
    seconds: Sequence[float],
    others: Sequence[_Rewards] = (),
    has_optimum: bool = True,
) -> blocks.Agent:
    """One modality's block of `dqn`.

    Args:
      rewards: by policy, `[S]` total reward of an episode and `[S]` reward of its first action,
        from every state of the map, then from `config.evaluation.num_starts` random starts.
      seconds: of the training, chunk by chunk.
      others: `rewards` with each of `config.evaluation.num_pois`, whose last starts are the random
        ones.
      has_optimum: whether `optimal` is the optimum; what rests on it is None otherwise, and where
        another policy gets clearly more.
    """
    num_starts, env_steps = config.evaluation.num_starts, config.dqn.epochs * config.dqn.num_envs
    is_permutation = permutations(config)  # all classes differ, as in the paper
    num_states = len(is_permutation)
    returns = _returns(rewards, num_starts, has_optimum)
    has_optimum = returns["optimal"] is not None
    first = {name: float(of_first[num_states:].mean()) for name, (_, of_first) in rewards.items()}
    missed = (rewards["optimal"][0] - rewards["latent"][0])[:num_states]
    is_optimal = missed <= _AS_GOOD
    block: blocks.Agent = {
        **returns,
        "one_step": {
            "policy": first["latent"],
            "optimal": first["optimal"] if has_optimum else None,
            "random": first["random"],
        },
        "optimal_states": int(np.sum(is_optimal)) if has_optimum else None,
        "num_states": num_states,
        "optimal_permutations": int(np.sum(is_optimal & is_permutation)) if has_optimum else None,
        "num_permutations": int(np.sum(is_permutation)),
        "env_steps": env_steps,
        "env_steps_per_s": env_steps / sum(seconds),
    }
    if others:
        numbers = map(str, config.evaluation.num_pois)
        of_numbers = (_returns(each, num_starts, has_optimum) for each in others)
        block["other_numbers"] = dict(zip(numbers, of_numbers, strict=True))
    return block


def _returns(rewards: _Rewards, num_starts: int, has_optimum: bool) -> blocks.Returns:
    """Mean total rewards from random starts, the last ones."""
    totals = {name: total[-num_starts:] for name, (total, _) in rewards.items()}
    of = {name: float(total.mean()) for name, total in totals.items()}
    # Where another policy gets more, by more than its error, `optimal` is not the optimum.
    error = _ERROR * abs(of["optimal"])
    more = [total - totals["optimal"] for total in totals.values()]
    is_exceeded = any(x.mean() > error + 2 * np.std(x) / np.sqrt(num_starts) for x in more)
    optimal = of["optimal"] if has_optimum and not is_exceeded else None
    return {
        "return": of["latent"],
        "optimal": optimal,
        "greedy": of["greedy"],
        "naive": of["naive"],
        "random": of["random"],
        # Where no look pays, the optimum is 0.
        "fraction_of_optimal": of["latent"] / optimal if optimal else None,
    }


def missions(
    config: Config, played: Mapping[str, Measured], reference: str = REFERENCE
) -> Missions:
    """The block `mission`, from metrics of the missions of each case, in the same arenas."""
    found: Missions = {name: case(config, name, each) for name, each in played.items()}
    for name, block in found.items():
        if reference in played and name != reference:
            block["intervals"] = differences(played[name], played[reference])
    return found


def case(config: Config, name: str, found: Measured) -> Case:
    """One case of the block `mission`, from metrics of its missions.

    Returns:
      Means over the missions, except the median of `time_s` and the sum of `collisions`.
    """
    block: Case = {
        "accuracy": float(found["is_right"].mean()),
        "observations_per_poi": float(found["observations_per_poi"].mean()),
        "time_s": float(np.median(found["time_s"])),
        "mean_time_s": float(found["time_s"].mean()),
        "collisions": int(found["collisions"].sum()),
        "goals_reached_fraction": _share(found["goals_reached"].sum(), found["goals"].sum()),
        "information": float(found["information"].mean()),
        "calibration": _calibration(found),
        "episodes": len(found["time_s"]),
        "ended": {
            reason: int(np.sum(found["reason"] == code))
            for code, reason in enumerate(REASONS)
            if np.any(found["reason"] == code)
        },
    }
    robot = name.removesuffix("_alone")
    if robot != name:
        modality = config.carried[config.robot_names.index(robot)]
        labels = np.array(config.label_of_class(modality))
        shares_label = np.array([np.sum(labels == label) > 1 for label in labels])
        reported = found["ambiguous"][shares_label[found["classes"]]]
        block["told"] = float(found["told"][modality].mean())
        block["ambiguous_reported"] = _share(reported.sum(), reported.size)
    return block


def _calibration(found: Measured) -> blocks.Calibration:
    """Whether the confidence of maps matches their accuracy, at PoIs that were detected."""
    names, is_seen = ("confidence", "is_right", "nll"), found["seen"]
    each = (_share(found[name][is_seen].sum(dtype=float), is_seen.sum()) for name in names)
    confidence, accuracy, nll = each
    return {"confidence": confidence, "accuracy": accuracy, "nll": nll}


def _share(part: int, whole: int) -> float | None:
    """Share of a whole; None if that is 0."""
    return float(part / whole) if whole else None


def found(
    metrics: Measured, known: Measured, over_time: Sequence[float], limit: float
) -> blocks.Found:
    """A policy's block `found`, from metrics of its missions, see `exploration.measure`.

    Args:
      known: metrics of missions in the same arenas, all places of which the robots are told.
      over_time: what becomes `found_and_right`.
      limit: of the time of a mission, in seconds.
    """
    number, gospa, seconds = metrics["present"].sum(), metrics["gospa"], metrics["time_s"]
    off = metrics["off"][np.isfinite(metrics["off"])]
    is_used = np.isfinite(metrics["existence"])
    probability, is_object = metrics["existence"][is_used], metrics["is_object"][is_used]
    of_truth = np.where(is_object, probability, 1 - probability)
    is_found, known_s = max(metrics["found"].sum(), 1), known["time_s"]
    is_late = bool(np.any(known_s >= limit))
    return {
        "found": float(metrics["found"].sum() / number),
        "false": float(metrics["false"].sum() / number),
        "duplicates": float(gospa.duplicates.sum() / number),
        "right": float(metrics["right"].sum() / is_found),
        "confidence": float(metrics["confidence"].sum() / is_found),
        "observations_per_poi": float(metrics["looks"].sum() / number),
        "mean_time_s": float(seconds.mean()),
        "known_time_s": float(known_s.mean()),
        "time_over_known": None if is_late else float(seconds.mean() / known_s.mean()),
        "late": float(np.mean(seconds >= limit)),
        "collisions": int(metrics["collisions"].sum()),
        "position_error": {
            "median": float(np.median(off)) if len(off) else None,
            "p95": float(np.quantile(off, 0.95)) if len(off) else None,
        },
        "gospa": {
            "total": float(gospa.total.mean()),
            "localisation": float(gospa.localisation.mean()),
            "missed": float(gospa.missed.mean()),
            "false": float(gospa.false.mean()),
        },
        "existence": {
            "nll": float(-np.log(of_truth).mean()) if len(of_truth) else 0.0,
            "calibration": float(probability.mean() - is_object.mean()) if len(of_truth) else 0.0,
        },
        "overflow": int(metrics["overflow"].sum()),
        "found_and_right": list(over_time),
        "episodes": len(seconds),
    }

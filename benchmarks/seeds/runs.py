"""Reads the figures of runs that tables show."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jaxsense import summary
from jaxsense.config import ConfigError

FILE = Path(__file__).parents[1] / "results" / "seeds.json"
"""Where the figures are stored."""
Figures = Mapping[str, Any]
"""Of one run, by name: numbers, or lists with one for each agent."""

TABLE_ONE = {
    "camera": [True, False, False],
    "lidar": [False, False, True],
    "joint": [True, True, True],
}
"""Table I of the paper: which classes each encoder tells apart."""


def gather(runs: Iterable[Path], group: str | None = None) -> dict[str, Any]:
    """Figures of runs, by group and seed, and how they were made.

    Args:
      runs: their directories.
      group: of all; by default each is in the group of its preset.

    Raises:
      ConfigError: if two runs have the same group and seed, or one is not finished.
    """
    found: dict[str, Any] = {}
    for run in runs:
        written, own = json.loads((run / "config.json").read_text()), summary.read(run)
        of_group = found.setdefault(group or written["preset"], {})
        if str(written["seed"]) in of_group:
            raise ConfigError("runs", str(run), "is a second run of its group and seed")
        of_group[str(written["seed"])] = {
            "commit": written["commit"],
            "versions": own["versions"],
            "devices": own["devices"],
            # Runs of earlier versions lack these.
            **{name: value for name, value in own.items() if name in ("cores", "date")},
            "figures": of_summary(own),
            "evaluations": {
                name: {
                    **{key: each[key] for key in ("num_pois", "robots")},
                    **({"origin": each["origin"]} if "origin" in each else {}),
                    "mission": _of_missions(each["mission"]),
                }
                for name, each in summary.read_evaluations(run).items()
            },
        }
    return {name: dict(sorted(found[name].items())) for name in sorted(found)}


def store(runs: Iterable[Path], file: Path, group: str | None = None) -> None:
    """Writes figures into a file, in place of those of the same groups and seeds.

    Args:
      runs: see `gather`.
      file: new, or with figures of other groups and seeds, which stay.
      group: see `gather`.

    Raises:
      ConfigError: see `gather`.
    """
    found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    for name, of_seeds in gather(runs, group).items():
        found[name] = dict(sorted((found.get(name, {}) | of_seeds).items()))
    text = json.dumps(dict(sorted(found.items())), indent=1)
    file.write_text(f"{text}\n", encoding="utf-8")


def of_summary(own: Mapping[str, Any]) -> Figures:
    """What tables show of a run.

    Args:
      own: its summary.
    """
    jmvae, agents = own["jmvae"], [*own["dqn"].values()]
    found: dict[str, Any] = {"active_units": jmvae["active_units"]}
    found["detectors"] = [each["accuracy"] for each in own["detectors"].values()]
    if "unambiguous" in jmvae:
        cells = [
            (is_clear, sigma)
            for name, clear in jmvae["unambiguous"].items()
            for is_clear, sigma in zip(clear, jmvae["sigma_norm"][name], strict=True)
        ]
        found["table_one"] = sum(
            is_clear == of_paper
            for name, clear in jmvae["unambiguous"].items()
            for is_clear, of_paper in zip(clear, TABLE_ONE.get(name, ()), strict=False)
        )
        for name, wanted in ("unambiguous", True), ("ambiguous", False):
            found[name] = [sigma for is_clear, sigma in cells if is_clear == wanted]
    if "fusion" in jmvae:
        found |= {f"fusion_{name}": value for name, value in jmvae["fusion"].items()}
    for name in ("moment_matching_error", "consistent"):
        if name in jmvae:
            found[name] = jmvae[name]
    found["grouped"] = jmvae.get("grouped")
    if belief := own.get("belief"):
        found["nll_over_bayes"] = [
            map_ - bayes for map_, bayes in zip(belief["nll"], belief["bayes_nll"], strict=True)
        ]
        found["doubt_correlation"] = belief["doubt_correlation"]
    for name in ("return", "naive", "random", "fraction_of_optimal", "optimal_states"):
        if all(name in agent for agent in agents):
            found[name] = [agent[name] for agent in agents]
    if all("optimal_permutations" in agent for agent in agents):
        found["optimal_permutations"] = [agent["optimal_permutations"] for agent in agents]
    return {**found, "mission": _of_missions(own["mission"])}


def _of_missions(block: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Policies by name, with what is shown of their missions."""
    shown = "accuracy", "observations_per_poi", "time_s", "mean_time_s", "collisions", "episodes"
    return {
        name: {
            **{key: each[key] for key in shown},
            "overconfidence": each["calibration"]["confidence"] - each["calibration"]["accuracy"],
            "nll": each["calibration"]["nll"],
            "longer": each.get("intervals", {}).get("time_s"),
        }
        for name, each in block.items()
        if isinstance(each, Mapping) and "accuracy" in each
    }

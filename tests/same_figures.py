"""`python tests/same_figures.py RUN RUN [--compilers]`: fails if two runs came to other figures.

Of one machine and version of JAX they are the same to the last bit. With `--compilers`, of runs
that different versions have compiled, only what learning does not amplify is compared.
"""

import math
import sys
from pathlib import Path

from smoke import without_times

# Other processors and compilers add and multiply in another order. In the 300 steps of the shared
# run that changes the JMVAE for good, and by a step, as when a rounding error turns on a ReLU:
# sixteen runs whose sensors' noise differed by a few millionths, and others on two lines of JAX,
# came to a handful of JMVAEs. Their fusion had mean errors of .0485 to .0516 and standard
# deviations of .0034 to .0038, from detectors that agree to 1e-5, and random looks returned .316 to
# .377 of an optimum of 2.37. Another processor changed a figure of the JMVAE by 2.5 %.
# What the map says after many looks amplifies that in turn. Returns may be near 0, and of the 12
# PoIs in the missions of the shared run one more may be right, or be looked at once more.
TOLERANCES = {"detectors": 1e-3, "jmvae": 4e-2, "belief": 5e-2}
NEAR_ERRORS = {"jmvae": 5e-3}  # of means and standard deviations on the map
NEAR_RETURN, NEAR_RANDOM_RETURN, NEAR_MISSION = 2e-2, 0.1, 0.1
NOISE = "/ece", "/nll", "/readout_error"
UNTRAINED = "naive", "random"


def numbers(figures, name=""):
    """Every number of nested figures, by its name."""
    if isinstance(figures, dict):
        pairs = figures.items()
    elif isinstance(figures, list):
        pairs = enumerate(figures)
    else:
        return {name: figures} if isinstance(figures, int | float) else {}
    return {n: x for key, value in pairs for n, x in numbers(value, f"{name}/{key}").items()}


def different(first, second, tolerance=0.0, near=0.0):
    """What is not the same, with both values: neither within a share of them nor a difference."""
    names = {**first, **second}
    pairs = {name: (first.get(name, math.nan), second.get(name, math.nan)) for name in names}
    return {
        name: pair
        for name, pair in pairs.items()
        if not math.isclose(*pair, rel_tol=tolerance, abs_tol=near)
    }


def some(figures, *names):
    """Some of nested figures, where they are there."""
    found = numbers(figures)
    return {name: found[f"/{name}"] for name in names if f"/{name}" in found}


def different_across_compilers(first, second):
    """What differs by more than its tolerance, but for trained policies and what follows."""
    found = {}
    for block, tolerance in TOLERANCES.items():
        of_block = (
            # A detector's confidence, not its accuracy, amplifies rounding; an exact readout has
            # no other error.
            {n: x for n, x in numbers(summary[block]).items() if not n.endswith(NOISE)}
            for summary in (first, second)
        )
        found |= different(*of_block, tolerance, NEAR_ERRORS.get(block, 0.0))
    for modality in first["dqn"]:
        agents = [summary["dqn"][modality] for summary in (first, second)]
        # A map that is hardly trained may be read too badly for an optimum, or just well enough.
        known = all(agent["optimal"] is not None for agent in agents)
        names = ("naive", "optimal", "one_step/optimal") if known else ("naive",)
        for chosen, near in ((names, NEAR_RETURN), (("random",), NEAR_RANDOM_RETURN)):
            of_policies = (some(agent, *chosen) for agent in agents)
            found |= different(*of_policies, TOLERANCES["jmvae"], near)
    for policy in UNTRAINED:
        cases = (summary["mission"][policy] for summary in (first, second))
        names = "accuracy", "observations_per_poi", "information", "collisions"
        played = (some(case, *names) for case in cases)
        found |= different(*played, TOLERANCES["jmvae"], NEAR_MISSION)
    return found


if __name__ == "__main__":
    first, second = (without_times(Path(path)) for path in sys.argv[1:3])
    if "--compilers" in sys.argv:
        found = different_across_compilers(first, second)
    else:
        found = different(numbers(first), numbers(second))
    if found:
        sys.exit(f"{sys.argv[1]} and {sys.argv[2]} came to other figures: {found}")

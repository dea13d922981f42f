"""The figures of the shared run, which both lines of JAX come to."""

import copy
import json
from pathlib import Path

from same_figures import different, different_across_compilers, numbers
from smoke import without_times

REFERENCE = Path(__file__).parent / "smoke_figures.json"


def test_figures_are_those_of_every_machine(smoke_run):
    reference = json.loads(REFERENCE.read_text(encoding="utf-8"))
    found = without_times(smoke_run)
    assert not different_across_compilers(found, reference)
    for modality, block in reference["dqn"].items():
        assert set(found["dqn"][modality]) == set(block)


def test_other_figures_are_found():
    found = different({"a": 1.0, "b": 2.0, "c": 0}, {"a": 1.001, "b": 2.0, "d": 0}, 1e-4)
    assert set(found) == {"a", "c", "d"}
    assert not different({"a": 1.0}, {"a": 1.001}, 1e-2)
    assert not different({"a": 0.0}, {"a": 0.01}, near=0.01)
    assert set(numbers({"a": [1, {"b": True}], "c": "x"})) == {"/a/0", "/a/1/b"}


def test_what_other_compilers_must_not_change_is_compared():
    reference = json.loads(REFERENCE.read_text(encoding="utf-8"))
    for block, name, factor in (("jmvae", "moment_matching_error", 1.05), ("detectors", "x", 2)):
        other = copy.deepcopy(reference)
        other[block][name] = other[block].get(name, 1.0) * factor
        assert different_across_compilers(reference, other)
    other = copy.deepcopy(reference)
    other["belief"]["bayes_nll"][2] *= 1.1
    other["dqn"]["lidar"]["naive"] *= 1.05
    other["dqn"]["lidar"]["random"] += 0.15
    other["jmvae"]["fusion"]["mean_error"] *= 1.05
    reference["dqn"]["lidar"]["optimal"] = 1.0
    other["dqn"]["lidar"]["optimal"] = 1.07
    other["dqn"]["camera"]["return"] *= 2  # of a policy that was trained
    other["mission"]["latent"]["accuracy"] /= 2
    other["mission"]["naive"]["accuracy"] -= 2 / 12
    found = different_across_compilers(reference, other)
    assert set(found) == {
        "/fusion/mean_error",
        "/bayes_nll/2",
        "naive",
        "random",
        "optimal",
        "accuracy",
    }

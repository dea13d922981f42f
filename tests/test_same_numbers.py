"""The figures of the shared run, which both lines of JAX come to."""

import json
from pathlib import Path

from same_figures import TOLERANCES, different, numbers
from smoke import without_times

REFERENCE = Path(__file__).parent / "smoke_figures.json"


def test_figures_are_those_of_every_machine(smoke_run):
    reference = json.loads(REFERENCE.read_text(encoding="utf-8"))
    found = without_times(smoke_run)
    for block, tolerance in TOLERANCES.items():
        assert not different(numbers(found[block]), numbers(reference[block]), tolerance)
    for modality, block in reference["dqn"].items():
        for name in ("optimal", "naive", "random"):
            pair = (
                numbers({name: figures[modality][name]})
                for figures in (found["dqn"], reference["dqn"])
            )
            assert not different(*pair, TOLERANCES["jmvae"]), modality
        assert set(found["dqn"][modality]) == set(block)


def test_other_figures_are_found():
    found = different({"a": 1.0, "b": 2.0, "c": 0}, {"a": 1.001, "b": 2.0, "d": 0}, 1e-4)
    assert set(found) == {"a", "c", "d"}
    assert not different({"a": 1.0}, {"a": 1.001}, 1e-2)
    assert set(numbers({"a": [1, {"b": True}], "c": "x"})) == {"/a/0", "/a/1/b"}

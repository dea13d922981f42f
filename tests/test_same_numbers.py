"""The figures of the shared run, which both lines of JAX come to."""

import json
from pathlib import Path

from same_figures import different_across_compilers
from smoke import without_times

REFERENCE = Path(__file__).parent / "smoke_figures.json"


def test_figures_are_those_of_every_machine(smoke_run):
    reference = json.loads(REFERENCE.read_text(encoding="utf-8"))
    found = without_times(smoke_run)
    assert not different_across_compilers(found, reference)
    for modality, block in reference["dqn"].items():
        assert set(found["dqn"][modality]) == set(block)

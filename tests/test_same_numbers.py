"""The figures of the shared run, which both lines of JAX come to."""

import json
from pathlib import Path

import pytest
from smoke import without_times

REFERENCE = Path(__file__).parent / "smoke_figures.json"
# Measured between jax 0.10.2 and 0.11.2 on one machine: 3e-7 in all figures. Other processors add
# and multiply in another order, which 300 steps of learning amplify.
TOLERANCE = 2e-3


def numbers(figures, name=""):
    """Every number of nested figures, by its name."""
    if isinstance(figures, dict):
        pairs = figures.items()
    elif isinstance(figures, list):
        pairs = enumerate(figures)
    else:
        return {name: figures} if isinstance(figures, int | float) else {}
    return {n: x for key, value in pairs for n, x in numbers(value, f"{name}/{key}").items()}


def test_figures_are_those_of_every_machine(smoke_run):
    reference = json.loads(REFERENCE.read_text(encoding="utf-8"))
    found = without_times(smoke_run)
    for block, learned in (("detectors", 1e-3), ("jmvae", TOLERANCE)):
        here, there = numbers(found[block]), numbers(reference[block])
        assert set(here) == set(there)
        for name, value in here.items():
            assert value == pytest.approx(there[name], rel=learned, abs=learned), block + name
    for modality, block in reference["dqn"].items():
        for name in ("optimal", "naive", "random"):
            assert found["dqn"][modality][name] == pytest.approx(block[name], rel=TOLERANCE), name

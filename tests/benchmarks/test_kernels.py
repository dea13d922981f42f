"""Kernels of a profile are counted for the part of a control step that they belong to."""

from types import SimpleNamespace

import pytest

from benchmarks import kernels
from benchmarks.kernels import Part

TEXT = """
  %fusion.1 = f32[] fusion(), metadata={op_name="jit(f)/mission.steer/mission.move/add"}
  ROOT %copy.2 = f32[] copy(), metadata={op_name="jit(f)/mission.ask/mul"}
  %copy.3 = f32[] copy(), metadata={op_name="jit(f)/while/body/mul"}
"""


def event(operation, nanoseconds):
    stats = {} if operation is None else {"hlo_op": operation}
    return SimpleNamespace(stats=stats.items(), duration_ns=nanoseconds)


def plane(name, *events):
    return SimpleNamespace(name=name, lines=[SimpleNamespace(events=events)])


def test_kernels_are_counted_by_the_innermost_part():
    device = plane(
        "/device:GPU:0",
        *(event("fusion.1", 1000), event("fusion.1", 3000), event("copy.2", 500)),
        *(event("copy.3", 250), event("unknown", 250), event(None, 10**6)),
    )
    host = plane("/host:CPU", event("fusion.1", 10**6))
    parts = kernels._parts(SimpleNamespace(planes=[host, device]), TEXT)
    assert parts == {
        "move": Part(2, pytest.approx(4e-6)),
        "ask": Part(1, pytest.approx(0.5e-6)),
        "other": Part(2, pytest.approx(0.5e-6)),
    }

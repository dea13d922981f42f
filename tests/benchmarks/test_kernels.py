"""Kernels of a profile are counted for the part of a control step that they belong to."""

from types import SimpleNamespace

import jax
import pytest

from benchmarks import kernels
from benchmarks.kernels import Part
from jaxsense import init, mission

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


def test_the_table_adds_up_the_parts_of_a_step():
    steer, move = ({"kernels": n, "seconds": s} for n, s in ((40, 0.02), (20, 0.04)))
    results = {
        **{"command": "python -m x", "commit": "0" * 40, "date": "2026-01-01", "cores": 2},
        **{"device": "cpu", "versions": {"jax": "0.10.2"}, "steps": 20},
        "cases": {
            "few": {"wall_s": 0.08, "parts": {"steer": steer, "move": move}},
            "robots": {"wall_s": 0.1, "parts": {"steer": steer}},
        },
    }
    lines = kernels.table(results).splitlines()
    assert lines[0] == (
        "| kernels in a step; ms | 384 missions, 2 robots, 3 PoIs "
        "| 2,048 missions, 6 robots, 16 PoIs |"
    )
    assert lines[2:6] == [
        "| all | 3; 3.00 | 2; 1.00 |",
        "| wall clock, without the profiler | 4.00 | 5.00 |",
        # The longest parts first.
        "| `steer` | 2; 1.00 | 2; 1.00 |",
        "| `move` | 1; 2.00 | 0; 0.00 |",
    ]


def test_six_robots_are_counted_in_missions_that_can_begin(monkeypatch, capsys):
    counted = []

    def playing(config, policy, batch, steps):
        scenario = mission.make_mission(config)
        begin = lambda key: mission.reset(key, scenario, init(key, config), scenario.policy(policy))  # noqa: E731
        begun = jax.eval_shape(begin, jax.random.key(0))
        counted.append((batch, len(begun.scene.poses), len(begun.classes), config.arena.side))
        return SimpleNamespace(compiled=lambda options: None)

    monkeypatch.setattr(kernels, "playing", playing)
    monkeypatch.setattr(kernels, "profile", lambda program, missions: (1.0, {"ask": Part(20, 0.5)}))
    kernels.main(["--cases", "robots"])
    assert counted == [(2048, 6, 16, 6.0)]
    assert "| 2,048 missions, 6 robots, 16 PoIs |" in capsys.readouterr().out


def test_unknown_cases_are_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        kernels.main(["--cases", "few", "fewer"])
    assert stop.value.code == 2
    assert "cases = 'fewer': must be one of few, many, pois, robots" in capsys.readouterr().err

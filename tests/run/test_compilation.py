"""Programs that compile in the background."""

import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.monitor import Monitor


def test_compiling_and_running_are_timed_apart_and_reported():
    heard = []
    monitor = Monitor(lambda *report: heard.append(report))
    program = Program(Compiler(monitor), "stage", "run")
    shape = program.compile(lambda x: 2 * x, jnp.float32(3))
    assert (shape.shape, shape.dtype) == ((), jnp.float32)
    assert program(jnp.float32(3)) == 6
    timing = monitor.timing()
    (seconds,) = timing["stages"].values()
    assert list(timing["stages"]) == ["stage"]
    assert 0 < seconds["run_s"] < seconds["compile_s"]
    assert seconds["run_s"] + seconds["compile_s"] < timing["total_s"]
    monitor.report("stage", 2, 4, np.array([1.0, 3.0]), epsilon=0.5)
    heard = [report for report in heard if report[2]]  # it may have been compiled in time
    assert heard == [("stage", 2, 4, {"loss": 2.0, "epsilon": 0.5})]


def test_a_program_may_be_called_before_it_is_compiled():
    heard = []
    program = Program(Compiler(Monitor(lambda *report: heard.append(report))), "stage", "run")
    with ThreadPoolExecutor(1) as executor:
        result = executor.submit(program, jnp.float32(3))
        while not heard:
            time.sleep(0.01)
        program.compile(lambda x: 2 * x, jnp.float32(0))
        assert result.result() == 6
    assert heard == [("stage", 0, 0, {})]


def test_what_is_released_is_not_compiled_any_more(monkeypatch):
    compiler, queued = Compiler(Monitor()), []
    program = Program(compiler, "stage", "run")
    monkeypatch.setattr(compiler.threads, "submit", queued.append)
    program.compile(lambda x: x, jnp.float32(0))
    program.release()
    monkeypatch.setattr(
        jax.stages.Lowered, "compile", lambda *_, **options: pytest.fail("compiled")
    )
    queued[0]()
    with pytest.raises(RuntimeError, match="run of stage was released"):
        program.wait()

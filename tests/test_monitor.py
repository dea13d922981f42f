"""What a stage tells the outside: time, progress and bad ends."""

import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.monitor import Monitor, Program, StageError


def test_compiling_and_running_are_timed_apart_and_reported():
    heard = []
    monitor = Monitor(lambda *report: heard.append(report))
    program = Program(monitor, "stage")
    shape = program.compile(lambda x: 2 * x, jnp.float32(3))
    assert (shape.shape, shape.dtype) == ((), jnp.float32)
    assert program(jnp.float32(3)) == 6
    assert set(monitor.seconds["stage"]) == {"compile_s", "run_s"}
    assert all(seconds > 0 for seconds in monitor.seconds["stage"].values())
    monitor.report("stage", 2, 4, np.array([1.0, 3.0]), epsilon=0.5)
    heard = [report for report in heard if report[2]]  # it may have been compiled in time
    assert heard == [("stage", 2, 4, {"loss": 2.0, "epsilon": 0.5})]


def test_a_program_may_be_called_before_it_is_compiled():
    heard = []
    program = Program(Monitor(lambda *report: heard.append(report)), "stage")
    with ThreadPoolExecutor(1) as executor:
        result = executor.submit(program, jnp.float32(3))
        while not heard:
            time.sleep(0.01)
        program.compile(lambda x: 2 * x, jnp.float32(0))
        assert result.result() == 6
    assert heard == [("stage", 0, 0, {})]


def test_whoever_waits_for_a_program_hears_why_it_cannot_come():
    waiting, broken = (Program(Monitor(), "stage") for _ in range(2))
    waiting.fail(RuntimeError("no way"))
    with pytest.raises(RuntimeError, match="no way"):
        waiting()
    broken.compile(lambda x: x, jnp.float32(0))
    assert broken(jnp.float32(1)) == 1
    broken.fail(RuntimeError("too late"))
    assert broken(jnp.float32(1)) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_first_step_with_a_loss_that_is_not_finite_is_named(value):
    # Steps 5 to 8 of 12; the third of them, step 7, is the first bad one.
    losses = np.array([1.0, 1.0, value, np.nan])
    with pytest.raises(StageError, match=rf"dqn_camera: loss = {value} at step 7 of 12"):
        Monitor().report("dqn_camera", 8, 12, losses)


def test_parameters_that_are_not_finite_are_named():
    Monitor().check_finite("jmvae", {"a": jnp.ones(2), "b": jnp.zeros(3)})
    with pytest.raises(StageError, match="jmvae: parameters are not finite after the last step"):
        Monitor().check_finite("jmvae", {"a": jnp.ones(2), "b": jnp.array([0.0, jnp.nan])})

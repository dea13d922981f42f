"""What a stage tells the outside: time, progress and bad ends."""

from concurrent.futures import Future
from threading import Timer

import pytest

from jaxsense.run import monitor as module
from jaxsense.run.monitor import Monitor, StageError, Stopped


def test_a_stopwatch_adds_up_the_seconds_of_each_stage(monkeypatch):
    now = iter([100.0, 101.0, 103.0, 110.0, 111.0, 112.0, 115.0, 140.0, 200.0, 207.0])
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(now))
    watch = Monitor()
    for kind in ("compile_s", "compile_s", "run_s"):  # 2 s, 1 s and 3 s
        with watch.measure(kind, "dqn"):
            pass
    stages = {"dqn": {"compile_s": 3.0, "run_s": 3.0}}
    assert watch.timing() == {"total_s": 40.0, "stages": stages}
    watch.restart()
    assert watch.timing() == {"total_s": 7.0, "stages": {}}


def test_another_run_has_a_listener_of_its_own():
    heard = []
    monitor = Monitor(lambda *report: heard.append(("first", *report)))
    monitor.progress("jmvae", 1, 2)
    monitor.begin(lambda *report: heard.append(("second", *report)))
    monitor.progress("dqn", 1, 2)
    assert heard == [("first", "jmvae", 1, 2, {}), ("second", "dqn", 1, 2, {})]


def test_a_wait_ends_with_the_result_or_when_the_run_must_stop():
    monitor, future = Monitor(), Future[int]()
    Timer(0.05, future.set_result, (3,)).start()
    assert monitor.wait_for(future) == 3
    Timer(0.05, monitor.stop).start()
    with pytest.raises(Stopped):
        monitor.wait_for(Future[int]())
    assert monitor.wait_for(future) == 3  # is there already


def test_stages_stop_if_they_are_asked_to_and_if_one_of_them_has_failed():
    asked, failed = Monitor(), Monitor()
    assert not asked.is_stopping
    asked.check_stop()
    asked.stop()
    failed.fail(StageError("jmvae: loss = nan"))
    assert asked.is_stopping
    assert failed.is_stopping
    with pytest.raises(Stopped):
        asked.check_stop()
    with pytest.raises(StageError, match="jmvae: loss = nan"):
        failed.check_stop()


def test_another_run_forgets_a_stage_that_failed_and_nothing_else():
    monitor = Monitor()
    monitor.fail(StageError("jmvae: loss = nan"))
    monitor.begin(lambda *_: None)
    monitor.check_stop()
    monitor.fail(StageError("jmvae: loss = nan"))
    monitor.fail(ArithmeticError("cannot be traced"))
    monitor.begin(lambda *_: None)
    with pytest.raises(ArithmeticError):
        monitor.check_stop()

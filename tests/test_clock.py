"""The clock of a run."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from jaxsense.run.clock import Clock, process_start


def test_spans_are_of_the_thread_that_does_something():
    clock = Clock()
    with ThreadPoolExecutor(1, "other") as threads, clock.record("run", "jmvae", "begin"):
        threads.submit(clock.add, "save", since=0.0).result()
    other, own = clock.spans
    assert (other.kind, other.stage, other.thread) == ("save", "", "other_0")
    assert (own.kind, own.stage, own.program, own.thread) == ("run", "jmvae", "begin", "MainThread")
    assert 0 == other.start_s < own.start_s < other.end_s < own.end_s < clock.now


def test_what_fails_has_taken_time_too():
    clock = Clock()
    with pytest.raises(ValueError, match="no"), clock.record("run"):
        raise ValueError("no")
    assert [span.kind for span in clock.spans] == ["run"]


def test_the_rest_begins_where_the_last_span_of_the_thread_ended():
    clock = Clock(time.perf_counter() - 5)
    clock.add_rest("import")
    clock.add_rest("start")
    first, second = clock.spans
    assert first.start_s == 0
    assert 5 <= first.end_s == second.start_s < 6
    clock.restart()
    assert clock.spans == []
    clock.add_rest("start")
    assert clock.spans[0].start_s == clock.begin > second.end_s


def test_the_process_started_before_this_and_not_before_the_machine():
    assert 0 < process_start() < time.perf_counter()

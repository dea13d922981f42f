"""The profile of a run: what its spans add up to."""

import itertools

import pytest

from jaxsense.summary import profile
from jaxsense.summary.profile import Span


def span(kind, start, end, stage="", thread=profile.MAIN):
    return Span(kind, stage, "begin" if stage else "", thread, float(start), float(end))


# The main thread starts, waits from 2 s to 12 s, and draws.
SPANS = [
    span("start", 0, 2),
    span("wait_stages", 2, 12),
    span("draw", 12, 16),
    span("trace", 1, 4, "jmvae", "trace_0"),
    span("compile", 4, 6, "jmvae", "compile_0"),
    span("compile", 5, 9, "dqn", "compile_1"),
    span("wait_program", 2, 6, "jmvae", "stage_0"),
    span("run", 6, 8, "jmvae", "stage_0"),
    span("save", 8, 10, "jmvae", "save_0"),
]


def test_each_moment_counts_once():
    found = profile.parts(SPANS)
    assert found == {
        ("draw", ""): 4,
        ("start", ""): 2,  # also while jmvae is traced
        ("trace", "jmvae"): 2,  # of 3, for the main thread works in the first
        ("compile", "jmvae"): 1.5,  # alone for 1 s, and half of a second with dqn
        ("compile", "dqn"): 1.5,  # half a second before jmvae runs, and one after it has run
        ("run", "jmvae"): 2,  # while dqn is compiled
        ("wait_stages", ""): 3,  # from 9 s to 12 s; saving takes no time of others
    }
    assert sum(found.values()) == 16
    assert [*found.values()] == sorted(found.values(), reverse=True)


def test_the_largest_part_and_what_was_waited_for_are_told():
    assert profile.verdict(SPANS) == (
        "The largest part of 16.0 s was drawing: 4.0 s. For 5.0 s no stage ran, because programs "
        "were traced, compiled or loaded; most of it for jmvae 3.5 s, dqn 1.5 s."
    )
    assert profile.verdict([span("run", 0, 4, "mission")]) == (
        "The largest part of 4.0 s was running mission: 4.0 s."
    )
    assert profile.verdict([]) is None


def test_stages_count_all_threads():
    loaded = span("load", 0, 0.25, "dqn", "compile_0")
    read = span("read", 0, 9, "dqn", "dqn")  # a checkpoint: nothing is compiled
    assert profile.of_stages([*SPANS, loaded, read, span("load", 0, 9)]) == {
        "jmvae": {"compile_s": 5.0, "run_s": 2.0},
        "dqn": {"compile_s": 4.25, "run_s": 0.0},
    }


def test_spans_are_read_as_they_were_written(tmp_path):
    (tmp_path / profile.FILE).write_text(profile.as_text(SPANS), encoding="utf-8")
    found = profile.read(tmp_path)
    assert sorted(found, key=str) == sorted(SPANS, key=str)
    assert all(a.start_s <= b.start_s for a, b in itertools.pairwise(found))


@pytest.mark.parametrize("content", [None, "{", "[]", '{"spans": [{"kind": "run"}]}', "{}"])
def test_a_file_that_is_missing_or_damaged_holds_no_spans(tmp_path, content):
    if content is not None:
        (tmp_path / profile.FILE).write_text(content, encoding="utf-8")
    assert profile.read(tmp_path) == []

"""The check of what a run needs, compared with the baseline."""

import dataclasses

import pytest

from benchmarks import growth, pipeline

BEFORE = growth.Needs(100.0, 1000.0, {"survey-begin": 1000, "mission-go_on": 30_000})


def test_figures_may_grow_by_a_tenth(capsys):
    now = growth.Needs(110.0, 1100.0, {"survey-begin": 1100, "mission-go_on": 33_000})
    assert growth.compare(BEFORE, now) == []
    assert "operations of survey-begin" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "grown"),
    [
        ({"cpu_s": 111.0}, ["CPU seconds"]),
        ({"memory_mib": 1101.0}, ["peak memory [MiB]"]),
        # Small next to the sum of all programs.
        (
            {"operations": {**BEFORE.operations, "survey-begin": 1101}},
            ["operations of survey-begin"],
        ),
        (
            {"operations": {**BEFORE.operations, "new-begin": 1}},
            ["operations of new-begin", "programs"],
        ),
    ],
)
def test_what_has_grown_is_named(change, grown):
    assert growth.compare(BEFORE, dataclasses.replace(BEFORE, **change)) == grown


def test_the_pair_in_which_a_figure_has_grown_least_counts():
    # The machine was fast during one run of the earlier tree, and slow during the second pair.
    before = [dataclasses.replace(BEFORE, cpu_s=cpu_s) for cpu_s in (80.0, 150.0)]
    after = [dataclasses.replace(BEFORE, cpu_s=100.0), dataclasses.replace(BEFORE, cpu_s=155.0)]
    after[1] = dataclasses.replace(after[1], memory_mib=1200.0)
    old, new = growth.least(before, after)
    assert (old.cpu_s, new.cpu_s) == (150.0, 155.0)
    assert (old.memory_mib, new.memory_mib) == (1000.0, 1000.0)
    assert growth.compare(old, new) == []


def test_a_tree_that_leaves_no_programs_is_not_compared(monkeypatch, tmp_path):
    def python(tree, words, place):
        (place / "operations.json").write_text("{}")

    monkeypatch.setattr(pipeline, "run", lambda *_: pipeline.Needs(1.0, 1.0, 1.0))
    monkeypatch.setattr(pipeline, "python", python)
    with pytest.raises(SystemExit, match="traced: must hold the programs of a training"):
        growth.train(tmp_path, tmp_path)


@pytest.mark.parametrize(
    ("seconds", "times", "expected"),
    [
        ([100.0, 100.0], 2, []),
        # A slow moment of the machine.
        ([130.0, 125.0, 105.0], 3, []),
        ([130.0, 125.0, 120.0, 118.0], 4, ["CPU seconds"]),
    ],
)
def test_what_seems_to_have_grown_is_measured_again(
    monkeypatch, tmp_path, seconds, times, expected
):
    old, now = tmp_path / "tree", tmp_path / "changed"
    trained = []

    def train(tree, place):
        assert place.is_dir()
        trained.append(tree)
        cpu_s = 100.0 if tree == old else seconds[trained.count(now) - 1]
        return dataclasses.replace(BEFORE, cpu_s=cpu_s)

    monkeypatch.setattr(growth, "train", train)
    assert growth.grown(old, now, tmp_path, pairs=2) == expected
    assert trained == ([old, now, now, old] * times)[: 2 * times]

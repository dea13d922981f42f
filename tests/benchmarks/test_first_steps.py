"""What a newcomer waits for: what runs where, what of it counts, and its table."""

import json
import re
from pathlib import Path

import pytest

from benchmarks import first_steps, measure, pipeline, results
from benchmarks.pipeline import Needs


@pytest.fixture
def ran(monkeypatch):
    """What would have run: words, directory and home; each takes a second more than the last."""
    calls = []

    def python(tree, words, place, variables):
        assert tree == pipeline.ROOT
        assert list(place.iterdir()) == []
        home = Path(variables["HOME"])
        assert Path(variables["XDG_CACHE_HOME"]) == home / ".cache"
        calls.append((words, place, home))
        return Needs(float(len(calls)), 0.0, 0.0)

    monkeypatch.setattr(pipeline, "python", python)
    return calls


def test_a_step_runs_again_with_the_home_of_its_first_time(ran, tmp_path):
    steps = {name: first_steps.of_step(name, tmp_path / name) for name in ("program", "demo")}
    assert steps == {"program": {"first": 1, "again": 2}, "demo": {"first": 3, "again": 4}}
    (program, here, home), (same, there, again), (demo, _, other), _ = ran
    assert (program, home) == (same, again)
    assert here != there
    assert other != home
    assert demo == ("-m", "jaxsense", "demo", "--no-browser")


@pytest.mark.parametrize(
    ("step", "path"),
    [
        ("program", "README.md"),
        ("tasks", "docs/tasks.md"),
        ("jmvae", "docs/jmvae.md"),
        ("functions", "docs/functions.md"),
    ],
)
def test_the_program_is_the_first_of_its_page(step, path, ran, tmp_path):
    first_steps.of_step(step, tmp_path / "program")
    (option, program), *_ = ran[0]
    page = (pipeline.ROOT / path).read_text(encoding="utf-8")
    before, _, after = page.partition(f"```python\n{program}```")
    assert option == "-c"
    assert re.search("import jaxsense|from jaxsense import", program)
    assert after
    assert "```python" not in before


def test_imports_take_turns_and_the_median_of_what_they_add_counts(
    ran, tmp_path, capsys, monkeypatch
):
    # Another commit is made while the first import runs.
    commit = lambda: "fedcba9876543210" if ran else "0123456789abcdef"  # noqa: E731
    monkeypatch.setattr(measure.version, "commit", commit)
    out = tmp_path / "first_steps.json"
    first_steps.main(["--steps", "demo", "--repeats", "3", "--json", str(out)])
    programs = [words[-1] for words, _, _ in ran]
    turn = ["pass", "import jaxsense", "import jaxsense.vae", "import jaxsense.dqn"]
    assert programs[:12] == 3 * turn
    stored = json.loads(out.read_text(encoding="utf-8"))
    assert stored["commit"] == "0123456789abcdef"
    assert stored["command"] == "python -m benchmarks.first_steps --steps demo --repeats 3"
    assert stored["imports"]["import jaxsense.vae"] == [3.0, 7.0, 11.0]
    assert stored["steps"] == {"demo": {"first": 13.0, "again": 14.0}}
    # More than the 1, 5 and 9 of the empty program in the same turn: 8, 1 and 0.5.
    stored["imports"]["import jaxsense"] = [9.0, 6.0, 9.5]
    shown = first_steps.table(stored)
    assert shown.splitlines()[:6] == [
        "| step | seconds at first | again |",
        "| --- | --- | --- |",
        "| `import jaxsense` |  | 1.00 |",
        "| `import jaxsense.vae` |  | 2.00 |",
        "| `import jaxsense.dqn` |  | 3.00 |",
        "| `jaxsense demo` | 13.0 | 14.0 |",
    ]
    assert "| `import jaxsense.dqn` |  | 3.00 |" in capsys.readouterr().out


@pytest.mark.parametrize("commit", [None, "0123456789abcdef-dirty"])
def test_only_what_a_commit_holds_is_stored(ran, tmp_path, capsys, monkeypatch, commit):
    monkeypatch.setattr(measure.version, "commit", lambda: commit)
    with pytest.raises(SystemExit) as stop:
        first_steps.main(["--json", str(tmp_path / "first_steps.json")])
    assert stop.value.code == 2
    assert f"commit = {commit!r}: must be one without changes" in capsys.readouterr().err
    assert not ran
    assert not any(tmp_path.iterdir())


def test_unknown_steps_are_refused(ran, capsys):
    with pytest.raises(SystemExit) as stop:
        first_steps.main(["--steps", "install"])
    assert stop.value.code == 2
    assert (
        "steps = 'install': must be one of program, tasks, jmvae, functions, robot, demo"
        in capsys.readouterr().err
    )
    assert not ran


@pytest.mark.slow  # imports all of JAX ten times
def test_a_newcomer_gets_through(capsys):
    first_steps.main(["--steps", "program", "--repeats", "1"])
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[3:6]]
    assert rows[-1][0] == "| the first program of the README"
    assert all(float(row[-1].strip(" |")) > 0 for row in rows)


def test_all_steps_are_stored():
    stored = json.loads((results.RESULTS / "first_steps.json").read_text(encoding="utf-8"))
    assert [*stored["steps"]] == [*first_steps.STEPS]

"""The tables of `benchmarks/RESULTS.md`."""

import json
import re
import subprocess
from pathlib import Path

import pytest

import jaxsense
from benchmarks import ROWS, history, results

ROOT = Path(__file__).parents[2]
PACKAGE = Path(jaxsense.__file__).parent  # which may be installed elsewhere
ROW = {
    "row": "rays", "unit": "rays/s", "ours": 1234567.8, "peer": "mujoco", "theirs": 45678.9,
    "ratio": 27.03, "compile_s": 1.0, "device": "cpu", "batch": 2048, "commit": "0123456789abcdef",
    "versions": {"python": "3.11.7", "jax": "0.10.2"}, "date": "2026-11-26", "cores": 2,
    "command": "python -m benchmarks rays --peers", "also": {},
}  # fmt: skip


def test_a_table_shows_what_was_measured_where_and_when():
    alone = {**ROW, "row": "missions", "theirs": None, "ratio": None, "ours": 12.345}
    lines = results.table([{**ROW, "also": {"tests/s": 7.0}}, alone]).splitlines()
    assert lines[2] == (
        "| `rays` | 1,234,568 rays/s, 7 tests/s | mujoco | 45,679 | 27 x | 2,048 | 0123456789 |"
    )
    assert lines[3] == "| `missions` | 12.3 rays/s |  |  |  | 2,048 | 0123456789 |"
    assert lines[4:] == [
        "",
        "`python -m benchmarks rays missions --peers`: cpu with 2 cores; commit 0123456789 on "
        "2026-11-26; python 3.11.7, jax 0.10.2.",
    ]


@pytest.mark.parametrize(
    ("differs", "expected"),
    [
        ({"commit": "fedcba9876543210"}, "cpu with 2 cores; commit fedcba9876 on 2026-11-26; "),
        ({"device": "NVIDIA"}, "NVIDIA with 2 cores; commit 0123456789 on 2026-11-26; "),
        ({"date": "2026-11-27"}, "cpu with 2 cores; commit 0123456789 on 2026-11-27; "),
        ({"versions": {"python": "3.13.0"}}, "2026-11-26; python 3.13.0."),
    ],
)
def test_rows_measured_apart_have_lines_of_their_own(differs, expected):
    alone = {"theirs": None, "ratio": None}
    rows = [ROW, {**ROW, **alone, "row": "jmvae", **differs}, {**ROW, "row": "physics"}]
    lines = results.table(rows).splitlines()
    first, second = lines[6], lines[8]
    assert first.startswith("`python -m benchmarks rays physics --peers`: cpu with 2 cores; ")
    assert first.endswith("commit 0123456789 on 2026-11-26; python 3.11.7, jax 0.10.2.")
    assert second.startswith("`python -m benchmarks jmvae`: ")
    assert expected in second
    assert len(lines) == 9


def test_a_row_of_code_that_has_changed_says_so():
    rows = [{**ROW, "changed": True}, {**ROW, "changed": False}]
    changed, same = results.table(rows).splitlines()[2:4]
    assert changed.endswith("| 0123456789, changed since |")
    assert same.endswith("| 0123456789 |")


def test_pages_show_the_stored_results():
    text = ""
    for path in results.PAGES:
        page = path.read_text(encoding="utf-8")
        assert results.written(page) == page, "run python -m benchmarks.results"
        text += page
    for path in results.RESULTS.glob("*.json"):
        for name in results.TABLES[path.name]:
            assert f"<!-- {path.name}{f' {name}' if name else ''} -->" in text


@pytest.mark.parametrize("name", results.ROWS)
def test_every_row_is_shown(name):
    page = results.PAGES[-1].read_text(encoding="utf-8")
    rows = json.loads((results.RESULTS / name).read_text(encoding="utf-8"))
    assert {row["row"] for row in rows} <= ROWS.keys()
    for row in rows:
        assert f"| `{row['row']}` |" in page


def test_other_text_of_the_page_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    (tmp_path / "cpu.json").write_text(json.dumps([ROW]))
    page = results.written("before\n<!-- cpu.json -->\nold\n<!-- end -->\nafter")
    assert page.startswith("before\n<!-- cpu.json -->\n\n| row |")
    assert page.endswith(".\n\n<!-- end -->\nafter")


def test_what_changes_a_program_is_told_from_what_does_not():
    before = """
import jax

class Row:
    name: str

def rate(x: float) -> float:
    return 2 * x
"""
    after = """'''About rates.'''
from jax import Array

class Row:
    '''A row.'''
    name: object  # of the row

def rate(x: Array) -> Array:
    '''The rate.'''
    return 2 * x
"""
    assert history.program(before) == history.program(after)
    assert history.program(before) != history.program(after.replace("2 * x", "3 * x"))
    assert history.program(before) != history.program(after.replace("rate(x", "rate(y"))
    other = f"FACTOR = 3\n{after}\ndef other():\n    return FACTOR\n"
    assert history.program(before, "rate") == history.program(other, "rate")
    checked = other.replace("return 2", "checks.require_finite('x', x)\n    return 2")
    assert checked != other
    assert history.program(checked, "rate") == history.program(other, "rate")
    refused = other.replace("return 2", "if x < 0:\n        raise ValueError(x)\n    return 2")
    assert history.program(refused, "rate") == history.program(other, "rate")
    chosen = refused.replace("return 2", "else:\n        x = -x\n    return 2")
    assert history.program(chosen, "rate") != history.program(other, "rate")
    told = refused.replace("raise ValueError(x)", "why = 2\n        raise ValueError(why)")
    assert history.program(told, "rate") == history.program(other, "rate")
    own = "_check(x)\n    require_one()\n    for each in x:\n        checks.require(each)\n    "
    helped = other.replace("return 2", f"{own}return 2") + "def _check(x):\n    print(x)\n"
    assert history.program(helped, "rate") == history.program(other, "rate")
    assert history.program(helped) == history.program(other)
    for guard in (
        "try:\n        checks.f(x)\n    finally:\n        pass",
        "with x:\n        chex.f(x)",
    ):
        history.program(other.replace("return 2", f"{guard}\n    return 2"), "rate")
    branched = other.replace(
        "return 2", "if x:\n        chex.f(x)\n    else:\n        x = 1\n    return 2"
    )
    assert history.program(branched, "rate") != history.program(other, "rate")
    named = other.replace("return 2", "if (y := f(x)) > 3:\n        raise ValueError\n    return 2")
    assert history.program(named, "rate") != history.program(named.replace("f(x)", "g(x)"), "rate")
    stopped = other.replace("return 2", "if x > 3:\n        raise StopIteration\n    return 2")
    assert history.program(stopped, "rate") != history.program(other, "rate")
    pair = other.replace("FACTOR = 3", "FACTOR, OTHER = 3, 4")
    of_four = pair.replace("3, 4", "4, 4")
    assert history.program(pair, "other") != history.program(of_four, "other")
    # What returns something is no check, whatever its name.
    used = (
        other.replace("return 2 * x", "return 2 * _checked(x)") + "def _checked(x):\n    return x\n"
    )
    doubled = used.replace("return x", "return 2 * x")
    assert history.program(used, "rate") != history.program(doubled, "rate")
    post = "    def __post_init__(self):\n        checks.require_tuple('name', self.name)\n"
    guarded = before.replace("    name: str\n", f"    name: str\n{post}")
    assert guarded != before
    assert history.program(guarded) == history.program(before)
    made = guarded.replace("self.name)\n", "self.name)\n        self.size = 1\n")
    assert history.program(made) != history.program(before)
    called = other.replace("return 2", "log.write('x', x)\n    return 2")
    assert history.program(called, "rate") != history.program(other, "rate")
    changed = other.replace("2 * x", "3 * x")
    assert history.program(before, "rate") != history.program(changed, "rate")
    later = other.replace("FACTOR = 3", "FACTOR = 4")
    assert history.program(other, "rate") == history.program(later, "rate")
    assert history.program(other, "other") != history.program(later, "other")


def test_a_function_uses_constants_with_types_and_not_what_its_arguments_are_called():
    module = """A: int = 1

def rate(other):
    return A * other

def other():
    return 2
"""
    for text, differs in (("A: int = 3", True), ("A: float = 1", False)):
        after = module.replace("A: int = 1", text)
        assert (history.program(module, "rate") != history.program(after, "rate")) == differs
    assert history.program(module, "rate") == history.program(module.replace("2", "3"), "rate")
    # Of two functions, one has an argument of the name and the other uses the module's.
    both = module.replace("return A", "return (lambda A: A)(other) + A")
    changed = both.replace("A: int = 1", "A: int = 3")
    assert history.program(both, "rate") != history.program(changed, "rate")


def test_the_code_of_every_row_is_known():
    assert history.CODE.keys() == {*ROWS, history.WHOLE}
    for places in history.CODE.values():
        for place in (*places, *history._COMPILED):
            path, _, name = place.partition(":")
            file = ROOT / path if path.startswith("benchmarks/") else PACKAGE / path
            assert file.exists(), place
            assert not name or re.search(rf"\n(def|class) {name}\b", file.read_text("utf-8"))


def commits(content):
    """Every commit that a result names, with that of its models and of what it compares with."""
    if isinstance(content, list):
        return set().union(*map(commits, content))
    if not isinstance(content, dict):
        return set()
    own = {commit for key, commit in content.items() if key == "commit"}
    return own.union(*map(commits, content.values()))


@pytest.fixture
def past():
    """Hashes of all commits."""
    if not history.is_whole():
        pytest.skip("the whole history is not here")
    return history.commits()


@pytest.mark.parametrize("path", sorted(results.RESULTS.glob("*.json")), ids=lambda x: x.stem)
def test_results_name_commits_of_the_history(path, past):
    named = commits(json.loads(path.read_text(encoding="utf-8")))
    assert named
    lost = [commit for commit in named if not any(x.startswith(str(commit)) for x in past)]
    assert not lost, "measure again with a committed tree, and keep its commit"


@pytest.mark.parametrize("name", results.CHANGES)
def test_rows_tell_whether_their_code_has_changed(name, past, tmp_path):
    stored = (results.RESULTS / name).read_text(encoding="utf-8")
    (tmp_path / name).write_text(stored, encoding="utf-8")
    history.note(tmp_path / name, results.CHANGES[name])
    noted = (tmp_path / name).read_text(encoding="utf-8")
    assert noted == stored, "run python -m benchmarks.results"


@pytest.fixture
def repository(monkeypatch, tmp_path):
    """Commits the text of a module that rows measure, and returns the commit."""
    who = ["-c", "user.name=x", "-c", "user.email=x@example.org"]

    def git(*words):
        command = ["git", "-C", str(tmp_path), *who, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    def commit(name, text):
        path = tmp_path / history.PACKAGE / "sim" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        git("add", ".")
        git("commit", "-m", "a module")
        return git("rev-parse", "HEAD")

    git("init")
    monkeypatch.setattr(history, "ROOT", tmp_path)
    return commit


def test_code_changes_between_commits(repository):
    first = repository("raycast.py", "x = 1")
    assert history.commits() == [first]
    second = repository("raycast.py", "'''About x.'''\nx = 1  # m")
    assert history.commits() == [second, first]
    assert not history.has_changed("rays", first)
    repository("drives.py", "y = 1")
    assert not history.has_changed("rays", first)
    third = repository("arena.py", "y = 1")
    assert not history.has_changed("physics", first)  # nothing uses the new module
    repository("arena.py", "y = 2")
    assert history.has_changed("physics", third)
    (history.ROOT / "jaxsense" / "sim" / "raycast.py").write_text("x = 2")  # not yet committed
    assert history.has_changed("rays", first)
    assert history.has_changed("resets_many", first)  # measures the folder
    with pytest.raises(ValueError, match=r"commit = '0000.*' of row rays: must be one of the hist"):
        history.has_changed("rays", "0" * 40)


def test_rows_note_changes(repository):
    repository("raycast.py", "x = 1")
    commit = repository("drives.py", "y = 1")
    repository("drives.py", "y = 2")
    path = history.ROOT / "cpu.json"
    rows = [{"row": name, "commit": commit} for name in ("rays", "resets_many")]
    path.write_text(json.dumps(rows))
    history.note(path)
    assert [row["changed"] for row in json.loads(path.read_text())] == [False, True]


def test_whole_commands_note_changes(repository):
    commit = repository("raycast.py", "x = 1")
    path = history.ROOT / "pipeline.json"
    path.write_text(json.dumps({"commit": commit, "commands": {}}))
    for text, expected in (("x = 1  # m", False), ("x = 2", True)):
        repository("raycast.py", text)
        history.note(path, history.WHOLE)
        assert json.loads(path.read_text())["changed"] is expected


def test_without_the_history_rows_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(history, "ROOT", tmp_path)
    (tmp_path / "cpu.json").write_text("as it was")
    history.note(tmp_path / "cpu.json")
    assert (tmp_path / "cpu.json").read_text() == "as it was"

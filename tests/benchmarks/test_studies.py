"""What studies note of their results, and the tables of those without a test of their own."""

import json
from pathlib import Path

import pytest

from benchmarks import exported, gate, imperfect, pipeline, results, studies
from benchmarks.results import PAGES, TABLES
from jaxsense.config import options

ORIGIN = {
    "command": "python -m benchmarks.gate", "device": "cpu", "cores": 2,
    "commit": "0123456789abcdef", "date": "2026-11-26", "versions": {"jax": "0.10.2"},
}  # fmt: skip


@pytest.mark.parametrize(
    ("program", "line"),
    [
        (gate, "pretrained:default 'runs/my run' --looks 2000 --search-position 0.09"),
        (imperfect, "pretrained:noisy --episodes 8 --positions --headings --losses 0.5 0.9"),
        (exported, "runs/a --states 5 --trust"),
        (pipeline, "ce31224 --commands cold warm"),
    ],
)
def test_the_command_measures_the_same_again(program, line):
    words = studies.shlex.split(line)
    given = options.read(program.Arguments, [*words, "--json", "here.json"])
    assert studies.command(program.PROGRAM, given) == f"python -m {program.PROGRAM} {line}"


def test_results_say_what_made_them(tmp_path):
    arguments = gate.Arguments(runs=(Path("pretrained:noisy"),), looks=7)
    found = studies.origin(gate.PROGRAM, arguments)
    assert found["options"]["looks"] == 7
    assert found["models"]["pretrained:noisy"]["command"].startswith("python -m jaxsense.train")
    assert found["command"] == "python -m benchmarks.gate pretrained:noisy --looks 7"
    studies.write(tmp_path / "found.json", found)
    assert json.loads((tmp_path / "found.json").read_text())["commit"] == found["commit"]


def test_a_run_says_what_made_it(tmp_path):
    content = {"preset": "noisy", "seed": 3, "commit": "0123", "versions": {}, "config": {}}
    (tmp_path / "config.json").write_text(json.dumps(content))
    found = studies.origin(gate.PROGRAM, gate.Arguments(runs=(tmp_path,)))
    assert found["models"][str(tmp_path)] == {
        "preset": "noisy", "seed": 3, "commit": "0123", "versions": {}
    }  # fmt: skip


def test_unknown_models_end_a_program_in_one_line(capsys):
    with pytest.raises(SystemExit):
        studies.load("benchmarks.gate", Path("pretrained:none"))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("benchmarks.gate: preset = 'none'")


def answered(share):
    return {"pretrained:noisy": {"camera": dict.fromkeys(gate.SITUATIONS, share)}}


def test_the_gate_is_shown_with_and_without_a_search():
    found = {**ORIGIN, "answered": answered(0.25), "answered in a search": answered(0.5)}
    head, _, row, *_ = gate.table(found).splitlines()
    assert head == "| looks at | camera of `noisy` |"
    assert row == "| a PoI | 0.2500 |"
    assert "| a PoI | 0.2500, 0.5000 |" in gate.of_search(found)


def test_programs_are_shown_with_their_latencies():
    one = {"states": 1000, "different": 0, "error": 1e-7, "seconds": 0.00318}
    other = {**one, "different": 2, "error": 3e-6, "seconds": 2.81e-5}
    players = {"NumPy": {"decide": one}, "onnxruntime": {"decide": other, "merge": one}}
    found = {**ORIGIN, "programs": {"pretrained:noisy": players}}
    table = exported.table(found, ("decide",))
    assert "| `noisy` | `decide` | 2 of 1,000 | 3.0e-06 | 28 µs |" in table
    assert "merge" not in table
    latencies = exported.latencies(found, ["pretrained:noisy"], ["decide"])
    assert latencies.splitlines()[::2][:2] == ["| program | `noisy` |", "| `decide` | 28 µs |"]


def test_every_table_of_a_page_has_a_function():
    blocks = [x for page in PAGES for x in results._BLOCK.finditer(page.read_text("utf-8"))]
    for block in blocks:
        assert block["table"] in TABLES[block["file"]]
    shown = {(block["file"], block["table"]) for block in blocks}
    assert shown == {(file, name) for file, tables in TABLES.items() for name in tables}

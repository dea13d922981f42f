"""The tables of `benchmarks/RESULTS.md`."""

import json

import pytest

from benchmarks import ROWS, results

ROW = {
    "row": "rays", "unit": "rays/s", "ours": 1234567.8, "peer": "mujoco", "theirs": 45678.9,
    "ratio": 27.03, "compile_s": 1.0, "device": "cpu", "batch": 2048, "commit": "0123456789abcdef",
    "versions": {"python": "3.11.7", "jax": "0.10.2"}, "date": "2026-11-26", "cores": 2,
    "command": "python -m benchmarks rays --peers", "also": {},
}  # fmt: skip


def test_a_table_shows_what_was_measured_where_and_when():
    alone = {**ROW, "row": "missions", "theirs": None, "ratio": None, "ours": 12.345}
    lines = results.table([{**ROW, "also": {"tests/s": 7.0}}, alone]).splitlines()
    assert lines[2] == "| `rays` | 1,234,568 rays/s, 7 tests/s | mujoco | 45,679 | 27 x | 2,048 |"
    assert lines[3] == "| `missions` | 12.3 rays/s |  |  |  | 2,048 |"
    assert lines[-1] == (
        "`python -m benchmarks rays missions --peers`: cpu with 2 cores; commit 0123456789 on "
        "2026-11-26; python 3.11.7, jax 0.10.2."
    )


def test_pages_show_the_stored_results():
    text = ""
    for path in results.PAGES:
        page = path.read_text(encoding="utf-8")
        assert results.written(page) == page, "run python -m benchmarks.results"
        text += page
    for path in results.RESULTS.glob("*.json"):
        for name in results.TABLES[path.name]:
            assert f"<!-- {path.name}{f' {name}' if name else ''} -->" in text


@pytest.mark.parametrize("name", ["cpu", "h100", "h100x2"])
def test_every_row_is_shown(name):
    page = results.PAGES[-1].read_text(encoding="utf-8")
    rows = json.loads((results.RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    assert {row["row"] for row in rows} <= ROWS.keys()
    for row in rows:
        assert f"| `{row['row']}` |" in page


def test_other_text_of_the_page_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    (tmp_path / "cpu.json").write_text(json.dumps([ROW]))
    page = results.written("before\n<!-- cpu.json -->\nold\n<!-- end -->\nafter")
    assert page.startswith("before\n<!-- cpu.json -->\n\n| row |")
    assert page.endswith(".\n\n<!-- end -->\nafter")

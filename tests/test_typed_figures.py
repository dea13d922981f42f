"""Figures on pages come from JSON files; those that were typed by hand may only become fewer."""

import re
from pathlib import Path

import pytest
from test_page_settings import PRESET_OF

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "benchmarks/RESULTS.md",
    *sorted(f"docs/{x.name}" for x in (ROOT / "docs").glob("*.md")),
]
# Measured once, by commands that the page names, whose results no file holds. Lower a number when
# a table of its page is made from JSON; never raise one.
TYPED = {
    "benchmarks/RESULTS.md": 10,
    "docs/concepts.md": 25,
    "docs/differences.md": 51,
    "docs/extending.md": 8,
    "docs/figures.md": 10,
    "docs/getting-started.md": 9,
    "docs/imperfect.md": 3,
    "docs/interfaces.md": 1,
    "docs/recorded.md": 2,
    "docs/tasks.md": 3,
}
# Tables from JSON and from the code, code, addresses, equations, and versions: no results.
NOT_PROSE = [
    re.compile(r"<!-- [\w-]+\.json(?: [\w-]+)? -->.*?<!-- end -->", re.DOTALL),
    re.compile(r"<!-- What follows is made by .*", re.DOTALL),
    re.compile(r"```.*?```", re.DOTALL),
    re.compile(r"^    .*$", re.MULTILINE),
    re.compile(r"`[^`]*`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r"\$[^$]*\$", re.DOTALL),
    re.compile(r"(?:Python|JAX|mujoco|is at|Apache|CC BY)[ -]\d+\.\d+(?:(?:,| and| or) \d+\.\d+)*"),
    re.compile(r"95 %"),
]
SETTINGS = re.compile(r"^\| setting \| value \|.*\n(?:\|.*\n)*", re.MULTILINE)
"""Tables whose second column `test_page_settings` compares with a preset."""
SECOND = re.compile(r"^(\|[^|\n]*\|)[^|\n]*\|", re.MULTILINE)
FIGURE = re.compile(
    r"(?<![\w.])-?\d+(?:,\d{3})*(?:\.\d+)?\s?(?:%|(?:s|ms|GiB|MiB)\b)|(?<![\w.])-?\d+\.\d+(?![\w.]*\d)"
)


def figures(page: str, has_settings: bool = False) -> list[str]:
    if has_settings:
        page = SETTINGS.sub(lambda table: SECOND.sub(r"\1 |", table[0]), page)
    for pattern in NOT_PROSE:
        page = pattern.sub(" ", page)
    return FIGURE.findall(page)


@pytest.mark.parametrize("page", PAGES)
def test_figures_are_not_typed(page):
    found = figures((ROOT / page).read_text(encoding="utf-8"), Path(page).stem in PRESET_OF)
    assert len(found) == TYPED.get(page, 0), found


def test_what_counts_as_a_figure():
    assert figures("takes 3.5 s, 12 %, 1,024 of 0.98 GiB") == ["3.5 s", "12 %", "0.98 GiB"]
    assert figures("Python 3.11, 3.12 and 3.13; `--x 0.5`; $0.1$; a [link](0.4)") == []
    settings = "| setting | value | about |\n| --- | --- |\n| `a` | 0.5 | 2.5 |\n"
    assert figures(settings, has_settings=True) == ["2.5"]
    assert figures(settings) == ["0.5", "2.5"]
    assert figures("| row | value |\n| --- | --- |\n| `a` | 0.5 |\n", True) == ["0.5"]
    assert figures(
        "<!-- a.json b -->\n| 0.5 |\n<!-- end -->\n| 0.25 |\n```\n0.1\n```\n    0.2"
    ) == ["0.25"]

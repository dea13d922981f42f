"""Figures on pages come from JSON files, settings and constants from the code: none is typed."""

import re
from collections import Counter
from pathlib import Path

import pytest
from test_page_settings import CONSTANTS, INLINE, PRESET_OF

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "benchmarks/RESULTS.md",
    *sorted(f"docs/{x.name}" for x in (ROOT / "docs").glob("*.md")),
]
# Tables from JSON and from the code, code, addresses, equations, and versions: no results.
NOT_PROSE = [
    re.compile(r"<!-- [\w-]+\.json(?: [\w-]+)? -->.*?<!-- end -->", re.DOTALL),
    re.compile(r"<!-- What follows is made by .*", re.DOTALL),
    re.compile(r"```.*?```", re.DOTALL),
    INLINE,
    *CONSTANTS.values(),
    re.compile(r"^    .*$", re.MULTILINE),
    re.compile(r"`[^`]*`"),
    re.compile(r"\]\([^)]*\)"),
    re.compile(r"\$[^$]*\$", re.DOTALL),
    re.compile(
        r"(?:Python|JAX|mujoco|jaxmarl|Apache|CC BY)[ -]\d+\.\d+(?:\.\d+)?"
        r"(?:(?:,| and| or) \d+\.\d+)*"
    ),
    re.compile(r"95 %"),
    re.compile(r"[Ss]eeds? \d+(?:(?:,| to| and) \d+)*"),
    re.compile(r"(?<!\d)(?:19[5-9]|20[0-3])\d(?!,?\d)|#\d+|SHA-\d+"),  # years and names
    # What others have published, and what a byte, an exit status or a register can hold.
    re.compile(r"512 random environments|361 beams|2,000 handwritten digits|1,500\s+digits"),
    re.compile(r"6 to 240 features|the other 500|status 130|\b(?:188|255)\b|vectors of 512 bits"),
]
SETTINGS = re.compile(r"^\| setting \| value \|.*\n(?:\|.*\n)*", re.MULTILINE)
"""Tables whose second column `test_page_settings` compares with a preset."""
SECOND = re.compile(r"^(\|[^|\n]*\|)[^|\n]*\|", re.MULTILINE)
UNIT = (
    r"%|(?:s|ms|µs|kB|GiB|MiB|bytes|m|cm|mm|degrees?|seconds?|minutes?|hours?|nats|times)\b"
    r"|x(?= [a-z])"
)
FIGURE = re.compile(
    rf"(?<![\w.])-?(?:(?:\d+(?:,\d{{3}})*(?:\.\d+)?|\.\d+)\s?(?:{UNIT})|\d*\.\d+(?![\w.]*\d)"
    r"|\d{1,3}(?:,\d{3})+(?![\w,]*\d)|\d{3,}(?![\w,]*\d))"
)
"""Numbers with a unit or a fraction, and those of three digits or more."""
THEIRS = {"the paper and its code", "theirs"}
"""Columns of `docs/differences.md` with what the paper and its authors' code say."""
SAID = {"0.3", "1.0", "0.01", "0.95", "0.001", "0.99", "0.995", "128", "384"}
SAID |= {"200", "300", "512", "1024", "1,000,000"}
"""The numbers that they do say: Korthals et al. 2018; notebook `dqn4mmvae` of `tik0/vae_tools`."""


def without_theirs(page: str) -> str:
    """The page without the numbers of `SAID` in the columns of `THEIRS`."""
    lines, column = [], None
    for line in page.splitlines():
        cells = line.split("|")
        if not line.startswith("|"):
            column = None
        elif column is None:
            names = [cell.strip() for cell in cells]
            column = next((i for i, name in enumerate(names) if name in THEIRS), 0)
        elif column:
            cells[column] = re.sub(
                r"(?<![\w.])(?:\d+\.\d+|\d{1,3}(?:,\d{3})+|\d{3,})(?![\w.,]*\d)(?! ?%)",
                lambda number: "" if number[0] in SAID else number[0],
                cells[column],
            )
        lines.append("|".join(cells))
    return "\n".join(lines)


def figures(page: str, has_settings: bool = False, has_theirs: bool = False) -> list[str]:
    if has_settings:
        page = SETTINGS.sub(lambda table: SECOND.sub(r"\1 |", table[0]), page)
    if has_theirs:
        page = without_theirs(page)
    for pattern in NOT_PROSE:
        page = pattern.sub(" ", page)
    return FIGURE.findall(page)


@pytest.mark.parametrize("page", PAGES)
def test_figures_are_not_typed(page):
    text, name = (ROOT / page).read_text(encoding="utf-8"), Path(page).stem
    found = figures(text, name in PRESET_OF, name == "differences")
    assert not found


def test_what_counts_as_a_figure():
    assert figures("takes 3.5 s, 12 %, 1,024 of 0.98 GiB; 512, 99, in 2018, seeds 100 to 109") == [
        "3.5 s", "12 %", "1,024", "0.98 GiB", "512",
    ]  # fmt: skip
    assert figures("in 3 minutes, 2 hours, 5 cm; 4 times, 8 x slower, 1 degree, .5, 2 x 2") == [
        "3 minutes", "2 hours", "5 cm", "4 times", "8 x", "1 degree", ".5",
    ]  # fmt: skip
    assert figures("Python 3.11, 3.12 and 3.13; `--x 0.5`; $0.1$; a [link](0.4)") == []
    settings = "| setting | value | about |\n| --- | --- |\n| `a` | 0.5 | 2.5 |\n"
    assert figures(settings, has_settings=True) == ["2.5"]
    assert figures(settings) == ["0.5", "2.5"]
    assert figures("| row | value |\n| --- | --- |\n| `a` | 0.5 |\n", True) == ["0.5"]
    assert figures(
        "<!-- a.json b -->\n| 0.5 |\n<!-- end -->\n| 0.25 |\n```\n0.1\n```\n    0.2"
    ) == ["0.25"]


def test_numbers_of_the_paper_are_only_those_in_its_column():
    table = "| | theirs | here |\n| --- | --- | --- |\n| a | 0.95, 0.96 | 0.95 |\n\n| b | 0.95 |\n"
    assert figures(table, has_theirs=True) == ["0.96", "0.95", "0.95"]
    assert figures(table) == ["0.95", "0.96", "0.95", "0.95"]
    page = (ROOT / "docs" / "differences.md").read_text(encoding="utf-8")
    exempt = Counter(figures(page)) - Counter(figures(page, has_theirs=True))
    assert set(exempt) == SAID


def test_settings_and_constants_are_no_figures():
    assert figures("`mdp.look_cost` (0.05 nats; `noisy`: 0.1), `return` (0.9 of it)") == ["0.9"]
    assert figures("from 0.08 to\n5 m; from 0.08 to 6 m") == ["0.08", "6 m"]

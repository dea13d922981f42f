"""Prose avoids the words that CONTRIBUTING.md lists, in the package and on its pages."""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

import jaxsense

ROOT = Path(__file__).parent.parent
PACKAGE = Path(jaxsense.__file__).parent  # which may be installed elsewhere
SOURCES = sorted(PACKAGE.rglob("*.py"))
SCRIPTS = sorted([*(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "examples").glob("*.py")])
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    ROOT / "benchmarks" / "RESULTS.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
TABLE = "| not | but |\n| --- | --- |\n"


def banned():
    """A pattern of each phrase in the table of CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = text.split(TABLE)[1].partition("\n\n")[0].splitlines()
    phrases = [row.strip("| ").split(" | ")[0] for row in rows]
    return {phrase: pattern(phrase) for phrase in phrases}


def pattern(phrase):
    """Finds a phrase in prose, not in a name such as `dqn_lidar`, `lidar.range` or `lidar-2`."""
    words = r"\s+".join(map(re.escape, phrase[1:].split(" ")))
    first = f"[{phrase[0]}{phrase[0].upper()}]"
    return re.compile(rf"(?<![\w./_`'\"-]){first}{words}(?![\w/_`'\"]|[.-]\w)")


def prose_of_source(text):
    """Docstrings, messages, help and comments, with their lines; a string of one word is a name."""
    for node in ast.walk(ast.parse(text)):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        found = [x.value if isinstance(x, ast.Constant) else "{}" for x in parts]
        if all(isinstance(x, str) for x in found) and " " in (whole := "".join(found)):
            yield node.lineno, without_code(whole)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], without_code(token.string)


def prose_of_page(text):
    """The paragraphs of a page, without its programs, the targets of its links and that table."""
    table = re.escape(TABLE) + r"(\|[^\n]*\n)*"
    text = re.sub(rf"```.*?```|(?m:^{table})", only_lines, text, flags=re.DOTALL)
    text = re.sub(r"^(    .*)$|\]\(.*?\)|<.*?>", "", text, flags=re.MULTILINE)
    yield 1, without_code(text)


def prose_of_template(text):
    """What a template of HTML says, without its styles, its programs and its expressions."""
    code = r"<(style|pre)>.*?</\1>|{[{%].*?[%}]}"
    yield from prose_of_page(re.sub(code, only_lines, text, flags=re.DOTALL))


def only_lines(found):
    """As many lines as a match, empty."""
    return "\n" * found[0].count("\n")


def without_code(text):
    return re.sub(r"`[^`]*`", lambda code: "`" + "\n" * code[0].count("\n") + "`", text)


def hits(prose):
    """Phrases that must not be there, each with its line."""
    return sorted(
        {
            (line + text[: found.start()].count("\n"), phrase)
            for line, text in prose
            for phrase, regex in banned().items()
            for found in regex.finditer(text)
        }
    )


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_the_package_avoids_what_contributing_lists(path):
    assert not hits(prose_of_source(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_avoid_what_contributing_lists(path):
    assert not hits(prose_of_page(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_scripts_avoid_what_contributing_lists(path):
    assert not hits(prose_of_source(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("name", ["report", "demo", "parts"])
def test_templates_avoid_what_contributing_lists(name):
    path = PACKAGE / "show" / f"{name}.html.jinja"
    assert not hits(prose_of_template(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", [*SOURCES, *SCRIPTS], ids=lambda path: path.stem)
def test_a_mission_is_not_called_a_team(path):
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"\b(team|played): (mission\.)?Mission\b", text)
    assert not re.search(r"\b(team|played) = (mission\.)?(make_mission|with_numbers)\(", text)


def test_prose_is_told_from_names():
    source = '''"""Robots are
unsure of `lidar`, likewise dqn_lidar and --lidar.range."""
# A lidar.
raise ValueError(f"{x}: is no setting")
name = "lidar", "LiDAR scans"
'''
    assert hits(prose_of_source(source)) == [
        (2, "likewise"), (2, "unsure"), (3, "lidar"), (4, "is no setting"),
    ]  # fmt: skip
    page = "Likewise `unsure`.\n```python\nlidar = 1\n```\nA lidar [x](lidar.md).\n\n    lidar x\n"
    assert hits(prose_of_page(page)) == [(1, "likewise"), (5, "lidar")]
    listed = f"Likewise.\n\n{TABLE}| likewise | also |\n\nUnsure.\n"
    assert hits(prose_of_page(listed)) == [(1, "likewise"), (7, "unsure")]
    template = "<style>\nlidar</style>\n<p>Likewise {{ lidar }}{% set unsure %}\nunsure</p>\n"
    assert hits(prose_of_template(template)) == [(3, "likewise"), (4, "unsure")]

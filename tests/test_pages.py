"""Pages read well on GitHub: their links lead somewhere, and nothing needs Sphinx to be seen."""

import os
import re
from pathlib import Path

import pytest

import jaxsense

ROOT = Path(__file__).parent.parent
PACKAGE = Path(jaxsense.__file__).parent  # which may be installed elsewhere
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
# GitHub shows their content as code: lists of pages.
HARMLESS = {"toctree", "eval-rst"}


def without_code(text):
    return re.sub(r"```.*?```|`[^`\n]*`", "code", text, flags=re.DOTALL)


def anchors(text):
    """The anchors that GitHub makes of headings, as myst_parser does."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def linked(path, name):
    """The file that a link of a page leads to."""
    file = Path(os.path.normpath(path.parent / name)) if name else path
    source = ROOT / "jaxsense"
    return PACKAGE / file.relative_to(source) if file.is_relative_to(source) else file


def dead_links(path, text):
    """Texts and targets of the links of a page that have no text or lead nowhere."""
    for words, target in re.findall(r"\[([^\[\]]*)\]\(([^()\s]*)\)", without_code(text)):
        if re.match(r"https?:", target):
            continue
        name, _, anchor = target.partition("#")
        file = linked(path, name)
        found = file.exists()
        if found and anchor:
            content = text if file == path else file.read_text(encoding="utf-8")
            found = anchor in anchors(content)
        if not (found and words):
            yield words, target


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_can_be_read_on_github(path):
    text = path.read_text(encoding="utf-8")
    assert not [*dead_links(path, text)]
    assert set(re.findall(r"^[`:]{3,}\{([\w-]+)\}", text, re.M)) <= HARMLESS

"""Tables of settings state the values of the presets."""

import re
from pathlib import Path

import pytest

from jaxsense import PRESETS

ROOT = Path(__file__).parents[1]
PRESET_OF = {"getting-started": "noisy", "differences": "paper", "imperfect": "default"}
HEAD = "| setting | value |"
AFTER = {"`jmvae.steps`, `batch`, `learning_rate`": [0.0]}  # what the rate falls to
WORDS = {"yes": True, "on": True, "no": False, "off": False}


def rows(page):
    """First two cells of the rows of a page's tables of settings."""
    found, is_inside = [], False
    for line in (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").splitlines():
        is_inside = line.startswith((HEAD, "| ---") if is_inside else HEAD) or (
            is_inside and line.startswith("|")
        )
        if is_inside and line.startswith("| `"):
            found.append([cell.strip() for cell in line.split("|")[1:3]])
    return found


def settings(preset, names):
    """The values of settings in one cell, of which later ones may leave out the section."""
    section, values = (), []
    for name in re.findall(r"`([^`]*)`", names):
        *own, field = name.split(".")
        section = own or section
        found = PRESETS[preset]
        for part in (*section, field):
            found = getattr(found, part)
        if isinstance(found, tuple) and isinstance(found[0], str):
            found = len(found)  # pages count classes
        values += found if isinstance(found, tuple) else [found]
    return values


def stated(cell):
    """Numbers, quoted words, and yes or no."""
    found = re.findall(r"`[^`]*`|-?\d[\d,]*\.?\d*|\b(?:yes|no|on|off)\b", cell)
    return [
        x.strip("`") if x.startswith("`") else WORDS[x] if x in WORDS else float(x.replace(",", ""))
        for x in (word.rstrip(",") for word in found)
    ]


TABLES = [
    (preset, names, cell)
    for page, preset in PRESET_OF.items()
    for names, cell in rows(page)
    if cell and "*" not in names
]


@pytest.mark.parametrize(("preset", "names", "cell"), TABLES)
def test_settings_on_pages_are_those_of_the_preset(preset, names, cell):
    values = settings(preset, names)
    assert stated(cell) == [*values, *AFTER.get(names, [])]


def test_tables_of_settings_are_found():
    assert len(TABLES) > 30
    assert ("noisy", "`lidar.range_noise`", "0.02 m") in TABLES
    assert stated("1,024,000 or 0.5, yes, `bank`") == [1024000.0, 0.5, True, "bank"]

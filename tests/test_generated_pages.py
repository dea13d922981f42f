"""The pages of settings and of public names are those that the code makes."""

import importlib.util
from pathlib import Path

import pytest

import jaxsense
from jaxsense.config import PRESETS, Config
from jaxsense.config.section import Section

DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture(scope="module")
def generate():
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["settings.md", "api.md"])
def test_generated_pages_are_up_to_date(generate, name):
    text = (DOCS / name).read_text(encoding="utf-8")
    assert text.count(generate.MARK) == 1
    assert text == generate.page(name), "out of date: python docs/generate.py"


def test_every_setting_has_a_row(generate):
    def names(prefix, section):
        for name, value in vars(section).items():
            full = f"{prefix}.{name}".lstrip(".")
            yield from names(full, value) if isinstance(value, Section) else [full]

    rows = [line.split("`")[1] for line in generate.settings().splitlines() if line[:3] == "| `"]
    every = [*names("", Config())]
    assert set(every) <= set(rows)
    assert len(every) > 100
    assert "mission.localisation.search.position" in rows


def test_rows_of_settings(generate):
    text = generate.settings()
    for row in (
        "| `arena.side` | 3 | a number greater than 0 and at most 100 | Inner length",
        "| `arena.num_pois` | 3 | a whole number from 1 to 64 | Number of",
        "| `lidar.range_noise` † | 0.01 | a number, at least 0 | Standard",
        "| `robots` | none | 1 to 64 names; or none | Sensors",
        "| `jmvae.hidden` | 64, 64 | 1 or more whole numbers from 1 to 65,536 | Sizes",
        "| `team.num_pois` | 3, 8 | 2 whole numbers from 1 to 64 | Minimum",
        "| `jmvae.fusion` | `in_place` | `in_place` or `filter` | How",
        "| `mission.redecides` † | on | on or off | Whether",
        "| `detector.num_scans` | 98,304 | a whole number, at least 1 | Simulated",
        "| `sensors` | none | for each name, `SensorConfig` | Custom",
    ):
        assert f"\n{row}" in text
    assert "red: 0.8, 0.1, 0.1; green: " in text
    assert "cylinder: cylinder 1, 1; cube: box 1, 1" in text
    # A bar would end the cell.
    assert "the gain of 1 / \\|\\|sigma\\|\\|, or -1" in text


def test_changes_of_presets_are_listed(generate):
    changes = generate.settings().split("## Presets")[1]
    of_each = {part.split("`")[1]: part for part in changes.split("### Preset ")[1:]}
    assert set(of_each) == {*PRESETS} - {"default"}
    assert "| `lidar.mixed_pixels` | 0.21 |" in of_each["recorded"]
    assert of_each["recorded"].count("\n| `") == 4
    assert "| `mission.auctions` | off |" in of_each["paper"]


def test_public_names_are_those_that_packages_export(generate):
    for package in generate.PACKAGES:
        module = importlib.import_module(f"jaxsense.{package}".rstrip("."))
        names = [each.name for each in generate.exports(module.__name__)]
        assert len(set(names)) == len(names)
        if not package:
            assert sorted(names) == sorted(jaxsense.__all__)
        for each in generate.exports(module.__name__):
            assert each.about, each.name
            value, home = getattr(module, each.name), importlib.import_module(each.module)
            assert value is (home if each.defined is None else getattr(home, each.defined))


def test_a_name_that_nobody_defines_is_an_error(generate):
    with pytest.raises(FileNotFoundError):
        generate._public("x", "jaxsense.config.checks", "x")


def test_the_first_sentence_of_a_docstring(generate):
    assert generate._paragraph("One and\n  a half. Two.\n\nThree.") == "One and a half."
    assert generate._paragraph("See `a.b` of 1.5 m") == "See `a.b` of 1.5 m"
    assert generate._paragraph(None) == ""

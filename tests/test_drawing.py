"""Figures as files that follow the colours of a page, and names beside axes."""

import itertools
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from jaxsense.show import drawing
from jaxsense.show.colours import ON_DARK

STYLE = "{http://www.w3.org/2000/svg}style"


def figure():
    made = Figure(figsize=(4, 3), layout="constrained")
    ax = made.subplots()
    ax.plot([0, 1], [0, 1], color="#1558b0")
    ax.text(0.123456789, 0.5, "some words", color="#59616e")
    ax.grid()
    return made


def test_every_colour_of_a_file_has_a_counterpart_on_a_dark_page():
    text = drawing.svg(figure()).decode()
    root = ElementTree.fromstring(text)
    (rules,) = (e.text for e in root.iter(STYLE) if "prefers-color-scheme:dark" in (e.text or ""))
    used = set(re.findall(r'style="[^"]*\b((?:fill|stroke): #[0-9a-f]{6})', text))
    assert {"stroke: #1558b0", "fill: #59616e", "fill: #ffffff", "stroke: #000000"} <= used
    for each in used:
        part, colour = each.split(": ")
        assert f'[style*="{each}"]{{{part}:{drawing.on_dark(colour)}!important}}' in rules
    # Matplotlib does not write the fill of what is black.
    assert f"svg{{fill:{drawing.on_dark('black')}}}" in rules


def test_words_stay_words_in_the_font_of_the_page_and_files_repeat():
    text = drawing.svg(figure()).decode()
    assert ">some words</text>" in text
    assert "<style>text{font-family:system-ui," in text
    assert "DejaVu" not in text
    assert text == drawing.svg(figure()).decode()
    paths = re.findall(r' d="([^"]*)"', text)
    assert len(paths) > 5
    assert not any(re.search(r"\.\d{3}", path) for path in paths)


def contrast(one, other):
    lighter, darker = sorted(
        (drawing._luminance(to_rgb(colour)) for colour in (one, other)), reverse=True
    )
    return (lighter + 0.05) / (darker + 0.05)


@pytest.mark.parametrize("colour", [*ON_DARK, "#660d0d", "C0", "black", "0.35"])
def test_what_is_dark_on_white_stands_out_on_a_dark_page(colour):
    assert contrast(drawing.on_dark(colour), drawing.on_dark("white")) >= 4


def test_black_and_white_contrast_by_the_formula_of_wcag():
    assert contrast("black", "white") == pytest.approx(21)
    assert contrast("#777777", "white") == pytest.approx(4.48, abs=0.01)
    # A colour that stands out already stays as it is.
    assert drawing.on_dark("#ffd700") == "#ffd700"


@pytest.mark.parametrize(
    ("heights", "expected"),
    [
        ([], []),
        ([0.2, 0.9], [0.2, 0.9]),
        ([0.5, 0.5], [0.4, 0.6]),
        ([0.5, 0.5, 0.55], [0.31667, 0.51667, 0.71667]),
        ([0.0, 0.0, 0.9], [0.0, 0.2, 0.9]),
        ([0.95, 1.0], [0.8, 1.0]),
    ],
)
def test_names_move_apart_as_little_as_they_must(heights, expected):
    # The mean of those that touch stays: (.5 + .5 + .55) / 3 = .51667.
    np.testing.assert_allclose(drawing.spread(np.array(heights), 0.2), expected, atol=1e-5)


def test_names_beside_an_axis_do_not_cover_each_other():
    made = Figure(figsize=(4, 3), layout="constrained")
    ax = made.subplots()
    ax.set_ylim(0, 1)
    names = [("low", 0.11, "C0"), ("lower", 0.1, "C1"), ("below", -3.0, "C2"), ("high", 0.9, "C3")]
    drawing.name_ends(ax, names)
    made.draw_without_rendering()
    assert [text.get_text() for text in ax.texts] == ["below", "lower", "low", "high"]
    boxes = [text.get_window_extent() for text in ax.texts]
    assert all(one.y1 < other.y0 for one, other in itertools.pairwise(boxes))
    assert all(box.x0 > ax.get_window_extent().x1 for box in boxes)

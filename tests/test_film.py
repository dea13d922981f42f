"""The animated SVG, read as a viewer reads it."""

import dataclasses
import re
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from recordings import CONFIG, FUSION, recording

from jaxsense.show import film
from jaxsense.show.svg import Timeline

SVG = "{http://www.w3.org/2000/svg}"


def draw(config=CONFIG):
    (drawn,) = film.draw(config, {"latent policy": recording()}, FUSION)
    return drawn


KEYFRAMES = {}
"""What follows `@keyframes NAME` in the films that were read; names tell contents."""


def parse(content):
    root = ElementTree.fromstring(content)
    for sheet in root.iter(f"{SVG}style"):
        KEYFRAMES.update(re.findall(r"@keyframes (\w+)\{(.*)\}\n", sheet.text))
    return root


@pytest.fixture(scope="module")
def picture():
    return parse(draw())


class Track(NamedTuple):
    """How an attribute changes: values at shares of the duration."""

    attribute: str
    jumps: bool
    times: np.ndarray
    values: np.ndarray

    def at(self, share):
        """The numbers at a share of the duration."""
        if self.jumps:
            return self.values[np.searchsorted(self.times, share, side="right") - 1]
        return np.array([np.interp(share, self.times, column) for column in self.values.T])


def tracks(element):
    """All animations of an element and what is in it."""
    found = []
    for each in element.iter():
        plays = each.get("style", "").removeprefix("animation:").split(",")
        for name, way, _ in (play.split() for play in plays if "var(--film)" in play):
            frames = re.findall(r"([\d.]+)%\{([^{}]*)\}", KEYFRAMES[name])
            (attribute,) = {re.split(r"\(|:(?!\w+\()", what)[0] for _, what in frames}
            values = [re.findall(r"[-\d.e]*\d", what.split(":")[1]) for _, what in frames]
            times = np.array([float(share) for share, _ in frames]) / 100
            track = Track(attribute, way == "step-end", times, np.array(values, float))
            found.append(track._replace(attribute=attribute.removeprefix("transform:")))
    return found


def beliefs(picture):
    """The ellipses of the PoIs."""
    return [*picture.iter(f"{SVG}ellipse")]


def frames(element, attribute, number=60):
    """`[number]` values of an attribute in the frames of a film of 6 s."""
    found = [track for track in tracks(element) if track.attribute == attribute]
    if not found:
        return np.full(number, float(element.get(attribute)))
    return np.array([found[0].at((i + 0.5) * 0.05 / 6.0)[0] for i in range(number)])


def duration(picture):
    """Seconds of a film, and how often it plays."""
    seconds, times = re.fullmatch(r"--film:([\d.]+)s (\d+)", picture.get("style")).groups()
    return float(seconds), int(times)


def test_every_animation_can_be_played_and_ends_as_its_element_is(picture):
    assert len(tracks(picture)) > 15
    # 6 s and one more at twice the speed, and 2.5 s of the last frame. Where nothing can pause it,
    # as in an `img`, it at least comes to an end.
    assert duration(picture) == (pytest.approx(6.0, abs=0.2), 3)
    for element in picture.iter():
        own = ElementTree.Element(element.tag, element.attrib)
        for track in tracks(own):
            assert track.times[0] == 0
            assert np.all(np.diff(track.times) > 0)
            assert track.times[-1] < 1 if track.jumps else track.times[-1] == 1
            # Who switches animations off sees the attributes: those of the last frame.
            is_transform = track.attribute in ("translate", "rotate")
            left = own.get("transform" if is_transform else track.attribute)
            last = [float(x) for x in re.findall(r"[-\d.]+", left)]
            np.testing.assert_array_equal(last, track.values[-1])


def test_what_moves_in_straight_lines_is_told_by_their_ends():
    moments = np.arange(101) / 125
    sheet, element = ElementTree.Element("style"), ElementTree.Element("g")
    timeline = Timeline(moments, sheet)
    bent = np.abs(np.arange(101) - 40.0)
    timeline.animate(element, "translate", np.stack([bent, 0 * bent], axis=1))
    assert sheet.text.count("%{") == 4  # both ends, the corner, and the pause after the last frame
    assert "32%{transform:translate(0px,0px)}" in sheet.text
    # No frame is further from a line than a tenth of a pixel.
    wave = 30 * np.sin(bent / 20)
    timeline.animate(element, "cx", wave)
    KEYFRAMES.update(re.findall(r"@keyframes (\w+)\{(.*)\}\n", sheet.text))
    shown = [tracks(element)[1].at(moment)[0] for moment in moments]
    np.testing.assert_allclose(shown, wave, atol=0.13)  # with rounded times
    assert 10 < len(tracks(element)[1].times) < 60


def test_robots_and_beliefs_are_where_they_were(picture):
    # 340 px for 3 m: from the middle to 1 m right of it.
    (start, end) = ([170.0, 170.0], [170 + 340 / 3, 170.0])
    moves = [t for t in tracks(picture) if t.attribute == "translate"]
    robot = next(t for t in moves if np.allclose(t.at(0.0), start, atol=0.01))
    np.testing.assert_allclose(robot.at(1.0), end, atol=0.01)
    # 20 of 40 periods, one more frame before the first, at twice the speed.
    half = 0.1 * 21 / 2.0 / 6.0
    np.testing.assert_allclose(robot.at(half)[0], 170 + 340 / 6, atol=4)
    # It turned by 0.08 rad the short way, not once around.
    turns = [np.ptp(t.values) for t in tracks(picture) if t.attribute == "rotate"]
    np.testing.assert_allclose(turns, np.degrees(0.083), atol=0.1)
    ellipses = beliefs(picture)
    assert len(ellipses) == 3
    radius = {t.attribute: t for t in tracks(ellipses[1])}["rx"]
    assert radius.at(0.0) > 150
    # Class means reach to 1, ellipses 0.4 and a rim of 1 further: 2.4 for 170 px.
    assert radius.at(1.0) == pytest.approx(0.4 * 170 / 2.4, abs=0.01)
    assert not [t for t in tracks(ellipses[0]) if t.attribute == "rx"]


def bars(picture):
    """The groups of bars, and their places in the view."""
    upwards = re.compile(r"translate\((\S+) (\S+)\) scale\(1 -1\)").match
    found = [(g, upwards(g.get("transform", ""))) for g in picture.iter(f"{SVG}g")]
    return [(group, [float(x) for x in place.groups()]) for group, place in found if place]


def test_bars_beside_each_poi_fill_with_the_probabilities_of_its_classes(picture):
    groups = [group for group, _ in bars(picture)]
    assert len(groups) == 3
    for n, group in enumerate(groups):
        back, *of_classes = group.iter(f"{SVG}rect")
        full = float(back.get("height")) - 2
        heights = np.array([frames(bar, "height") for bar in of_classes])
        assert len(of_classes) == 3
        # All classes are equally likely before any look, and at those that nobody looks at.
        np.testing.assert_allclose(heights[:, :40], full / 3, atol=0.02)
        # PoI 2 is seen in period 40, frame 41, and the bars fill in eight frames.
        end = np.array([0, full, 0]) if n == 1 else np.full(3, full / 3)
        np.testing.assert_allclose(heights[:, 50], end, atol=0.02)


def test_a_belief_appears_with_the_first_look(picture):
    # PoI 2 is seen in frame 41.
    is_seen = np.zeros((3, 60))
    is_seen[1, 41:] = 1
    np.testing.assert_array_equal([frames(e, "opacity") for e in beliefs(picture)], is_seen)


def test_a_field_of_view_is_that_of_the_sensor():
    camera = dataclasses.replace(CONFIG.camera, field_of_view=90.0)
    lidar = dataclasses.replace(CONFIG.lidar, field_of_view=270.0)
    picture = parse(draw(dataclasses.replace(CONFIG, camera=camera, lidar=lidar)))
    fields = [p for p in picture.iter(f"{SVG}path") if "A" in p.get("d")]
    for field, is_wide, side in zip(fields, "01", (1, -1), strict=True):
        x, y = map(float, field.get("d").removeprefix("M0,0L").split("A")[0].split(","))
        assert x == pytest.approx(-side * y, abs=0.2)  # the middles of pixels
        assert field.get("d").split()[1:3] == ["0", is_wide]

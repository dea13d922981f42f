"""The animated SVG, read as a viewer reads it."""

import dataclasses
import itertools
import re
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple
from xml.etree import ElementTree

import jax
import numpy as np
import pytest
from recordings import CONFIG, FIELDS_OF_VIEW, FUSION, recording

from jaxsense.core.types import Belief
from jaxsense.show import animation
from jaxsense.show.animation.svg import Timeline
from jaxsense.show.colours import modality_colour

SVG = "{http://www.w3.org/2000/svg}"


def draw(config=CONFIG, played=None, fusion=FUSION, fields_of_view=FIELDS_OF_VIEW, lasts=0.0):
    played = played or recording()
    return animation.draw(
        config, played.records, played.end, fusion, fields_of_view, "latent policy", lasts
    )


KEYFRAMES = {}
"""What follows `@keyframes NAME` in the films that were read; names tell contents."""


def parse(film):
    root = ElementTree.fromstring(film)
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
    return [e for e in picture.iter(f"{SVG}ellipse") if e.get("fill") != "none"]


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


def test_every_animation_can_be_played(picture):
    found = tracks(picture)
    assert len(found) > 15
    # 6 s and one more at twice the speed, and 2.5 s of the last frame. Where nothing can pause it,
    # as in an `img`, it at least comes to an end.
    assert duration(picture) == (pytest.approx(6.0, abs=0.2), 3)
    for track in found:
        assert len(track.times) == len(track.values) > 1
        assert track.times[0] == 0
        assert np.all(np.diff(track.times) > 0)
        assert track.times[-1] < 1 if track.jumps else track.times[-1] == 1


def test_each_animation_ends_as_its_element_is():
    # Who switches animations off sees the attributes, which must be those of the last frame.
    for element in parse(draw()).iter():
        own = ElementTree.Element(element.tag, element.attrib)
        for track in tracks(own):
            is_transform = track.attribute in ("translate", "rotate")
            left = own.get("transform" if is_transform else track.attribute)
            np.testing.assert_array_equal(
                [float(x) for x in re.findall(r"[-\d.]+", left)], track.values[-1]
            )


@pytest.mark.parametrize("jumps", [False, True])
def test_an_element_holds_what_the_last_frame_shows(jumps):
    timeline = Timeline(np.array([0.0, 0.25, 0.5]), ElementTree.Element("style"))
    element = ElementTree.Element("g")
    timeline.animate(element, "cx", [1.0, 4.0, 6.0], jumps=jumps)
    timeline.animate(element, "rotate", [10.0, 40.0, 60.0], jumps=jumps)
    assert (element.get("cx"), element.get("transform")) == ("6", "rotate(60)")


def test_pois_are_drawn_in_their_size(picture):
    # Radius 0.1 m at 340 px for 3 m is 11.33 px; the half sides of both shapes are whole radii.
    circles = [
        e
        for e in picture.iter(f"{SVG}circle")
        if e.get("fill") in ("#1ab21a", "#cc1a1a") and not e.get("cx")
    ]
    boxes = [e for e in picture.iter(f"{SVG}rect") if "rotate" in e.get("transform", "")]
    assert [e.get("r") for e in circles] == ["11.33", "11.33"]
    assert [(e.get("x"), e.get("width")) for e in boxes] == [("-11.33", "22.67")]


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
    assert np.ptp(wave) > 29
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


def test_bars_beside_each_poi_fill_with_the_probabilities_of_its_classes(picture):
    groups = [g for g in picture.iter(f"{SVG}g") if "scale(1 -1)" in g.get("transform", "")]
    assert len(groups) == 3
    for n, group in enumerate(groups):
        back, *bars = group.iter(f"{SVG}rect")
        full = float(back.get("height")) - 2
        heights = np.array([frames(bar, "height") for bar in bars])
        assert len(bars) == 3
        # All classes are equally likely before any look, and at those that nobody looks at.
        np.testing.assert_allclose(heights[:, :40], full / 3, atol=0.02)
        # PoI 2 is seen in period 40, frame 41, and the bars fill in eight frames.
        end = np.array([0, full, 0]) if n == 1 else np.full(3, full / 3)
        np.testing.assert_allclose(heights[:, 50], end, atol=0.02)


def test_bars_of_crowded_pois_stand_apart_and_in_the_view():
    # Three in the upper right corner, whose bars have no room to the right.
    played = recording()
    played.end.scene.layout.position[:] = [[1.35, 1.35], [0.85, 1.35], [1.35, 0.95]]
    moving = parse(draw(played=played))
    upwards = r"translate\((\S+) (\S+)\) scale\(1 -1\)"
    places = [re.match(upwards, g.get("transform", "")) for g in moving.iter(f"{SVG}g")]
    corners = np.array([[float(x) for x in place.groups()] for place in places if place])
    size = np.array([18, 24])  # px: three bars of 6 px
    low = corners - np.array([0, 24])
    high = low + size
    assert (low > 0).all()
    assert (high < 340).all()
    pois = 170 + 340 / 3 * played.end.scene.layout.position * (1, -1)
    radius = 340 / 3 * CONFIG.arena.poi_radius
    for i, j in itertools.product(range(3), repeat=2):
        apart = np.maximum(low[i] - (pois[j] + radius), (pois[j] - radius) - high[i])
        assert apart.max() > 0
        if i != j:
            assert (np.abs(low[i] - low[j]) >= size).any()


def test_what_nobody_has_seen_is_called_unknown(picture):
    texts = [t for t in picture.iter(f"{SVG}text") if t.text == "unknown"]
    seen = np.array([frames(text, "opacity") for text in texts])
    np.testing.assert_array_equal(seen[[0, 2]], 1)
    np.testing.assert_array_equal(np.flatnonzero(seen[1] == 0), np.arange(41, 60))
    # One ring in the map stands for all of them.
    (ring,) = (e for e in picture.iter(f"{SVG}ellipse") if e.get("fill") == "none")
    np.testing.assert_array_equal(frames(ring, "opacity"), 1)
    shown = np.array([frames(ellipse, "opacity") for ellipse in beliefs(picture)])
    np.testing.assert_array_equal(shown, 1 - seen)
    lists = {t.text: t for t in picture.iter(f"{SVG}text") if (t.text or "").startswith("unknown:")}
    assert set(lists) == {"unknown: 1, 2, 3", "unknown: 1, 3"}
    np.testing.assert_array_equal(frames(lists["unknown: 1, 3"], "opacity"), 1 - seen[1])


def test_pois_that_are_certain_are_listed_at_their_class():
    # PoI 2 is told by one look in period 40, PoI 1 half, which leaves two classes.
    played = recording()
    played.records.seen[50:, 0, 1] = True
    played.records.belief.mean[50:, 0] = [1.0, 0.0]
    played.records.belief.std[50:, 0] = [0.4, 1.0]
    moving = parse(draw(played=played))
    found = [t for t in moving.iter(f"{SVG}text") if "film-label" in t.get("class")]
    labels = {t.text: t for t in found}
    assert set(labels) == {"green cylinder", "red cylinder", "2", "red cube"}
    # Each also below the beliefs, where it covers the ring of what nobody has seen, and no belief.
    parents = {child: parent for parent in moving.iter() for child in parent}
    siblings = list(parents[labels["red cube"]])
    (ring,) = (e for e in moving.iter(f"{SVG}ellipse") if e.get("fill") == "none")
    first, last = (siblings.index(each) for each in (beliefs(moving)[0], beliefs(moving)[-1]))
    for text, above in labels.items():
        (below,) = (t for t in found if t.text == text and t is not above)
        assert "film-on-floor" in below.get("class")
        assert siblings.index(ring) < siblings.index(below) < first
        assert last < siblings.index(above)
        assert below.get("y") == above.get("y")
    is_told = frames(labels["2"], "opacity")
    np.testing.assert_array_equal(np.flatnonzero(is_told), np.arange(41, 60))
    # The name of the class stands between its place and the numbers.
    heights = [float(labels[text].get("y")) for text in ("red cylinder", "2")]
    assert np.diff(heights) * np.sign(heights[0] - 170) > 10
    # Only what is seen and still open has a number in the map.
    numbers = [t for t in moving.iter(f"{SVG}text") if t.text == "1"]
    (in_map,) = (t for t in numbers if t.get("class") == "film-number film-on-light")
    np.testing.assert_array_equal(np.flatnonzero(frames(in_map, "opacity")), np.arange(51, 60))
    for never in ("2", "3"):
        texts = [t for t in moving.iter(f"{SVG}text") if t.text == never]
        (in_map,) = (t for t in texts if t.get("class") == "film-number film-on-light")
        assert not frames(in_map, "opacity").any()


@pytest.fixture
def crowd():
    """Twelve PoIs in a wide arena, all like the second one, which is seen in period 40."""
    arena = dataclasses.replace(CONFIG.arena, num_pois=12, side=6.0)
    played = recording()
    records, layout = played.records, played.end.scene.layout
    belief = jax.tree.map(lambda x: np.repeat(x[:, 1:2], 12, axis=1), records.belief)
    seen = np.repeat(records.seen[:, 1:2], 12, axis=1)
    layout.position = np.stack([np.tile([-2.0, -0.7, 0.7, 2.0], 3), np.repeat([-2, 0, 2], 4)], -1)
    layout.yaw, layout.shape = np.zeros(12), np.zeros(12, int)
    end = SimpleNamespace(**{**vars(played.end), "classes": np.ones(12, int)})
    records = dataclasses.replace(records, belief=belief, seen=seen)
    config = dataclasses.replace(CONFIG, arena=arena)
    return parse(draw(config, type(played)(end, records)))


def test_many_numbers_at_a_class_stand_in_lines(crowd):
    labels = [t for t in crowd.iter(f"{SVG}text") if t.get("class") == "film-label film-on-light"]
    shown = {t.text: float(t.get("y")) for t in labels if t.get("opacity") != "0"}
    lines = ["1, 2, 3, 4, 5", "6, 7, 8, 9, 10", "11, 12"]
    assert set(shown) == {*CONFIG.arena.classes, *lines}
    steps = np.diff([shown[text] for text in ("red cylinder", *lines)])
    assert np.all(np.abs(steps) >= 14)
    assert len(set(np.sign(steps))) == 1
    assert all(10 < y < 340 for y in shown.values())


def test_bars_cover_no_number_of_a_small_poi(crowd):
    arena = crowd
    upwards = r"translate\((\S+) (\S+)\) scale\(1 -1\)"
    bars = [re.match(upwards, g.get("transform", "")) for g in arena.iter(f"{SVG}g")]
    left, bottom = np.array([[float(x) for x in bar.groups()] for bar in bars if bar]).T
    groups = [
        g for g in arena.iter(f"{SVG}g") if any(t.text == "12" for t in g.findall(f"{SVG}text"))
    ]
    x, y = map(float, re.findall(r"[\d.]+", groups[0].get("transform")))
    (number,) = groups[0].findall(f"{SVG}text")
    middle = x + float(number.get("x"))
    is_level = (bottom > y - 6) & (bottom - 24 < y + 6)  # with the digits, 12 px high
    apart = np.maximum(
        left - (middle + 9), (middle - 9) - (left + 18)
    )  # 9 px for each of two digits
    assert apart[is_level].min() >= 0


def test_the_legend_names_every_sign_of_the_map(picture):
    notes = [t for t in picture.iter(f"{SVG}text") if t.get("class") == "film-note"]
    assert sum((t.text or "").startswith("Dotted circle:") for t in notes) == 1
    height = float(picture.get("viewBox").split()[3])
    assert max(float(t.get("y")) for t in notes) < height - 8


def test_the_legend_fits_below_a_single_robot():
    config = dataclasses.replace(CONFIG, robots=("camera",))
    picture = parse(draw(config))
    notes = [t for t in picture.iter(f"{SVG}text") if t.get("class") == "film-note"]
    height = float(picture.get("viewBox").split()[3])
    assert max(float(t.get("y")) for t in notes) < height - 8


def test_films_that_last_equally_long_stay_together():
    long = parse(draw(played=recording(80)))
    short = parse(draw(lasts=8.0))
    assert duration(long) == duration(short) == (7.0, 3)
    # The clock of the shorter one still stops at its own end.
    texts = {t.text for t in short.iter(f"{SVG}text")}
    assert "6.0 s" in texts
    assert "7 s" not in texts


def test_headings_tell_what_a_robot_does_and_the_time(picture):
    texts = {t.text: t for t in picture.iter(f"{SVG}text")}
    for doing in ("choosing", "driving to 2", "looking at 2", "done"):
        assert f"camera: {doing}" in texts
    assert {"0 s", "1 s", "5 s", "6.0 s", "lidar: done"} <= set(texts)
    (track,) = tracks(texts["camera: looking at 2"])
    # Periods 30 to 39, in frames 31 to 40, of 0.05 s each in 6 s.
    shown = [track.at((frame + 0.5) * 0.05 / 6.0)[0] for frame in range(60)]
    np.testing.assert_array_equal(np.flatnonzero(shown), np.arange(31, 41))
    for frame in range(0, 70, 7):
        now = [text for text in texts if text.startswith("camera")]
        now = [t for t in now if tracks(texts[t])[0].at((frame + 0.5) * 0.05 / 6.0)[0]]
        assert len(now) == 1


def test_without_motion_the_end_is_shown(picture):
    texts = [t.text for t in picture.iter(f"{SVG}text") if t.get("opacity", "1") == "1"]
    assert {"camera: done", "6.0 s"} <= set(texts)
    assert "camera: driving to 2" not in texts
    style = picture.find(f"{SVG}style").text
    assert "@media (prefers-reduced-motion:reduce){.film *{animation:none!important}}" in style


def test_the_longest_mission_is_still_small():
    assert len(draw(played=recording(1200))) < 300_000


def test_six_robots_are_drawn_and_named():
    robots = ("camera", "lidar", "camera", "camera", "lidar", "camera")
    config = dataclasses.replace(CONFIG, robots=robots)
    two = recording()
    # Three times the two robots of the recording, in places of their own.
    of_robots = ("poses", "command", "wanted", "phase", "target", "scanned", "detected")
    tripled = {n: np.concatenate([getattr(two.records, n)] * 3, axis=1) for n in of_robots}
    record = dataclasses.replace(two.records, **tripled)
    record.poses[:, :, 1] += np.linspace(-0.5, 0.5, 6)
    faults = SimpleNamespace(blind_at=np.full(6, np.inf))
    end = SimpleNamespace(**{**vars(two.end), "faults": faults})
    picture = parse(draw(config, type(two)(end, record)))
    assert "robots with camera and lidar look at 3 points" in picture.find(f"{SVG}title").text
    names = ("camera 1", "lidar 1", "camera 2", "camera 3", "lidar 2", "camera 4")
    # One trail for each robot.
    trails = list(picture.iter(f"{SVG}polyline"))
    assert len(trails) == 6
    assert len({trail.get("points") for trail in trails}) == 6
    colours = [modality_colour(robot == "lidar") for robot in robots]
    assert [trail.get("stroke") for trail in trails] == colours
    # A line of text with a mark for each, below one another and within the picture.
    lines = [t for t in picture.iter(f"{SVG}text") if t.text and t.text.endswith(": done")]
    assert [line.text for line in lines] == [f"{name}: done" for name in names]
    heights = [float(line.get("y")) for line in lines]
    assert np.all(np.diff(heights) > 20)
    assert heights[-1] < float(picture.get("viewBox").split()[3])
    fields = [p for p in picture.iter(f"{SVG}path") if "A" in p.get("d")]
    assert len(fields) == 2 * 6  # in the arena and beside the names


def test_a_film_of_one_kind_of_robots_names_no_other():
    config = dataclasses.replace(CONFIG, robots=("camera", "camera"))
    picture = parse(draw(config))
    assert "robots with camera look at" in picture.find(f"{SVG}title").text


def test_a_field_of_view_is_that_of_the_sensor():
    # As with a sensor of one's own, the settings do not tell.
    picture = parse(draw(fields_of_view={"camera": 90.0, "lidar": 270.0}))
    fields = [p for p in picture.iter(f"{SVG}path") if "A" in p.get("d")]
    # In the arena and beside the names.
    for field, is_wide, side in zip(fields, "0101", (1, -1) * 2, strict=True):
        x, y = map(float, field.get("d").removeprefix("M0,0L").split("A")[0].split(","))
        assert x == pytest.approx(-side * y, abs=0.1)
        assert field.get("d").split()[1:3] == ["0", is_wide]


def test_the_map_begins_with_the_prior_of_the_fusion():
    prior = Belief(np.array([1.0, -0.5]), np.array([0.25, 0.5]))
    changed = dataclasses.replace(FUSION, prior=prior)
    moving = parse(draw(fusion=changed))
    ellipse = beliefs(moving)[1]  # its PoI is seen later
    first = {t.attribute: t.at(0.0)[0] for t in tracks(ellipse)}
    scale = 170 / 2.4  # as above
    assert first["cx"] == pytest.approx(170 + scale, abs=0.1)
    assert first["cy"] == pytest.approx(170 + scale * 0.5, abs=0.1)
    assert first["rx"] == pytest.approx(scale * 0.25, abs=0.1)
    # The ring of all that are unknown stays there.
    (ring,) = (e for e in moving.iter(f"{SVG}ellipse") if e.get("fill") == "none")
    for name in ("cx", "cy", "rx"):
        assert float(ring.get(name)) == pytest.approx(first[name], abs=0.1)


def notes(film):
    """What the film says below its views."""
    found = [e for e in film.iter(f"{SVG}text") if e.get("class") == "film-note"]
    return sorted(e.text for e in found if e.text)


@pytest.mark.parametrize("name", ["mission.svg", "mission_naive.svg", "figures/team_mission.svg"])
def test_films_of_the_pages_say_what_films_say_today(picture, name):
    docs = Path(__file__).parents[1] / "docs"
    shown = ElementTree.parse(docs / name).getroot()
    assert len(notes(picture)) == 4
    assert notes(shown) == notes(picture)

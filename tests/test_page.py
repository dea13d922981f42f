"""The report page: what it says, and how a browser shows it."""

import dataclasses
import html
import json
import re
import shlex
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from recordings import CLASS_BELIEFS, CONFIG, recording

from jaxsense.config import ConfigError
from jaxsense.show import animation, page

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = next((path for name in BROWSERS if (path := shutil.which(name))), None)

POLICY = {
    "return": 1.2345, "optimal": 1.25, "naive": 1.0, "random": -1.5, "fraction_of_optimal": 0.9876,
    "one_step": {"policy": 0.86, "optimal": 0.87, "random": -0.1}, "optimal_states": 1700,
    "num_states": 1728, "optimal_permutations": 380, "num_permutations": 384,
    "env_steps": 409600, "env_steps_per_s": 50000.4,
}  # fmt: skip
MISSION = {
    "accuracy": 0.998, "observations_per_poi": 1.68, "time_s": 13.8, "collisions": 0,
    "goals_reached_fraction": None, "information": 5.8, "episodes": 128,
    "ended": {"finished": 127, "time limit": 1},
}  # fmt: skip
TABLE = {"joint": [True] * 3, "camera": [True, False, False], "lidar": [False, True, True]}
SUMMARY = {
    "preset": "smoke",
    "seed": 3,
    "versions": {"jaxsense": "0.1.0", "jax": "<0.10>"},
    "devices": ["cpu", "cpu"],
    "timing": {"total_s": 23.7, "stages": {"jmvae": {"compile_s": 1.5, "run_s": 4.5}}},
    "detectors": {"camera": {"accuracy": 1.0}, "lidar": {"accuracy": 0.9995}},
    "jmvae": {
        "active_units": 2,
        "fusion": {"accuracy": 0.9996, "mean_error": 0.021},
        "moment_matching_error": 0.0067,
        "sigma_norm": {name: [0.5, 1.25, 1.5] for name in TABLE},
        "unambiguous": TABLE,
        "consistent": {name: [0.995, 1.0, 0.5] for name in TABLE},
    },
    "belief": {"doubt_correlation": 0.9375},
    "dqn": {"camera": POLICY, "lidar": POLICY},
    "mission": {
        "latent": MISSION,
        "camera_alone": MISSION,
        "bytes_per_detection": {"latent": 16.0, "features": 8.0, "raw": 2326.5},
    },
}


def write_run(path):
    path.mkdir(exist_ok=True)
    (path / "config.json").write_text(json.dumps({"commit": "0123abc"}))
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = write_run(tmp_path_factory.mktemp("page") / "run & <more>")
    for name in ("latent_space", "reward"):
        Figure(figsize=(8, 4)).savefig(path / f"{name}.png", dpi=20)
    animation.write(path / "mission.svg", CONFIG, recording(), CLASS_BELIEFS, "latent policy")
    assert page.write(path, CONFIG, SUMMARY) == path / "report.html"
    return path


class Reader(HTMLParser):
    """Collects the tags of a page with their attributes, and the rows of its tables."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.rows, self.words, self.in_cell = [], [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th") and self.rows:
            self.rows[-1].append("")
            self.in_cell = True

    def handle_endtag(self, tag):
        self.in_cell = self.in_cell and tag not in ("td", "th")

    def handle_data(self, data):
        self.words.append(data)
        if self.in_cell:
            self.rows[-1][-1] += data.strip().replace("\u00a0", " ")


@pytest.fixture(scope="module")
def read(run):
    return Reader((run / "report.html").read_text())


def test_the_page_asks_for_nothing(run, read):
    addresses = [
        value
        for _, attributes in read.tags
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "action", "data", "poster") or name.endswith(":href")
    ]
    assert len(addresses) > 3
    assert all(address.startswith(("data:", "#")) for address in addresses)
    text = (run / "report.html").read_text()
    assert not re.search(r"@import|url\((?!#)|<script|\son\w+=", text)


def test_figures_stand_beside_those_of_the_paper(read):
    rows = {row[0]: row[1:] for row in read.rows if len(row) > 1}
    assert rows["episode: DQN, greedy"] == ["1.234", "1.234", "Fig. 5"]
    assert rows["one step: optimal"] == ["0.870", "0.870", "0.426*"]
    assert rows["optimal in states"] == ["1,700", "1,700", "-"]
    assert rows["states of the map"] == ["1,728", "1,728", "-"]
    assert rows["optimal in permutations"] == ["380", "380", "-"]
    assert rows["permutations"] == ["384", "384", "384"]
    assert rows["sigma norm, unambiguous"] == ["0.50 to 1.50", "from 1.05"]
    assert rows["dimensions in use"] == ["2", "1"]
    assert rows["doubt"] == ["0.938", "-"]
    # Camera, LiDAR and both; the paper's LiDAR cannot tell a red cylinder.
    # In brackets the looks after which just the right classes are plausible.
    red = ["no / no (100.0%)", "yes / no (100.0%)", "yes / yes (100.0%)"]
    assert rows["red cylinder"] == red
    assert rows["red cube"] == ["no / no (50.0%)", "yes / yes (50.0%)", "yes / yes (50.0%)"]
    assert rows["accuracy"] == ["0.998", "0.998"]
    assert rows["goals reached"] == ["-", "-"]
    assert rows["time limit"] == ["1", "1"]
    assert rows["jmvae"][:2] == ["1.50", "4.50"]


@pytest.mark.parametrize(
    ("change", "caption"),
    [
        ({}, "All robots together, in the same arenas for each policy"),
        ({"seed": 1}, "All robots together; policies of equal seed and missions had the same"),
        ({"episodes": 64}, "All robots together; policies of equal seed and missions had the same"),
    ],
)
def test_the_table_of_missions_tells_which_arenas_are_the_same(tmp_path, change, caption):
    missions = {**SUMMARY["mission"], "naive": {**MISSION, **change}}
    text = page.write(write_run(tmp_path), CONFIG, {**SUMMARY, "mission": missions}).read_text()
    assert caption in text
    rows = {row[0]: row[1:] for row in Reader(text).rows if row}
    assert rows.get("seed") == (["-", "-", "1"] if "seed" in change else None)


def test_what_was_run_is_told_and_escaped(run, read):
    text = " ".join(" ".join(read.words).split())
    for words in ("smoke preset, seed 3", "0 in theory", "0123abc", "jax <0.10>", "nothing: all"):
        assert words in text
    assert f"evaluate {shlex.quote(str(run))} --episodes" in text
    assert ("html", {"lang": "en"}) in read.tags
    images = [attributes for tag, attributes in read.tags if tag == "img"]
    assert len(images) == 2
    assert all(len(image["alt"]) > 20 for image in images)


def test_changed_settings_are_named(tmp_path):
    config = dataclasses.replace(CONFIG, dqn=dataclasses.replace(CONFIG.dqn, discount=0.9))
    text = page.write(write_run(tmp_path), config, SUMMARY).read_text()
    assert f"<code>dqn.discount</code> = 0.9 (preset: {CONFIG.dqn.discount})" in text
    assert "<svg" not in text


def test_with_other_classes_there_is_nothing_to_compare(tmp_path):
    classes = ("blue cylinder", "red cylinder", "red cube")
    arena = dataclasses.replace(CONFIG.arena, classes=classes)
    path = page.write(write_run(tmp_path), dataclasses.replace(CONFIG, arena=arena), SUMMARY)
    rows = {row[0]: row[1:] for row in Reader(path.read_text()).rows if row}
    assert rows["blue cylinder"] == ["yes (99.5%)", "no (99.5%)", "yes (99.5%)"]


@pytest.mark.parametrize(
    "content",
    [None, "", "{}", '{"preset": "smoke"}', "[1]", '{"commit": 1', "\udcff"],
    ids=range(7),
)
def test_a_config_of_few_keys_is_enough(tmp_path, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content, encoding="utf-8", errors="surrogateescape")
    text = page.write(tmp_path, CONFIG, SUMMARY).read_text()
    assert "nothing: all" in text
    assert "commit" not in text


@pytest.mark.parametrize("part", ["timing", "detectors", "jmvae", "dqn", "mission"])
@pytest.mark.parametrize("value", [None, 3, [], "x", {"x": 3}])
def test_a_summary_without_its_figures_is_named(tmp_path, part, value):
    with pytest.raises(ConfigError) as error:
        page.write(tmp_path, CONFIG, {**SUMMARY, part: value})
    assert "must hold the summary.json of a finished run" in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_what_an_animation_writes_is_shown(run, read):
    assert len([tag for tag, _ in read.tags if tag == "svg"]) == 2
    assert ("use", {"href": "#mission-film"}) in read.tags
    kinds = {tag for tag, _ in read.tags}
    assert {"animatetransform", "ellipse", "clippath"} <= kinds


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("</svg>", "<script>alert(1)</script></svg>"),
        ("</svg>", '<image href="https://x.org/x.png"/></svg>'),
        ("</svg>", '<a href="javascript:alert(1)"><text>x</text></a></svg>'),
        ("</svg>", '<use href="https://x.org/x.svg#x"/></svg>'),
        ("</svg>", "<foreignObject><p>x</p></foreignObject></svg>"),
        ("</svg>", '<x:script xmlns:x="http://www.w3.org/1999/xhtml">alert(1)</x:script></svg>'),
        ("</svg>", '<set attributeName="href" to="x"/></svg>'),
        ("</svg>", '<rect onclick="alert(1)"/></svg>'),
        ("</svg>", '<rect style="fill:red"/></svg>'),
        ("</svg>", '<rect fill="url(https://x.org/x)"/></svg>'),
        ("</svg>", '<animate attributeName="href" values="x"/></svg>'),
        ("</svg>", "<style>@import 'https://x.org/x.css';</style></svg>"),
        ("</svg>", "<style>rect{background:URL (//x.org/x)}</style></svg>"),
        ("</svg>", "<style>rect{background:u\\72l(//x.org/x)}</style></svg>"),
        ("<svg ", '<!DOCTYPE svg [<!ENTITY a "b">]><svg '),
        ("<svg ", '<svg onload="alert(1)" '),
        ("</svg>", ""),
        ('viewBox="', 'viewBox="x '),
        ('viewBox="0 0', 'viewBox="'),
    ],
    ids=range(19),
)
def test_what_no_animation_writes_is_left_out(run, tmp_path, before, after):
    film = (run / "mission.svg").read_text(encoding="utf-8")
    assert before in film
    (tmp_path / "mission.svg").write_text(film.replace(before, after, 1), encoding="utf-8")
    text = page.write(tmp_path, CONFIG, SUMMARY).read_text(encoding="utf-8")
    assert "<svg" not in text
    assert "x.org" not in text


def test_the_name_of_an_animation_is_escaped(run, tmp_path):
    name = 'mission"><script>alert(1)<!--'
    shutil.copy(run / "mission.svg", tmp_path / f"{name}.svg")
    text = page.write(tmp_path, CONFIG, SUMMARY).read_text(encoding="utf-8")
    assert "<svg" in text
    assert "<script>" not in text


MEASURE = """
const frame = document.querySelector("iframe");
frame.onload = () => setTimeout(() => {
  const page = frame.contentDocument, root = page.documentElement;
  const [left, right] = page.querySelectorAll("svg");
  const robot = left.querySelector(".film-moving circle[stroke-width]");
  const at = t => { left.setCurrentTime(t); return robot.getBoundingClientRect().x; };
  left.pauseAnimations();
  document.title = JSON.stringify({
    width: [root.clientWidth, root.scrollWidth],
    cut: [...page.querySelectorAll("main > *, section > *, h1, p, li, dd, figcaption")]
      .filter(e => e.getBoundingClientRect().right > root.clientWidth + 0.5).map(e => e.tagName),
    text: Math.min(...[...page.querySelectorAll("p, td, th, dd, li span, figcaption")]
      .map(e => parseFloat(frame.contentWindow.getComputedStyle(e).fontSize))),
    images: [...page.images].map(image => image.complete && image.naturalWidth > 0),
    below: right.getBoundingClientRect().top >= left.getBoundingClientRect().bottom,
    moved: at(2) - at(0),
    asked: frame.contentWindow.performance.getEntriesByType("resource").map(e => e.name)
      .filter(name => !name.startsWith("data:")),
  });
}, 200);
"""


@pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")
@pytest.mark.parametrize(("width", "is_phone"), [(390, True), (1280, False)])
def test_a_browser_shows_all_of_it(run, tmp_path, width, is_phone):
    # A window cannot be as narrow as a phone, a frame can.
    text = html.escape((run / "report.html").read_text(), quote=True)
    frame = f'<iframe style="width:{width}px;height:800px;border:0" srcdoc="{text}"></iframe>'
    wrapper = tmp_path / "wrapper.html"
    wrapper.write_text(f'<!doctype html><meta charset="utf-8">{frame}<script>{MEASURE}</script>')
    command = [
        *(
            BROWSER,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--window-size=1400,900",
        ),
        *("--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"),
        *("--virtual-time-budget=3000", "--dump-dom", wrapper.as_uri()),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title, done.stderr[-2000:]
    found = json.loads(html.unescape(title[1]))
    assert found["width"] == [width, width]
    assert found["cut"] == []
    assert found["text"] >= 13
    assert found["images"] == [True, True]
    assert found["asked"] == []
    assert found["below"] == is_phone
    assert found["moved"] > 40


def test_missions_elsewhere_have_tables_of_their_own(tmp_path):
    place = {"num_pois": 16, "side": 6.0, "robots": ["camera", "camera", "lidar"]}
    elsewhere = {"there": {**place, "mission": {"latent": {**MISSION, "accuracy": 0.75}}}}
    path = write_run(tmp_path / "run")
    page.write(path, CONFIG, {**SUMMARY, "elsewhere": elsewhere})
    read = Reader((path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(read.words)
    assert "16 points in 6 m; robots: camera, camera, lidar, in the same arenas" in words
    assert ["accuracy", "0.750"] in read.rows

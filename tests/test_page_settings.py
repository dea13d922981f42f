"""Pages state the settings of the presets and the constants of the code."""

import dataclasses
import json
import math
import re
from pathlib import Path

import pytest

import jaxsense
from benchmarks import exported
from benchmarks.fusions import study
from benchmarks.raw import training, variants
from benchmarks.results import RESULTS
from benchmarks.seeds.plan import GROUPS
from jaxsense import PRESETS, demo, sim, tasks
from jaxsense.dqn import optimum, reference, tours
from jaxsense.mission import memory
from jaxsense.mission.cases import FAULT_TIME
from jaxsense.sim import amiro, search
from jaxsense.summary import compare, make
from jaxsense.training import jmvaes
from jaxsense.vae import gate, novelty

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "benchmarks" / "RESULTS.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
PRESET_OF = {"getting-started": "noisy", "differences": "paper", "imperfect": "default"}
HEAD = "| setting | value |"
AFTER = {"`jmvae.steps`, `batch`, `learning_rate`": [0.0]}  # what the rate falls to
WORDS = {"yes": True, "on": True, "no": False, "off": False}
_VALUE = r"-?\d[\d,]*(?:\.\d+)?(?: (?:m|s|nats|degrees?))?"
_GROUP = rf"(?:`\w+`(?:, `\w+`)*: )?{_VALUE}"
INLINE = re.compile(rf"`(\w+\.[\w.]+)`\s+\(({_GROUP}(?:; {_GROUP})*)\)")
"""A setting in prose: "`mdp.look_cost` (0.05; `noisy`: 0.1)". A value for which no preset is named
is that of the page's preset."""


def _constants():
    """What prose says with numbers that are constants of the code, in the code's numbers."""
    yield from _sizes()
    yield from _of_studies()
    default = PRESETS["default"]
    lidar, camera, viewpoint = default.lidar, default.camera, default.viewpoint
    unambiguous, near = f"{100 * make._UNAMBIGUOUS:.0f}", make._AS_GOOD
    lost, rejected = f"{100 * gate._MAX_LOST:g} %", f"{100 * (1 - gate._MAX_PASSED):g} %"
    yield f"{lidar.num_beams} beams over {lidar.field_of_view:g} degrees"
    yield f"from {lidar.min_range} to {lidar.max_range:g} m"
    yield f"{camera.num_pixels} pixels over {camera.field_of_view:g} degrees"
    yield f"{viewpoint.min_distance} to {viewpoint.max_distance} m"
    yield f"Robots are {amiro.BODY_TOP:.3f} m high, or {amiro.LIDAR_TOP} m with a LiDAR"
    yield f"rejects {lost} of the looks at PoIs, or fewer if that already rejects {rejected} of"
    yield f"exceeds the accuracy by at most {novelty._TOLERANCE} in both halves"
    yield f"an error of at most {jmvaes._EXACT} nats"
    yield f"{compare._MOST_TIMES} times that of exact Bayes plus {compare._MOST_NATS} nats"
    yield f"more than {100 * make._ERROR:g} % plus two standard errors"
    yield f"within {near} of the optimal policy's"
    yield f"within {near} of optimal"
    yield f"more than {unambiguous} % of its held-out detections"
    yield f"over {unambiguous}% of looks leave this class"
    yield f"pseudo-Huber loss with a scale of {tours._ERROR:g} s"
    yield f"control periods of {default.mission.control_period} s"
    yield f"goes blind after {FAULT_TIME:g} s"
    yield f"Below an expected distance of {search._NEAREST} m, the search gets no wider"
    yield f"at most {100 * search._STEP:g} cm apart"
    for task in ("noisy-v0", "many-v0"):
        yield f"a look costs {jaxsense.make(task).mdp.reward.look_cost} nats"
    yield f"`--seed` selects the arena; with the default, {demo.Arguments().seed},"
    yield f"`--seed` (default: {demo.Arguments().seed})"
    yield f"each second of a robot's work costs {jaxsense.make('team-v0').mdp.config.second_cost}"


def _sizes():
    """The same, of how much is drawn, trained, played or stored."""
    default, paper, noisy = (PRESETS[name] for name in ("default", "paper", "noisy"))
    classes, pois, sensors = len(default.arena.classes), default.arena.num_pois, 2
    states = classes**pois * 2 ** (pois * sensors)
    distinct = math.factorial(pois) * 2 ** (pois * sensors)
    played = {
        name: re.findall(r"--episodes (\d+)", " ".join(group.evaluations))[-1]
        for name, group in GROUPS.items()
        if group.evaluations
    }
    assert played["noisy"] == played["team"]
    yield f"N is {played['default']} for `default`, {played['noisy']} for `noisy` and `team`, and"
    yield f"{played['many']} for `many`"
    yield f"each in {played['team_sizes']} missions"
    number = int(GROUPS["noisy"].options["--mission.episodes"])
    yield f"{number:,} missions of each policy with uncertain sensors"
    yield f"{tasks.EPISODES:,} episodes with each of ten seeds"
    yield f"make {states:,} start states"
    yield f"{states:,}, every combination"
    yield f"classes and looks, {states:,} for three PoIs"
    yield f"the paper's {distinct}"
    yield f"the {distinct} are also counted"
    yield f"Sec. IV, {distinct} states of the map"
    stratified = f"{default.evaluation.num_states:,}"
    yield f"if there are more than {stratified}, a run examines a stratified sample of {stratified}"
    yield f"here {stratified} instead of {states:,};"
    steps = optimum.steps_of_lattice(2, noisy.evaluation.value_points)
    looks = noisy.evaluation.value_looks
    yield f"`noisy` uses {looks} looks, and probabilities in steps of 1/{steps}"
    yield f"{paper.dqn.num_envs} steps and {paper.dqn.updates} gradient steps each"
    yield f"the multiple of {paper.dqn.num_envs} nearest"
    yield f"{default.dqn.num_starts // default.dqn.num_envs} for each environment"
    yield f"with {reference._NUM_DRAWS} simulated looks"
    (states_asked,) = (x for x in dataclasses.fields(exported.Arguments) if x.name == "states")
    yield f"in {states_asked.default:,} states in which a robot chooses"
    yield f"A robot remembers {memory.MOST_LOOKS} looks"


def _of_studies():
    """The same, of benchmarks."""
    yield f"the same {study._HISTORIES:,} histories"
    camera, lidar = (x.window * x.channels for x in sim.sensors.make(PRESETS["default"]))
    yield f"explain {camera} numbers from a camera or {lidar} from a LiDAR"
    yield f"both sensors have {camera} of them"
    of_scans = json.loads((RESULTS / "raw_ablation.json").read_text(encoding="utf-8"))
    yield f"{of_scans['steps']:,} gradient steps, on {of_scans['scans']:,} scans by each sensor"
    yield f"along a cosine, {of_scans['steps']:,} steps"
    yield f"Each gradient step uses {variants._PER_STEP} looks"
    yield f"{training._HELD_OUT:,} PoIs are held out"
    sizes = variants.OURS.jmvae.hidden
    yield f"{', '.join(map(str, sizes))} | {', '.join(map(str, sizes))} | ours"
    yield f"hidden layers of {sizes[0]} units"
    heaviest = max(max(x.jmvae.reconstruction_weights) for x in variants.ABLATION)
    yield f"weights of {heaviest:,.0f} cost little"


CONSTANTS = {
    text: re.compile(rf"(?<![\w.]){re.escape(text)}(?!\w)".replace(r"\ ", r"\s+"))
    for text in _constants()
}


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


def groups(cell, preset):
    """The presets and the number of each value in the brackets of `INLINE`."""
    for group in cell.split("; "):
        number = re.search(rf"{_VALUE}$", group)[0].split()[0]
        yield re.findall(r"`(\w+)`", group) or [preset], float(number.replace(",", ""))


INLINES = [
    (page.stem, preset, name, value)
    for page in PAGES
    for name, cell in INLINE.findall(page.read_text(encoding="utf-8"))
    for presets, value in groups(cell, PRESET_OF.get(page.stem, "default"))
    for preset in presets
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


@pytest.mark.parametrize(("page", "preset", "name", "value"), INLINES)
def test_settings_in_prose_are_those_of_the_presets(page, preset, name, value):
    assert set(settings(preset, f"`{name}`")) == {value}


def test_settings_in_prose_are_found():
    assert len(INLINES) > 20
    found = INLINE.findall("`a.b` (1,024; `noisy`, `many`: 0.2 m), `a.b` (twice), `b` (0.3)")
    assert found == [("a.b", "1,024; `noisy`, `many`: 0.2 m")]
    assert [*groups(found[0][1], "paper")] == [(["paper"], 1024.0), (["noisy", "many"], 0.2)]


@pytest.mark.parametrize("text", CONSTANTS)
def test_constants_of_the_code_are_stated_on_pages(text):
    """A phrase that no page has any more must go; one whose number changed counts as typed."""
    assert any(CONSTANTS[text].search(page.read_text(encoding="utf-8")) for page in PAGES)

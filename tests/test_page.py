"""The report page: what it says, and how a browser shows it."""

import html
import inspect
import re
import shlex
from xml.etree import ElementTree

import jax
import pytest
from matplotlib.figure import Figure
from recordings import CONFIG, FUSION, recording
from summaries import CASE, SUMMARY

import jaxsense
from jaxsense import mission
from jaxsense.show import drawing, film, page
from jaxsense.summary import blocks, compare


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "run & <more>"
    path.mkdir()
    for name in ("latent_space", "reward"):
        (path / f"{name}.svg").write_bytes(drawing.svg(Figure(figsize=(8, 4))))
    (drawn,) = film.draw(CONFIG, {"latent policy": recording()}, FUSION)
    (path / "mission.svg").write_text(drawn)
    found = {**SUMMARY, "commit": "0123abc"}
    (path / "report.html").write_text(page.render(path, CONFIG, found), encoding="utf-8")
    return path


def words(text):
    """What a page says."""
    return " ".join(html.unescape(re.sub("<[^<>]*>", " ", text)).split())


def test_the_page_asks_for_nothing(run):
    text = (run / "report.html").read_text()
    addresses = re.findall(r'(?:src|href|srcset|action|data|poster)="([^"]*)"', text)
    assert len(addresses) > 3
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert not re.search(r"@import|url\((?!#)|<script|\son\w+=", text)


def test_main_results_stand_beside_what_they_are_compared_with(tmp_path):
    naive = {**CASE, "observations_per_poi": 2.0, "time_s": 15.0}
    others = {"naive": naive, "random": {**CASE, "accuracy": 0.5, "time_s": 9.0}}
    content = {**SUMMARY, "mission": {**SUMMARY["mission"], **others}}
    text = page.render(tmp_path, CONFIG, content)
    assert "By median times, the latent policy is 8 % faster than naive exploration." in text


def test_the_program_of_the_page_runs(run, monkeypatch, capsys):
    played = recording()

    def reset(key, mission, models):
        return played.end

    def rollout(key, mission, models, state, steps):
        assert (mission.config, models, steps) == (CONFIG, "models", 300)
        return state, played.records

    compiled = jax.jit

    def jit(function, **options):
        # Modules that `jaxsense` imports only now compile functions of their own.
        return function if function is rollout else compiled(function, **options)

    for stub in (reset, rollout):
        own = inspect.signature(getattr(mission, stub.__name__)).parameters
        assert [*inspect.signature(stub).parameters] == [*own][: stub.__code__.co_argcount]
        monkeypatch.setattr(mission, stub.__name__, stub)
    monkeypatch.setattr(jax, "jit", jit)
    monkeypatch.setattr(jaxsense, "load", lambda path: (CONFIG, "models"))
    (program,) = re.findall(
        r"<code>(import jax.*?)</code>", (run / "report.html").read_text(), re.S
    )
    exec(html.unescape(program), {})
    assert capsys.readouterr().out == f"{played.records.belief.mean[-1]} {played.end.classes}\n"


def test_what_was_run_is_told_and_escaped(run):
    page = (run / "report.html").read_text()
    text = words(page)
    for told in ("smoke preset, seed 90210", "0123abc", "jax <0.10>", "unchanged from the preset"):
        assert told in text
    assert f"evaluate {shlex.quote(str(run))} --episodes" in text
    assert "Animation mission: robots in the arena" in text
    alternatives = re.findall('<img [^>]*alt="([^"]*)"', page)
    assert [len(alternative) > 20 for alternative in alternatives] == [True, True]


HOSTILE = """<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)" style="position:fixed">
<style>main{display:none} @keyframes k0123456789{0%{opacity:1}50%{x:url(https://x.org)}}
@keyframes k0123456789{0%{opacity:0}}
rect{background:image-set("https://x.org/x.png" 1x)}</style>
<script>alert(1)</script><image href="https://x.org/x.png"/>
<a href="https://x.org"><text>x</text></a>
<g fill="&#10;url(https://x.org/x.svg#a)" onclick="alert(1)" opacity=".5">
<text>&lt;b&gt;1&lt;/b&gt;</text>
<foreignObject><form xmlns="http://www.w3.org/1999/xhtml"/></foreignObject></g></svg>"""


def test_of_a_file_only_what_films_draw_is_on_the_page(tmp_path):
    (tmp_path / "mission.svg").write_text(HOSTILE, encoding="utf-8")
    text = page.render(tmp_path, CONFIG, SUMMARY)
    found = re.findall("<svg.*?</svg>", text, re.DOTALL)
    assert ["".join(each.split()) for each in found] == [
        "<svg><style>@keyframesk0123456789{0%{opacity:0}}</style>"
        '<gopacity=".5"><text>&lt;b&gt;1&lt;/b&gt;</text></g></svg>'
    ]
    (policy,) = re.findall('http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    rules = {rule.split()[0]: rule.split()[1:] for rule in policy.split(";")}
    assert rules.pop("style-src") == ["'unsafe-inline'"]
    assert rules.pop("img-src") == ["data:"]
    assert rules == {key: ["'none'"] for key in ("default-src", "base-uri", "form-action")}


def test_a_film_is_drawn_whole_and_can_be_paused_without_a_script(run):
    text = (run / "report.html").read_text()
    choices = re.findall(r'<label><input type="radio" name="film-1" class="(\w+)"', text)
    assert choices == ["play", "pause", "stop"]
    there = ElementTree.fromstring((run / "mission.svg").read_text())
    here = ElementTree.fromstring(re.search('<svg class="film".*</svg>', text, re.DOTALL)[0])
    assert [each.attrib for each in here.iter()] == [each.attrib for each in there.iter()]
    frames = [re.findall("@keyframes.*", each.findtext(".//{*}style")) for each in (here, there)]
    assert frames[0] == frames[1]
    assert len(frames[0]) > 10


def test_a_page_of_several_seeds_links_to_theirs(tmp_path):
    of_seed = {name: SUMMARY[name] for name in blocks.Results.__annotations__}
    means = compare.statistics([of_seed, of_seed])
    content = {**SUMMARY, **means, "seeds": {"3": of_seed, "4": of_seed}, "failed": {"5": "jmvae"}}
    text = page.render(tmp_path, CONFIG, content)
    assert "smoke preset, 2 seeds" in text
    assert '<a href="seed-4/report.html">4</a>' in text
    assert "5 (jmvae)" in text
    assert "<td>0.998 (0.998\u00a0to\u00a00.998)</td>" in text

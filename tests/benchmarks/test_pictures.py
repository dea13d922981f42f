"""Every picture of the pages has a command that draws it."""

import importlib
import json
import shlex
from pathlib import Path

import pytest

from benchmarks import film, pictures, results
from jaxsense import train
from jaxsense.config import options

COMMANDS = [
    command
    for drawing in pictures.DRAWINGS
    if isinstance(drawing, pictures.Written)
    for command in drawing.commands
]


def test_every_picture_of_the_pages_is_in_the_table_once():
    drawn = [picture for drawing in pictures.DRAWINGS for picture in drawing.pictures]
    there = [
        str(path.relative_to(pictures.DOCS).as_posix())
        for folder in (pictures.DOCS, pictures.DOCS / "figures")
        for path in folder.iterdir()
        if path.suffix in (".svg", ".png", ".jpg", ".gif", ".webp")
    ]
    assert sorted(drawn) == sorted(there)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_of_pictures_have_known_options(command, tmp_path):
    _, *words = shlex.split(command.replace(pictures.FOLDER, str(tmp_path)))
    if words[0] == "-m":
        module = importlib.import_module(words[1])
        read = train.parse if module is train else lambda x: options.read(module.Arguments, x)
        read(words[2:])
    elif words[0] == "-c":
        compile(words[1], "command", "exec")
    else:
        assert Path(words[0]).exists()


def test_pictures_show_files_that_exist():
    names = {name for drawing in pictures.DRAWINGS for name in drawing.results}
    assert names <= {path.stem for path in results.RESULTS.glob("*.json")}


@pytest.fixture
def drawing(tmp_path, monkeypatch):
    """A drawing of two pictures by two commands, and the commands that have run."""
    monkeypatch.setattr(pictures, "DOCS", tmp_path)
    ran = []

    def run(command):
        ran.append(command)
        folder = Path(command.split()[-1])
        (folder / "a.svg").write_text("new")
        return command.startswith("python good")

    monkeypatch.setattr(pictures.commands, "run", run)
    both = pictures.Written(("python good FOLDER", "python good FOLDER"), {"x.svg": "a.svg"})
    bad = pictures.Written(("python good FOLDER", "python bad FOLDER"), {"y.svg": "a.svg"})
    long = pictures.Written(("python -m jaxsense.train FOLDER",), {"z.svg": "a.svg"})
    monkeypatch.setattr(pictures, "DRAWINGS", (both, bad, long))
    return ran


def test_a_picture_is_replaced_if_all_its_commands_succeed(drawing, tmp_path, capsys):
    (tmp_path / "y.svg").write_text("old")
    with pytest.raises(SystemExit, match=r"not drawn: y\.svg"):
        pictures.main([])
    assert (tmp_path / "x.svg").read_text() == "new"
    assert (tmp_path / "y.svg").read_text() == "old"
    assert "left out: z.svg: needs a training: run python -m benchmarks.pictures z.svg" in (
        capsys.readouterr().out
    )
    assert len(drawing) == 4


def test_a_picture_may_be_named(drawing, tmp_path):
    pictures.main(["x.svg"])
    assert [path.name for path in tmp_path.iterdir()] == ["x.svg"]
    with pytest.raises(SystemExit):
        pictures.main(["unknown.svg"])


def test_plots_of_stored_results_are_svg(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "DOCS", tmp_path)
    (tmp_path / "figures").mkdir()
    (plot,) = [x for x in pictures.DRAWINGS if "figures/noisy_curves.svg" in x.pictures]
    assert plot.draw()
    assert "<svg" in (tmp_path / "figures" / "noisy_curves.svg").read_text(encoding="utf-8")
    assert json.loads((results.RESULTS / "curves.json").read_text(encoding="utf-8"))["policies"]


def test_a_film_names_the_policies_that_it_can_play(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        film.main(["pretrained:default", "--policy", "best", "--plot", str(tmp_path / "film.svg")])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("benchmarks.film: policy = 'best': must be one of latent, network,")
    assert not (tmp_path / "film.svg").exists()

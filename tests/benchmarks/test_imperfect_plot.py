"""Curves of imperfect robots: what the files say, and no more."""

import json
import re

import numpy as np
import pytest

from benchmarks import imperfect_plot

ALL_FIGURES = ("accuracy", "nll", "time")


def row(size, accuracy, time):
    """Each figure with its difference from no error, and half the width of its interval."""
    each = {"accuracy": [accuracy, -0.1, 0.02], "nll": [size, 0.4, 0.1], "time": [time, 5.0, 2.0]}
    return {"size": size, **each}


USUAL = {"accuracy": 1.0, "nll": 0.1, "time": 20.0}
POSES = {"sweep": "position [m]", "rows": [row(0.01, 0.9, 25.0), row(0.02, 0.8, 30.0)]}
LOSSES = {"sweep": "loss", "rows": [row(0.5, 0.7, 21.0)]}
ALL = {"usual": USUAL, "sweeps": [POSES, LOSSES]}


def test_a_curve_shows_its_figures_and_times_as_ratios():
    figure = imperfect_plot.draw({"a": ALL}, ALL_FIGURES)
    accuracy, losses, nll, _, time, last = figure.axes
    assert [axis.get_xlabel() for axis in (time, last)] == ["position [m]", "loss"]
    assert [axis.get_ylabel() for axis in (accuracy, nll)] == ["accuracy", "NLL"]
    np.testing.assert_allclose(accuracy.lines[0].get_xydata(), [[0.01, 0.9], [0.02, 0.8]])
    np.testing.assert_allclose(losses.lines[0].get_xydata(), [[0.5, 0.7]])
    np.testing.assert_allclose(nll.lines[0].get_ydata(), [0.01, 0.02])
    np.testing.assert_allclose(nll.lines[1].get_ydata(), [0.1, 0.1])
    np.testing.assert_allclose(time.lines[0].get_ydata(), [1.25, 1.5])
    np.testing.assert_allclose(time.lines[1].get_ydata(), [1, 1])
    band = time.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose([band[:, 1].min(), band[:, 1].max()], [1.15, 1.6])


def test_sweeps_and_figures_are_chosen():
    figure = imperfect_plot.draw({"a": ALL}, ("time",), ("loss",))
    (axis,) = figure.axes
    assert axis.get_xlabel() == "loss"


@pytest.fixture
def files(tmp_path):
    for name, sweeps in (("one", [POSES, LOSSES]), ("other", [POSES]), ("third", [LOSSES])):
        of_run = {"options": {"run": f"pretrained:{name}"}, "usual": USUAL}
        text = json.dumps({**of_run, "curves": {"no search": sweeps}})
        (tmp_path / f"{name}.json").write_text(text, encoding="utf-8")
    (tmp_path / "bad.json").write_text("{}", encoding="utf-8")
    return tmp_path


def test_files_are_compared_where_both_say_something(files):
    paths = [files / "one.json", files / "other.json"]
    found = {}
    for path in paths:
        found |= imperfect_plot.curves_of(json.loads(path.read_text(encoding="utf-8")))
    figure = imperfect_plot.draw(found, ALL_FIGURES)
    assert len(figure.axes) == 3
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["one, no search", "other, no search"]
    # The other file has no losses.
    figure = imperfect_plot.draw(found, ALL_FIGURES, ("loss",))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one, no search"]
    imperfect_plot.main([*map(str, paths), "--plot", str(files / "p.png")])
    assert (files / "p.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("names", "plot", "reason"),
    [
        (["one"], "one.json", r"plot = PosixPath\('.*one.json'\): must be a new file"),
        (["one"], "nowhere/p.png", "plot = '.*p.png': cannot be written: No such file"),
        (["bad"], "p.png", "files: 'options'"),
        (["one", "one"], "p.png", "must name one file or more, each once"),
        (
            ["other", "third"],
            "p.png",
            r"sweeps = \[\]: must be some of \['position \[m\]', 'l",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_one_line(files, names, plot, reason, capsys):
    paths = [str(files / f"{name}.json") for name in names]
    with pytest.raises(SystemExit):
        imperfect_plot.main([*paths, "--plot", str(files / plot)])
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert re.search(reason, error)

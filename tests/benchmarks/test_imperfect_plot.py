"""Curves of imperfect robots: what the files say, and no more."""

import json

import numpy as np
import pytest

from benchmarks import imperfect_plot


def row(size, accuracy, time):
    return {"size": size, "accuracy": [accuracy, -0.1, 0.02], "nll": [0.5, 0.4, 0.1],
            "time": [time, 5.0, 2.0]}  # fmt: skip


USUAL = {"accuracy": 1.0, "nll": 0.1, "time": 20.0}
POSES = {"sweep": "position [m]", "rows": [row(0.01, 0.9, 25.0), row(0.02, 0.8, 30.0)]}
LOSSES = {"sweep": "loss", "rows": [row(0.5, 0.7, 21.0)]}
ALL = {"usual": USUAL, "sweeps": [POSES, LOSSES]}


def test_a_curve_shows_its_figures_and_times_as_ratios():
    figure = imperfect_plot.draw({"a": ALL})
    accuracy, losses, _, _, time, _ = figure.axes
    assert [axis.get_xlabel() for axis in (time, figure.axes[-1])] == ["position [m]", "loss"]
    np.testing.assert_allclose(accuracy.lines[0].get_xydata(), [[0.01, 0.9], [0.02, 0.8]])
    np.testing.assert_allclose(losses.lines[0].get_xydata(), [[0.5, 0.7]])
    np.testing.assert_allclose(time.lines[0].get_ydata(), [1.25, 1.5])
    np.testing.assert_allclose(time.lines[1].get_ydata(), [1, 1])
    band = time.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose([band[:, 1].min(), band[:, 1].max()], [1.15, 1.6])


def test_files_are_compared_where_both_say_something(tmp_path, capsys):
    paths = [tmp_path / "one.json", tmp_path / "other.json"]
    for path, sweeps in zip(paths, ([POSES, LOSSES], [POSES]), strict=True):
        path.write_text(json.dumps({"usual": USUAL, "sweeps": sweeps}), encoding="utf-8")
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}
    figure = imperfect_plot.draw(found)
    assert len(figure.axes) == 3
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["one", "other"]
    picture = tmp_path / "p.png"
    imperfect_plot.main([*map(str, paths), "--plot", str(picture)])
    assert picture.stat().st_size > 1000
    with pytest.raises(SystemExit):
        imperfect_plot.main([*map(str, paths), "--plot", str(picture)])
    assert "must be a new file" in capsys.readouterr().err


def test_other_files_are_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "a.json").write_text("{}", encoding="utf-8")
    with pytest.raises(SystemExit):
        imperfect_plot.main([str(tmp_path / "a.json"), "--plot", str(tmp_path / "p.png")])
    assert "files: 'sweeps'" in capsys.readouterr().err

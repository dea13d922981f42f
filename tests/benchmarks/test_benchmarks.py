"""Every row at tiny size, so that none of them rots."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import ROWS
from benchmarks.measure import Options, Row, Side, compare, compiled, joined
from jaxsense.run.devices import Workers

KEYS = {
    "row", "unit", "ours", "peer", "theirs", "ratio", "compile_s", "device", "batch", "versions",
    "commit", "date", "cores", "command", "also",
}  # fmt: skip


@pytest.mark.slow  # compiles missions and whole trainings for minutes; before a release
def test_all_rows_as_a_user_measures_them(tmp_path):
    path = tmp_path / "rows.json"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--peers", "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["row"]: row for row in json.loads(path.read_text())}
    assert list(rows) == list(ROWS)
    for name, row in rows.items():
        assert name in done.stdout
        assert set(row) == KEYS
        assert row["unit"] == "s" or row["unit"].endswith("/s")
        assert {"jax", "jaxlib", "mujoco", "numpy", "python"} <= set(row["versions"])
        assert row["batch"] >= 1
        assert "cpu" in row["device"]
        has_peer = row["theirs"] is not None
        # MuJoCo is always there.
        assert has_peer or "warp" in name or not name.startswith(("physics", "rays"))
        for figure in ("ours", "compile_s", *(["theirs", "ratio"] if has_peer else [])):
            assert math.isfinite(row[figure]), figure
            assert row[figure] > 0, figure
        if has_peer:
            rate = row["ours"] / row["theirs"]
            assert row["ratio"] == pytest.approx(1 / rate if row["unit"] == "s" else rate)
    # There is no CUDA device.
    assert "peer mujoco_warp is left out" in done.stderr
    assert 1 < rows["rays"]["also"]["ray-geom tests/s"] / rows["rays"]["ours"] < 50


def test_a_ratio_is_how_many_times_faster_we_are():
    rate, seconds = (Row("a", unit, 10.0, 1.0, 1, theirs=5.0) for unit in ("steps/s", "s"))
    assert (rate.ratio, seconds.ratio) == (2.0, 0.5)


def test_sides_take_turns_and_the_fastest_of_each_counts():
    calls = []

    def side(name, work):
        return Side(lambda: calls.append(name), work, batch=len(name), compile_s=1.0)

    ours = [side("slow", 1e-9), side("a", 1.0)]
    row = compare("row", "x/s", ours, [side("b", 1.0)], Options(), peer="B")
    assert calls[-2 * Options().repeats :] == ["a", "b"] * Options().repeats
    assert row.batch == 1


def test_as_many_threads_share_a_row_as_divide_its_batch():
    workers = Workers(threads=3)
    double = lambda x: 2 * x  # noqa: E731
    side = compiled(double, np.arange(4.0), work=4, batch=4, workers=workers)
    assert side.num_devices == 2
    np.testing.assert_array_equal(joined(side.run()), [0, 2, 4, 6])
    assert compiled(double, np.arange(6.0), work=6, batch=6, workers=workers).num_devices == 3

"""Every row at tiny size, so that none of them rots."""

import contextlib
import importlib
import io
import json
import math
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import ROWS, __main__
from benchmarks.measure import Options, Row, Side, compare, compiled, joined
from jaxsense.run import devices
from jaxsense.run.devices import Workers

QUICK = ("physics_batch", "rays", "rays_warp", "jmvae")
KEYS = {
    "row", "unit", "ours", "peer", "theirs", "ratio", "compile_s", "device", "batch", "versions",
    "commit", "date", "cores", "command", "also",
}  # fmt: skip
# Without a CUDA device, Warp is left out even where it is installed.
WARP = (
    "physics_warp",
    "physics_contacts_warp",
    "physics_solver_warp",
    "rays_warp",
    "rays_warp_bvh",
)
PEERS = {
    "jmvae": "multivae",
    "dqn_rejax": "rejax",
    "dqn_sb3": "stable_baselines3",
    "time_to_optimal_rejax": "rejax",
    "time_to_optimal_sb3": "stable_baselines3",
}


def written(path):
    return {row["row"]: row for row in json.loads(path.read_text())}


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The rows that compile in seconds, and what was printed."""
    path = tmp_path_factory.mktemp("json") / "rows.json"
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        # The figures mean nothing here.
        patch.setattr(devices, "compiler_options", lambda **_: {})
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            __main__.main([*QUICK, "--quick", "--peers", "--json", str(path)])
    return written(path), output.getvalue(), errors.getvalue()


def check_row(row, has_peer):
    assert set(row) == KEYS
    assert row["unit"] == "s" or row["unit"].endswith("/s")
    assert {"jax", "jaxlib", "mujoco", "numpy", "python"} <= set(row["versions"])
    assert row["batch"] >= 1
    assert "cpu" in row["device"]
    figures = ["ours", "compile_s"] + (["theirs", "ratio"] if has_peer else [])
    for figure in figures:
        assert math.isfinite(row[figure]), figure
        assert row[figure] > 0, figure
    if has_peer:
        order = ("theirs", "ours") if row["unit"] == "s" else ("ours", "theirs")
        assert row["ratio"] == pytest.approx(row[order[0]] / row[order[1]])
    else:
        assert row["theirs"] is None
        assert row["ratio"] is None


def has_package(name):
    try:
        importlib.import_module(name)
    except (ImportError, RuntimeError):
        return False
    return True


def has_peer(name):
    if name in WARP or name.startswith(("resets", "team")):
        return False
    if name.startswith(("physics", "rays")) or name.endswith("_devices"):
        return True
    return name in PEERS and has_package(PEERS[name])


def check_rows(rows):
    for name, row in rows.items():
        check_row(row, has_peer(name))


def check_printed(rows, output, errors):
    for name in rows:
        assert name in output
    assert "peer mujoco_warp is left out" in errors or not rows.keys() & set(WARP)
    for name, package in PEERS.items():
        if name not in rows:
            continue
        adapter = name.split("_")[-1] if name != "jmvae" else "multivae"
        assert has_package(package) or f"peer {adapter} is left out" in errors


@pytest.mark.slow
def test_quick_rows_with_a_table_and_the_names_of_missing_peers(quick):
    assert tuple(quick[0]) == QUICK
    check_rows(quick[0])
    check_printed(*quick)
    assert 1 < quick[0]["rays"]["also"]["ray-geom tests/s"] / quick[0]["rays"]["ours"] < 50


@pytest.mark.slow  # compiles missions and whole trainings for minutes; before a release
def test_all_rows_as_a_user_measures_them(tmp_path):
    path = tmp_path / "rows.json"
    command = [sys.executable, "-m", "benchmarks", "--quick", "--peers", "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = written(path)
    assert list(rows) == list(ROWS)
    check_rows(rows)
    check_printed(rows, done.stdout, done.stderr)


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

"""Ranges over the seeds of presets, worked out by hand."""

import copy
import json

import pytest
from summaries import SUMMARY

from benchmarks import presets

EXPECTED = """\
|  | `smoke`, 2 seeds | `paper`, 1 seed |
| --- | --- | --- |
| detectors' accuracy | 0.9800 to 0.9995 | 0.9995 |
| cells of Table I, of 9 | 8 to 9 | 8 |
| sigma norm, unambiguous | 0.50 to 1.50 | 0.50 to 1.50 |
| sigma norm, ambiguous | 0.50 to 1.50 | 0.50 to 1.50 |
| fusion accuracy | 0.9996 |  |
| mean NLL over exact Bayes [nats] | 0.0000 to 0.2500 | 0.0000 |
| return, fraction of the optimum | 0.900 to 0.988 | 0.988 |
| start states within 0.01 of optimal | 1700 | 1700 |
| `latent`: right | 0.9980 | 0.9980 |
| `latent`: looks per PoI | 1.68 | 1.68 |
| `latent`: median time [s] | 12.1 to 13.8 | 13.8 |
| `latent`: mean time [s] | 14.5 | 14.5 |
| `latent`: collisions | 0 to 3 | 0 |
| `naive`: right | 0.9980 |  |
| `naive`: looks per PoI | 2.00 |  |
| `naive`: median time [s] | 13.8 |  |
| `naive`: mean time [s] | 14.5 |  |
| `naive`: collisions | 0 |  |
"""


@pytest.fixture
def runs(tmp_path):
    """Two seeds of one preset, and a run of one sensor of another one."""
    first, second, other = (copy.deepcopy(SUMMARY) for _ in range(3))
    second["detectors"]["lidar"]["accuracy"] = 0.98
    # Of Table I, LiDAR distinguishes only the third class.
    second["jmvae"]["unambiguous"]["lidar"] = [False, False, True]
    # Differences 0 and .5 after one and two looks.
    second["belief"]["nll"] = [1, 2.5]
    second["dqn"]["camera"]["fraction_of_optimal"] = 0.9
    latent = second["mission"]["latent"]
    second["mission"]["naive"] = {**latent, "observations_per_poi": 2.0}
    latent |= {"time_s": 12.06, "collisions": 3}
    other["preset"] = "paper"
    other["jmvae"]["fusion"] = dict.fromkeys(other["jmvae"]["fusion"])
    paths = [tmp_path / name for name in ("first", "second", "other")]
    for path, content in zip(paths, (first, second, other), strict=True):
        path.mkdir()
        (path / "summary.json").write_text(json.dumps(content))
    return list(map(str, paths))


def test_a_table_shows_ranges_over_seeds(runs, capsys):
    presets.main(runs)
    assert capsys.readouterr().out == EXPECTED

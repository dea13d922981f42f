"""Several seeds, and several settings, in one program."""

import dataclasses
import json
import re
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import evaluate, sweep, train
from jaxsense.config import PRESETS, ConfigError, DetectorConfig, JmvaeConfig
from jaxsense.learning import learn_perception
from jaxsense.sim import make_world

TINY = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(num_scans=96, num_held_out=48, steps=20, batch=32),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=32, steps=40, batch=32),
)


def test_settings_vary_in_one_program_as_they_do_in_several():
    world = make_world(TINY)

    def learn(key, alpha):
        return learn_perception(key, sweep.vary(TINY, {"jmvae.alpha": alpha}), world).params

    keys = jax.random.split(jax.random.key(0))
    together = jax.jit(jax.vmap(learn))(keys, jnp.array([0.1, 2.0]))
    settings = dataclasses.replace(TINY.jmvae, alpha=2.0)
    config = dataclasses.replace(TINY, jmvae=settings)
    alone = jax.jit(lambda key: learn_perception(key, config, world).params)(keys[1])
    chex.assert_trees_all_close(jax.tree.map(lambda x: x[1], together), alone, atol=1e-3)
    differ = jax.tree.map(lambda x: np.abs(x[0] - x[1]).max(), together)
    assert max(jax.tree.leaves(differ)) > 0.1
    assert TINY.jmvae.alpha == PRESETS["smoke"].jmvae.alpha


@pytest.mark.slow  # compiles what the test above does; before a release
def test_the_example_of_the_documentation_runs(monkeypatch, capsys):
    page = (Path(__file__).parents[1] / "docs" / "getting-started.md").read_text()
    example, *_ = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.setitem(PRESETS, "smoke", TINY)
    exec(compile(example, "getting-started.md", "exec"), {})
    assert capsys.readouterr().out == "(3, 2)\n"


@pytest.mark.parametrize("name", sweep.VARIABLE)
def test_every_setting_that_varies_is_there(name):
    section, field = name.split(".")
    changed = sweep.vary(TINY, {name: jnp.float32(0.25)})
    assert getattr(getattr(changed, section), field) == 0.25
    assert getattr(getattr(TINY, section), field) != 0.25


def test_a_setting_that_cannot_vary_is_named():
    with pytest.raises(ConfigError, match=r"dqn.epochs = 3: cannot be varied .* jmvae.alpha"):
        sweep.vary(TINY, {"dqn.epochs": 3})


def test_statistics_are_those_of_student():
    # The mean of 1 and 3 is 2, its standard error 1, and t(.975, 1 degree of freedom) 12.706.
    found = sweep.statistics(
        [{"a": {"b": 1}, "c": [5.0, None], "d": "x"}, {"a": {"b": 3}, "c": [5.0, 1.0], "d": "y"}]
    )
    assert found["a"]["b"] == pytest.approx({"mean": 2.0, "low": -10.706, "high": 14.706}, abs=1e-3)
    assert found["c"] == [{"mean": 5.0, "low": 5.0, "high": 5.0}, None]
    assert "d" not in found


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "seeds"
    options = ["--preset", "smoke", "--num-seeds", "2", "--seed", "3", "--cache", "None", "--quiet"]
    train.main([*options, "--out", str(path)])
    return path


def test_each_seed_leaves_a_run(seeds, capsys):
    summary = json.loads((seeds / "summary.json").read_text())
    each = [json.loads((seeds / f"seed-{s}" / "summary.json").read_text()) for s in (3, 4)]
    accuracy = [s["detectors"]["lidar"]["accuracy"] for s in each]
    assert accuracy[0] != accuracy[1]
    assert summary["detectors"]["lidar"]["accuracy"]["mean"] == pytest.approx(np.mean(accuracy))
    assert summary["seeds"]["4"]["dqn"] == each[1]["dqn"]
    assert set(each[0]) == {
        "preset", "seed", "versions", "devices", "timing", "detectors", "jmvae", "dqn",
        "mission",
    }  # fmt: skip
    assert (each[1]["seed"], each[1]["dqn"]["camera"]["num_states"]) == (4, 384)
    config, models = jaxsense.load(seeds / "seed-4")
    assert config == PRESETS["smoke"]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(models))
    with pytest.raises(SystemExit):
        evaluate.main([str(seeds)])
    assert "holds several seeds; choose one" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--num-seeds", "0"], "num_seeds = 0: must be greater than 0"),
        (["--num-seeds", "2", "--seed", str(2**32 - 1)], "num_seeds = 2: leads beyond seed 2^32"),
        (["--num-seeds", "2", "--devices", "2"], "devices = 2: cannot be chosen for several seeds"),
    ],
)
def test_several_seeds_that_cannot_be_are_named(options, expected, capsys):
    with pytest.raises(SystemExit) as stop:
        train.main(options)
    assert stop.value.code == 2
    assert expected in capsys.readouterr().err

"""Several seeds, and several settings, in one program."""

import dataclasses
import re
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sweep
from jaxsense.config import PRESETS, ConfigError, DetectorConfig, JmvaeConfig
from jaxsense.learning import learn_perception
from jaxsense.sim import make_world

TINY = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(num_scans=96, num_held_out=48, steps=20, batch=32),
    jmvae=JmvaeConfig(restarts=1, samples_per_class=32, steps=40, batch=32),
)


@pytest.mark.slow  # with simulated scans; `test_sweep_variables.py` has all settings
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
    assert sweep.statistics([{"a": 3.0}]) == {"a": {"mean": 3.0, "low": 3.0, "high": 3.0}}

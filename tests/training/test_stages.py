"""The list of stages: `learn` and a run are the same training."""

import dataclasses
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY

import jaxsense
from jaxsense import training
from jaxsense.run import loop, pipeline
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs
from jaxsense.training import learn


@pytest.mark.slow  # compiles everything twice; `test_examples.py` runs `learn` up to the values
@pytest.mark.parametrize("observe", ["bank", "live"])
def test_learn_and_a_run_come_to_the_same(observe, monkeypatch):
    monkeypatch.setattr(Programs, "_compile_missions", lambda programs: None)
    config = dataclasses.replace(TINY, dqn=dataclasses.replace(TINY.dqn, observe=observe))
    monitor = Monitor()
    with pipeline.compiled(config, monitor) as programs:
        found = loop.train(KEY, config, programs, monitor)
    # A few steps, after which rounding has not yet made learning part ways.
    learned = jax.jit(lambda key: learn(key, config))(KEY)
    assert bool(learned.is_finite)
    assert set(learned.outputs) - set(found.outputs) == {"scenes", "survey", "examples"}
    close = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-3)  # noqa: E731
    of_learn, of_run = (
        training.stages.models(outputs, config) for outputs in (learned.outputs, found.outputs)
    )
    jax.tree.map(close, of_learn, of_run)
    steps = {stage.name: stage.steps for stage in programs.stages}
    for name, progress in learned.progress.items():
        assert len(progress.loss) == steps[name]
        for metric, values in progress.metrics.items():
            close(values, found.curves[name][metric])


@pytest.mark.slow
def test_learn_stops_after_the_stage_that_is_named():
    names = [stage.name for stage in training.stages.stages(TINY)]
    shapes = jax.eval_shape(lambda: learn(KEY, TINY, until="best_jmvae"))
    assert set(shapes.outputs) == set(names[: names.index("best_jmvae") + 1])
    with pytest.raises(ValueError, match=r"until = 'vae': must be one of scenes, survey"):
        learn(KEY, TINY, until="vae")


@pytest.mark.slow  # with simulated scans; `test_traced_settings.py` has all settings
def test_settings_vary_in_one_program_as_they_do_in_several():
    config = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, steps=5))

    def params(key, alpha):
        varied = dataclasses.replace(config, jmvae=dataclasses.replace(config.jmvae, alpha=alpha))
        return learn(key, varied, until="best_jmvae").outputs["best_jmvae"]

    keys = jax.random.split(jax.random.key(0))
    together = jax.jit(jax.vmap(params))(keys, jnp.array([0.1, 2.0]))
    alone = jax.jit(lambda key: params(key, 2.0))(keys[1])
    close = lambda x, y: np.testing.assert_allclose(x[1], y, atol=1e-4)  # noqa: E731
    jax.tree.map(close, together, alone)


@pytest.mark.slow  # compiles three trainings at once; before a release
def test_the_example_of_the_documentation_runs(monkeypatch, capsys):
    page = (Path(__file__).parents[2] / "docs" / "getting-started.md").read_text()
    (example,) = re.findall(r"```python\n(.*?jaxsense\.learn\(.*?)```", page, re.DOTALL)
    monkeypatch.setattr(jaxsense, "PRESETS", {"smoke": TINY})
    exec(compile(example, "getting-started.md", "exec"), {})
    assert len(json.loads(capsys.readouterr().out.replace(" ", ","))) == 3

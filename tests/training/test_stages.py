"""The list of stages: `learn` and a run are the same training."""

import dataclasses

import jax
import numpy as np
import pytest
from tiny import KEY, TINY

from jaxsense import training
from jaxsense.run import pipeline
from jaxsense.run.compilation import Compiler
from jaxsense.run.files import Checkpoints
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs
from jaxsense.training import learn


@pytest.mark.slow  # compiles everything twice; `test_examples.py` runs `learn` up to the values
def test_learn_and_a_run_come_to_the_same(monkeypatch, tmp_path):
    monkeypatch.setattr(Programs, "_compile_missions", lambda programs: None)
    config = dataclasses.replace(TINY, dqn=dataclasses.replace(TINY.dqn, observe="bank"))
    monitor = Monitor()
    with Compiler(monitor) as compiler:
        programs = Programs(config, compiler)
        outputs, curves = pipeline.train(KEY, programs, Checkpoints(tmp_path))
    # A few steps, after which rounding has not yet made learning part ways.
    learned = jax.jit(lambda key: learn(key, config))(KEY)
    assert bool(learned.is_finite)
    assert set(learned.outputs) - set(outputs) == {"scenes", "survey", "examples"}
    close = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-3)  # noqa: E731
    of_learn, of_run = (training.stages.models(each, config) for each in (learned.outputs, outputs))
    jax.tree.map(close, of_learn, of_run)
    steps = {stage.name: stage.steps for stage in programs.stages}
    for name, progress in learned.progress.items():
        assert len(progress.loss) == steps[name]
        for metric, values in progress.metrics.items():
            close(values, curves[name][metric])

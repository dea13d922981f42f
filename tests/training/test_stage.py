"""A stage: its keys and chunks, and how a training and a run execute it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, stage_of

from jaxsense import training
from jaxsense.run import pipeline
from jaxsense.run.compilation import Compiler
from jaxsense.run.files import Checkpoints
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs
from jaxsense.training import learn
from jaxsense.training.stage import Progress, Stage, key_of, scan


@pytest.mark.parametrize(
    ("steps", "expected"),
    [(300, (20, 15)), (7, (7, 1)), (1, (1, 1)), (4001, (20, 201)), (23, (12, 2))],
)
def test_steps_are_cut_into_chunks_also_if_their_number_is_prime(steps, expected):
    config = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, steps=steps))
    stage = stage_of("detector_camera", config)
    size = -(-steps // stage.chunks)
    assert (stage.chunks, size) == expected
    assert (stage.chunks - 1) * size < stage.steps <= stage.chunks * size


def data(keys):
    return [tuple(jax.random.key_data(key).tolist()) for key in keys]


def test_keys_follow_from_the_names_of_stages_alone():
    more = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, restarts=5))
    few, many = (
        {s.name: data([s.key(KEY), *s.chunk_keys(KEY)]) for s in training.stages.stages(c)}
        for c in (TINY, more)
    )
    assert all(many[name] == keys for name, keys in few.items())
    used = [key for keys in few.values() for key in keys] + data([key_of(KEY, "mission")])
    assert len(set(used)) == len(used)


def begin(value):
    """`begin` of a stage whose output is a number."""
    return lambda key, config: jnp.float32(value)


def steps_of(name, losses, *, is_optional=False, output=0.0):
    """A stage of five steps in three chunks, the last step of which is none."""

    def advance(key, config, state):
        chunk = jax.lax.dynamic_slice(jnp.array(losses), (2 * state,), (2,))
        return state + 1, Progress(chunk, {"twice": 2 * chunk})

    def finish(config, state):
        return state + jnp.float32(output)

    return Stage(name, lambda key, config: jnp.int32(0), advance, finish, 5, 3, is_optional)


def test_chunks_are_put_together_and_end_with_the_last_step():
    output, progress = scan(KEY, TINY, steps_of("s", [1.0, 2.0, 3.0, 4.0, 5.0, np.nan]), {})
    assert progress is not None
    np.testing.assert_array_equal(progress.loss, [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(progress.metrics["twice"], [2, 4, 6, 8, 10])
    assert output == 3  # chunks


@pytest.mark.parametrize("is_optional", [False, True])
@pytest.mark.parametrize("wrong", [None, "loss", "output"])
def test_optional_stages_may_diverge_and_no_others(is_optional, wrong, monkeypatch):
    losses = [1.0, 2.0, np.nan if wrong == "loss" else 3.0, 4.0, 5.0, 6.0]
    output = np.inf if wrong == "output" else 0.0

    def train(drive, config):
        drive(Stage("before", begin(1)))
        drive(steps_of("s", losses, is_optional=is_optional, output=output))
        drive(Stage("after", begin(2)))

    monkeypatch.setattr(training.stages, "train", train)
    found = learn(KEY, TINY)
    assert bool(found.is_finite) == (is_optional or wrong is None)
    assert set(found.outputs) == {"before", "s", "after"}
    assert set(found.progress) == {"s"}


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

"""The list of stages: `learn` and a run are the same training."""

import dataclasses
import functools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, inputs_of

import jaxsense
from jaxsense import training
from jaxsense.run import loop, pipeline
from jaxsense.run.monitor import Monitor
from jaxsense.run.programs import Programs
from jaxsense.training import learn

TOLERANCE = 1e-5


def with_observe(way):
    return dataclasses.replace(TINY, dqn=dataclasses.replace(TINY.dqn, observe=way))


# Both compile everything twice, for a minute; `test_examples.py` runs `learn` up to the policies,
# and `test_train.py` a run.
@pytest.fixture(
    scope="module", params=[pytest.param(way, marks=pytest.mark.slow) for way in ("bank", "live")]
)
def trained(request):
    """The programs of a run, and what they have trained."""
    monitor = Monitor()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Programs, "_compile_missions", lambda programs: None)  # none is played
        with pipeline.compiled(with_observe(request.param), monitor) as programs:
            # A run lets go of what no later stage needs; here, every output is compared.
            patch.setattr(loop, "_ONLY_PASSED_ON", ())
            yield programs, loop.train(KEY, programs.config, programs, monitor)


def first_chunk(stage, begin_key, chunk_key, config, inputs):
    """What `learn` does of a stage at first."""
    state = stage.begin(begin_key, config, **inputs)
    if not stage.chunks:
        return state
    return jax.lax.scan(
        lambda state, key: stage.advance(key, config, state, **inputs), state, chunk_key[None]
    )


def test_every_stage_of_learn_is_that_of_a_run(trained):
    programs, found = trained
    keys, config, together = jnp.stack([KEY, jax.random.key(8)]), programs.config, {}
    for stage in programs.stages:
        inputs = inputs_of(stage.name, config, found.outputs)
        compiled = programs.of(stage)
        begin_keys, chunk_keys = jax.vmap(stage.key)(keys), keys
        if stage.name == "survey":
            inputs = jax.tree.map(lambda x: x[:2], inputs)
            of_run = jax.tree.map(lambda x: x[:2], found.outputs[stage.name].training)
        elif stage.chunks:
            chunk_keys = jax.vmap(stage.chunk_keys)(keys)[:, 0]
            state = compiled.begin(begin_keys[0], config, inputs)
            of_run = compiled.advance(chunk_keys[0], config, state, inputs)
            of_run = of_run[0], jax.tree.map(lambda x: np.asarray(x)[None], of_run[1])
        else:
            of_run = found.outputs[stage.name]
        # Stages that share their programs have the same functions.
        of_stage = functools.partial(first_chunk, stage)
        together.setdefault(compiled, jax.jit(jax.vmap(of_stage, (0, 0, None, None))))
        both = together[compiled](begin_keys, chunk_keys, config, inputs)
        of_learn = jax.tree.map(lambda x: x[0], both)
        for pair in zip(jax.tree.leaves(of_learn), jax.tree.leaves(of_run), strict=True):
            here, there = map(as_numbers, pair)
            # Relative to the size of the array: a number that is nearly zero has no digits, nor has
            # a mean difference of logarithms.
            scale = np.abs(there[np.isfinite(there)]).max(initial=0)
            least = max(TOLERANCE * scale, np.finfo(np.float32).eps)
            np.testing.assert_allclose(here, there, rtol=TOLERANCE, atol=least, err_msg=stage.name)


def as_numbers(x):
    is_key = jnp.issubdtype(jnp.asarray(x).dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x)


@pytest.mark.slow  # compiles everything twice
def test_learn_and_a_run_come_to_the_same(trained):
    programs, found = trained
    # A few steps, after which rounding has not yet made learning part ways.
    learned = jax.jit(lambda key: learn(key, programs.config))(KEY)
    assert bool(learned.is_finite)
    close = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-3)  # noqa: E731
    of_learn, of_run = (
        training.stages.models(outputs, programs.config)
        for outputs in (learned.outputs, found.outputs)
    )
    jax.tree.map(close, of_learn, of_run)
    for name, progress in learned.progress.items():
        assert len(progress.loss) == next(s.steps for s in programs.stages if s.name == name)
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

"""The stages of a training, driven from the host."""

import gc
import tempfile
import time
import weakref
from pathlib import Path
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import PRESETS
from jaxsense.run import devices, pipeline
from jaxsense.run.compilation import Compiler
from jaxsense.run.files import Checkpoints
from jaxsense.run.monitor import Monitor, StageError, Stopped
from jaxsense.run.programs import Programs
from jaxsense.training import stages
from jaxsense.training.stage import Progress, Stage

SMOKE, KEY = PRESETS["smoke"], jax.random.key(0)


@pytest.fixture
def collect():
    """Collects garbage, but none from before the test: a worker holds gigabytes of programs."""
    gc.freeze()
    yield gc.collect
    gc.unfreeze()


@pytest.fixture
def replace_training(monkeypatch):
    """Replaces the training of a run by some calls of `drive`, without missions."""
    monkeypatch.setattr(Programs, "_compile_missions", lambda programs: None)

    def replace(toy_training):
        train = lambda drive, config: toy_training(drive)  # noqa: E731
        monkeypatch.setattr(stages, "train", train)

    return replace


@pytest.fixture
def toy(replace_training, tmp_path):
    """Trains toy stages: their programs are compiled as those of a run."""

    def train(toy_training, saved=False):
        replace_training(toy_training)
        heard, warned = [], []
        monitor = Monitor(lambda *report: heard.append(report), warned.append)
        path = tmp_path if saved else Path(tempfile.mkdtemp(dir=tmp_path))
        checkpoints = Checkpoints(path)
        with Compiler(monitor) as compiler:
            outputs, curves = pipeline.train(KEY, Programs(SMOKE, compiler), checkpoints)
        found = SimpleNamespace(outputs=outputs, curves=curves)
        return found, [report for report in heard if report[2]], warned

    return train


def counting(name, bad_from=jnp.inf, bad=jnp.nan, **settings):
    """A stage of 5 steps in 3 chunks whose state counts them, with a loss of 10 less that."""

    def begin(key, config):
        return jnp.zeros(2)

    def advance(key, config, state):
        steps = state[0] + 1 + jnp.arange(2)
        loss = jnp.where(steps >= bad_from, bad, 10 - steps)
        metrics = {"double": jnp.where(steps == 2, jnp.nan, 2 * steps)}
        return jnp.where(steps[-1] < bad_from, state + 2, jnp.nan), Progress(loss, metrics)

    return Stage(name, begin, advance, steps=5, chunks=3, **settings)


def count(drive):
    """The smallest training."""
    drive(counting("count"))


def test_a_stage_reports_its_steps_and_none_beyond_the_last(toy):
    found, heard, _ = toy(count)
    np.testing.assert_array_equal(found.outputs["count"], [6, 6])
    assert [report[:3] for report in heard] == [("count", n, 5) for n in (2, 4, 5)]
    # Steps 1 and 2, of which the second has no metric; 3 and 4; 5 alone.
    assert [report[3] for report in heard] == [
        {"loss": 8.5, "double": 2.0}, {"loss": 6.5, "double": 7.0}, {"loss": 5.0, "double": 10.0},
    ]  # fmt: skip
    curves = found.curves["count"]
    np.testing.assert_array_equal(curves["double"], [2, np.nan, 6, 8, 10])
    assert len(curves["seconds"]) == 3
    assert all(0 < seconds < 100 for seconds in curves["seconds"])


def test_a_program_that_cannot_be_traced_ends_the_run_with_its_error(toy):
    def broken(key, config, x):
        raise ArithmeticError("no such policy")

    with pytest.raises(ArithmeticError, match="no such policy"):
        toy(lambda drive: drive(Stage("broken", broken), x=drive(counting("count"))))


def test_stages_are_given_what_those_before_return(toy):
    def train(drive):
        double = drive(Stage("double", lambda key, config, x: 2 * x), x=drive(counting("count")))
        more = drive(Stage("more", lambda key, config, x: {"y": x + 1}), x=double)
        both = Stage("both", lambda key, config, xs, n: n * xs[0] + xs[1]["y"])
        drive(both, xs=(double, more), n=jnp.int32(3))

    found, _, _ = toy(train)
    np.testing.assert_array_equal(found.outputs["more"]["y"], [13, 13])
    # 3 * 12 + 13
    np.testing.assert_array_equal(found.outputs["both"], [49, 49])


def test_what_is_only_passed_on_is_held_no_longer_than_it_is_needed(toy, collect, monkeypatch):
    def train(drive):
        x = drive(Stage("scenes", lambda key, config: jnp.ones(3)))
        for name in ("second", "third", "fourth"):
            x = drive(Stage(name, lambda key, config, x: 2 * x), x=x)

    begun, alive, begin = {}, {}, pipeline._Training._begin

    def watched(self, stage, inputs):
        for _ in range(50):  # it takes a moment until it is noticed that a stage is done
            collect()
            alive[stage.name] = [name for name, output in begun.items() if output() is not None]
            if len(alive[stage.name]) < 3:
                break
            time.sleep(0.02)
        output = begin(self, stage, inputs)
        begun[stage.name] = weakref.ref(output)
        return output

    monkeypatch.setattr(pipeline._Training, "_begin", watched)
    found, _, _ = toy(train)
    assert alive["second"] == ["scenes"]
    assert alive["fourth"] == ["second", "third"]
    assert [*found.outputs] == ["second", "third", "fourth"]
    np.testing.assert_array_equal(found.outputs["fourth"], [8, 8, 8])


def test_programs_are_let_go_of_once_no_training_needs_them(collect, replace_training, tmp_path):
    # Stages of one kind share their programs.
    names = "dqn_camera", "dqn_lidar"
    kinds = [*(counting(name, shares="dqn") for name in names), counting("count")]
    replace_training(lambda drive: [drive(stage) for stage in kinds])
    monitor = Monitor()
    with Compiler(monitor) as compiler:
        compiled = Programs(SMOKE, compiler, trainings=2)
        shared = compiled.of(kinds[0])
        assert shared is compiled.of(kinds[1])
        every = [shared.advance, compiled.of(kinds[2]).finish]
        alive = [weakref.ref(program.wait()) for program in every]
        del shared, every
        pipeline.train(KEY, compiled, Checkpoints(tmp_path / "first"))
        assert all(program() is not None for program in alive)
        pipeline.train(KEY, compiled, Checkpoints(tmp_path / "second"))
        collect()
        assert all(program() is None for program in alive)


@pytest.mark.parametrize("number", [3, 512, 513, 1300])
def test_rows_are_the_same_in_parts(toy, monkeypatch, number):
    parts, side_by_side = [], devices.side_by_side

    def counted(function, works, *rest):
        parts.append(len(works))
        return side_by_side(function, works, *rest)

    monkeypatch.setattr(devices, "side_by_side", counted)
    monkeypatch.setattr(pipeline, "_ONLY_PASSED_ON", ())
    first = Stage("first", lambda key, config: jnp.arange(2.0 * number).reshape(number, 2))
    survey = Stage("survey", lambda key, config, x: (x + 1, x.sum(axis=1)))
    found, _, _ = toy(lambda drive: drive(survey, x=drive(first)))
    x = np.arange(2.0 * number).reshape(number, 2)
    np.testing.assert_array_equal(found.outputs["survey"][0], x + 1)
    np.testing.assert_array_equal(found.outputs["survey"][1], x.sum(axis=1))
    assert parts == [-(-number // 512)]


def test_what_was_saved_is_not_trained_again(toy):
    first, heard, _ = toy(count, saved=True)
    assert heard
    again, heard, _ = toy(count, saved=True)
    assert not heard
    np.testing.assert_array_equal(first.outputs["count"], again.outputs["count"])
    np.testing.assert_array_equal(first.curves["count"]["double"], again.curves["count"]["double"])


@pytest.mark.parametrize("bad", [(), (0,), (1,)])
def test_an_optional_training_that_is_not_finite_is_left_out_and_named(toy, bad):
    def finish(config, state):
        return state[0]

    trials = [
        counting(f"trial_{i}", 4 if i in bad else jnp.inf, is_optional=True, finish=finish)
        for i in range(2)
    ]
    best = Stage("best", lambda key, config, x: jnp.nanmin(jnp.stack(x)))
    train = lambda drive: drive(best, x=tuple(map(drive, trials)))  # noqa: E731
    found, _, warned = toy(train, saved=True)
    assert warned == [f"trial_{i}: results are not finite: left out" for i in bad]
    assert found.outputs["best"] == 6
    assert [bool(np.isnan(found.outputs[f"trial_{i}"])) for i in range(2)] == [
        i in bad for i in range(2)
    ]


def test_a_training_ends_if_what_comes_of_optional_ones_is_not_finite(toy):
    trial = counting("trial", 4, is_optional=True)
    with pytest.raises(StageError, match="best: results are not finite"):
        toy(lambda drive: drive(Stage("best", lambda key, config, x: x), x=drive(trial)))


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
def test_a_training_that_is_not_finite_ends_what_follows_from_it(toy, bad):
    def train(drive):
        drive(Stage("follows", lambda key, config, x: x), x=drive(counting("count", 4, bad)))
        drive(counting("beside"))

    with pytest.raises(StageError, match=f"count: loss = {bad} at step 4 of 5"):
        toy(train)


def test_an_error_of_any_kind_stops_the_other_stages(toy, monkeypatch):
    begin = pipeline._Training._begin

    def fails_or_waits(self, stage, inputs):
        if stage.name == "full":
            raise OSError(28, "No space left on device")
        for _ in range(1000):
            if self.programs.monitor.is_stopping:
                return begin(self, stage, inputs)
            time.sleep(0.01)
        raise AssertionError("it was not stopped")

    monkeypatch.setattr(pipeline._Training, "_begin", fails_or_waits)
    with pytest.raises(OSError, match="No space left"):
        toy(lambda drive: (count(drive), drive(Stage("full", lambda key, config: jnp.zeros(2)))))


def curves(chunks, done=0):
    """Chunks count themselves, and take a second."""
    count = np.arange(chunks, dtype=np.float32)
    found = {"chunk": count, "seconds": np.ones_like(count)}
    return {name: np.where(count < done, x, np.nan) for name, x in found.items()}


def go_on(path, chunks, run, monitor=None):
    """Runs a training whose state and metric count its chunks."""

    def counted(chunk, state):
        run(chunk)
        return state + 1, {"chunk": [chunk], "seconds": [1.0]}

    stage = Stage("jmvae", lambda key, config: (), steps=chunks, chunks=chunks)
    of = lambda stage: SimpleNamespace(metrics=("chunk",))  # noqa: E731
    programs = SimpleNamespace(monitor=monitor or Monitor(), of=of)
    training = pipeline._Training(KEY, programs, Checkpoints(path))
    return training._run_chunks(stage, np.float32(0), counted), training.curves["jmvae"]


def check(found, chunks, done):
    """A state and curves are those after some chunks."""
    chex.assert_trees_all_equal(found, (np.float32(done), curves(chunks, done)))


def check_saved(path, chunks, done):
    """A training was saved after some chunks."""
    shapes = {"state": np.float32(0), "curves": curves(chunks)}
    found = Checkpoints(path).load("unfinished/jmvae", shapes)
    check((found["state"], found["curves"]), chunks, done)


def test_a_training_that_fails_keeps_what_was_sound_or_says_that_it_cannot(tmp_path, monkeypatch):
    def run(chunk):
        if chunk == 2:
            raise StageError("jmvae: loss = nan")

    def save(*_):
        raise OSError(28, "No space left")

    with pytest.raises(StageError, match=r"jmvae: loss = nan$"):
        go_on(tmp_path, 4, run)
    check_saved(tmp_path, 4, done=2)
    monkeypatch.setattr(Checkpoints, "save", save)
    with pytest.raises(StageError, match=r"loss = nan; cannot save the last .*No space left"):
        go_on(tmp_path, 4, run)


def test_a_killed_training_loses_no_more_than_a_minute(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(pipeline, "time", SimpleNamespace(monotonic=lambda: clock[0]))

    def run(chunk):
        clock[0] += 25.0
        if chunk == 5:
            raise KeyboardInterrupt

    # Five chunks of 25 s: it is saved after 75 s, and would be after 150 s.
    with pytest.raises(KeyboardInterrupt):
        go_on(tmp_path, 9, run)
    check_saved(tmp_path, 9, done=3)


def test_a_stop_is_heard_after_every_chunk_and_what_is_over_is_saved(tmp_path):
    monitor = Monitor()
    with pytest.raises(Stopped):
        go_on(tmp_path, 4, lambda chunk: chunk == 1 and monitor.stop(), monitor)
    check_saved(tmp_path, 4, done=2)
    chunks, again = [], Monitor()
    last = lambda chunk: (chunks.append(chunk), chunk == 3 and again.stop())  # noqa: E731
    check(go_on(tmp_path, 4, last, again), 4, done=4)
    assert chunks == [2, 3]
    check(go_on(tmp_path, 4, lambda chunk: pytest.fail("trained again")), 4, done=4)


def test_a_training_that_fails_ends_what_goes_on_beside_it(tmp_path):
    monitor = Monitor()
    fail = lambda chunk: monitor.fail(StageError("dqn_lidar: loss = nan"))  # noqa: E731
    with pytest.raises(StageError, match="dqn_lidar"):
        go_on(tmp_path, 9, fail, monitor)
    check_saved(tmp_path, 9, done=1)
    monitor.begin(lambda *_: None)  # the next seed
    monitor.check_stop()

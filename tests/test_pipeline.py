"""How the stages of a run hang together."""

import dataclasses
import types
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import examine, pipeline, programs
from jaxsense.checkpoints import Checkpoints
from jaxsense.chunks import run_chunks
from jaxsense.config import PRESETS, JmvaeConfig
from jaxsense.monitor import Monitor, StageError, Stopped
from jaxsense.programs import best_restart, chunks_of
from jaxsense.training import FitState
from jaxsense.vae import detectors


def test_a_program_that_cannot_be_traced_ends_the_run_with_its_error(monkeypatch):
    def broken(*args, **settings):
        raise ArithmeticError("no such policy")

    monkeypatch.setattr(examine, "latent_space", broken)
    # What compiles longest is traced after the error then.
    monkeypatch.setattr(programs, "_on_cpu", lambda: False)
    config, monitor = PRESETS["smoke"], Monitor()
    with (
        pytest.raises(ArithmeticError, match="no such policy"),
        pipeline.compiled(config, monitor) as compiled,
    ):
        pipeline.run(jax.random.key(0), config, compiled, monitor)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        (300, (20, 15)),
        (4000, (20, 200)),
        (7, (7, 1)),
        (1, (1, 1)),
        (4001, (20, 201)),
        (23, (12, 2)),
    ],
)
def test_steps_are_cut_into_chunks_also_if_their_number_is_prime(steps, expected):
    number, size = chunks_of(steps)
    assert (number, size) == expected
    assert (number - 1) * size < steps <= number * size


def test_the_last_chunk_makes_no_step_too_many():
    config = dataclasses.replace(PRESETS["smoke"].detector, hidden=(3,), steps=5, batch=4)
    windows, labels = jnp.arange(12.0).reshape(6, 2), jnp.array([0, 1, 0, 1, 1, 0])
    detector = detectors.init(jax.random.key(0), windows, 2, config)

    @jax.jit
    def train(key, state):
        return detectors.train(key, state, detector, windows, labels, config, 2)

    states = [detectors.start(detector, config)]
    for i in range(3):
        states.append(train(jax.random.key(i), states[-1])[0])
    assert [int(state.step) for state in states] == [0, 2, 4, 5]
    # The same by two chunks, and by one of a single step.
    one = detectors.train(jax.random.key(2), states[2], detector, windows, labels, config, 2)[0]
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5), one, states[3])
    moved = jax.tree.map(lambda x, y: np.abs(x - y).max(), states[3].params, states[2].params)
    assert max(jax.tree.leaves(moved)) > 0


def test_the_restart_with_the_lowest_losses_at_the_end_is_kept():
    settings = JmvaeConfig(steps=40)  # the last 2 steps count
    losses = np.ones((3, 40), np.float32)
    losses[1, :38], losses[2, 38:] = 0.0, 0.5
    assert best_restart(losses, settings) == 2
    losses[2, 39] = np.nan
    losses[0, 38:] = 0.9
    assert best_restart(losses, settings) == 0


def test_a_training_that_fails_keeps_what_was_sound(tmp_path):
    checkpoints, monitor = Checkpoints(tmp_path), Monitor()

    def run(chunk, state):
        monitor.report("jmvae", chunk + 1, 4, np.array([np.nan if chunk == 2 else 1.0]))
        return {"x": state["x"] + 1}, {"chunk": [chunk]}

    start = {"x": np.zeros(2, np.float32)}
    with pytest.raises(StageError, match="jmvae: loss = nan at step 3 of 4"):
        run_chunks("jmvae", start, 4, run, monitor, checkpoints)
    done, state, curves = checkpoints.load_unfinished("jmvae", start)
    assert (done, curves) == (2, {"chunk": [0, 1]})
    np.testing.assert_array_equal(state["x"], [2, 2])


def test_a_stop_is_heard_after_every_chunk(tmp_path):
    checkpoints, monitor = Checkpoints(tmp_path), Monitor()

    def run(chunk, state):
        if chunk == 1:
            monitor.stop()
        return state + 1, {}

    with pytest.raises(Stopped):
        run_chunks("jmvae", np.float32(0), 4, run, monitor, checkpoints)
    assert checkpoints.load_unfinished("jmvae", np.float32(0))[:2] == (2, 2.0)


def test_a_training_that_is_over_is_saved_when_another_one_stops(tmp_path):
    checkpoints, monitor = Checkpoints(tmp_path), Monitor()
    monitor.stop()
    state, curves = run_chunks(
        "camera", np.float32(0), 1, lambda i, x: (x + 1, {"i": [i]}), monitor, checkpoints
    )
    assert (state, curves) == (1, {"i": [0]})

    def never(chunk, state):
        raise AssertionError("trained again")

    again = run_chunks("camera", np.float32(0), 1, never, Monitor(), checkpoints)
    assert again == (1, {"i": [0]})


@pytest.fixture
def two_restarts(tmp_path):
    """Trains two JMVAEs whose losses fall with every chunk; `bad` are NaN from the third one on."""

    def train(bad):
        settings = dataclasses.replace(PRESETS["smoke"].jmvae, restarts=2, steps=40)
        config = dataclasses.replace(PRESETS["smoke"], jmvae=settings)
        begun = iter(range(2))

        def begin(key):
            return FitState({"w": np.full(2, next(begun), np.float32)}, (), np.int32(0))

        def step(key, state, bank):
            restart, after = int(state.params["w"][0]), state.step + 2
            value = np.nan if restart in bad and after > 4 else 100.0 - restart - after
            params = {"w": np.array([restart, value], np.float32)}
            return FitState(params, (), np.int32(after)), np.full(2, value)

        warned, monitor = [], Monitor()
        monitor.warn = warned.append
        programs = types.SimpleNamespace(begin_jmvae=begin, train_jmvae=step)
        with ThreadPoolExecutor(1) as saver:
            stages = pipeline.Stages(config, programs, monitor, Checkpoints(tmp_path), saver)
            return stages.train_jmvae(jax.random.key(0), ()), warned

    return train


@pytest.mark.parametrize("bad", [(), (0,), (1,)])
def test_a_restart_that_is_not_finite_is_left_out_and_named(two_restarts, bad):
    params, warned = two_restarts(bad)
    best = 0 if bad == (1,) else 1  # the second one has lower losses
    assert params["w"][0] == best
    assert np.isfinite(params["w"]).all()
    assert warned == [f"jmvae: restart {r} is not finite by step 6: left out" for r in bad]


def test_a_training_ends_if_no_restart_is_finite(two_restarts):
    with pytest.raises(StageError, match="jmvae: loss = nan at step 5 of 40"):
        two_restarts((0, 1))


def test_a_training_that_fails_ends_what_goes_on_beside_it(tmp_path):
    checkpoints, monitor = Checkpoints(tmp_path), Monitor()

    def fail(chunk, state):
        raise StageError("dqn_lidar: loss = nan at step 7 of 40")

    def run(chunk, state):
        with pytest.raises(StageError):
            run_chunks("dqn_lidar", np.float32(0), 9, fail, monitor, checkpoints)
        return state + 1, {}

    with pytest.raises(StageError, match="dqn_lidar"):
        run_chunks("dqn_camera", np.float32(0), 9, run, monitor, checkpoints)
    assert checkpoints.load_unfinished("dqn_camera", np.float32(0))[:2] == (1, 1.0)
    monitor.begin(lambda *_: None)  # the next seed
    monitor.check_stop()


def test_nan_on_a_full_disk_tells_of_both(monkeypatch, tmp_path):
    def full(*_):
        raise OSError(28, "No space left on device", "jmvae.msgpack")

    checkpoints = Checkpoints(tmp_path)
    monkeypatch.setattr(checkpoints, "save_unfinished", full)

    def run(chunk, state):
        raise StageError("jmvae: loss = nan at step 1 of 4")

    with pytest.raises(StageError, match=r"nan at step 1 of 4; .* No space left on device"):
        run_chunks("jmvae", np.float32(0), 4, run, Monitor(), checkpoints)

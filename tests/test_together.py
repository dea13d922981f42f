"""Trainings side by side, whose calls of a program are made as one."""

import contextlib
import json
import time
from concurrent.futures import ThreadPoolExecutor, wait
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from jaxsense import train as command
from jaxsense.config import PRESETS
from jaxsense.run import devices, loop, pipeline, programs, together
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.compilation import Compiler, Program
from jaxsense.run.devices import ALONE, Workers
from jaxsense.run.monitor import Monitor, StageError, Stopped
from jaxsense.run.rundir import RunDirectory, Settings
from jaxsense.run.together import SharedProgram, Trainings
from jaxsense.training.stage import Progress, Stage, compose

SMOKE, SCALE = PRESETS["smoke"], np.float32(2)
ROWS = np.arange(10, dtype=np.float32).reshape(5, 2)
PATIENCE = 20.0  # s


class Counted(Program):
    """A program that notes its calls, and how many workers share the rows of one."""

    def __init__(self, compiler):
        super().__init__(compiler, "stage", "run")
        self.calls, self.num_workers = [], 0

    def compile(self, function, *args, workers, **options):
        self.num_workers = workers.number
        return super().compile(function, *args, workers=workers, **options)

    def __call__(self, *args):
        self.calls.append(args)
        return super().__call__(*args)


def scaled(scale, x):
    return {"scaled": scale * x, "sum": x.sum()}


@pytest.fixture
def patient(monkeypatch):
    """Trainings wait for each other for `PATIENCE`, and look every 10 ms for whom to wait."""
    monkeypatch.setattr(together, "_PATIENCE", PATIENCE)
    monkeypatch.setattr(together, "wait", lambda futures, timeout: wait(futures, timeout=0.01))


@pytest.fixture
def shared(patient):
    """Makes a program of `scaled` for trainings."""
    with Compiler(Monitor()) as compiler:

        def make(trainings, workers=ALONE):
            counted = Counted(compiler)
            program = SharedProgram(counted, trainings, workers)
            shapes = program.compile(scaled, SCALE, ROWS[0], whole=(0,))
            assert (shapes["scaled"].shape, shapes["sum"].shape) == ((2,), ())
            program.wait()
            return program, counted

        yield make


def side_by_side(program, rows=ROWS):
    """What threads that each call a program with a row get, or the errors that they hear."""
    with ThreadPoolExecutor(len(rows)) as threads:
        calls = [threads.submit(program, SCALE, row) for row in rows]
    return [call.exception() or call.result() for call in calls]


def check_results(found, rows):
    for output, row in zip(found, rows, strict=True):
        np.testing.assert_array_equal(output["scaled"], 2 * row)
        assert output["sum"] == row.sum()


def test_calls_of_all_trainings_are_made_as_one(shared):
    program, counted = shared(Trainings(3))
    check_results(side_by_side(program, ROWS[:3]), ROWS[:3])
    ((scale, rows),) = counted.calls
    assert scale.shape == ()
    assert sorted(rows.tolist()) == ROWS[:3].tolist()


def test_stages_that_share_a_program_call_it_more_often_than_there_are_trainings(
    shared, monkeypatch
):
    trainings = Trainings(2)
    program, counted = shared(trainings)
    trainings.begin(5)  # so that all five calls wait before one is made
    monkeypatch.setattr(together, "_PATIENCE", 0.5)
    check_results(side_by_side(program), ROWS)
    assert len(counted.calls) >= 3
    assert {rows.shape for _, rows in counted.calls} == {(2, 2)}


@pytest.mark.parametrize("left", ["by one", "by a last group"])
def test_nobody_waits_for_trainings_that_are_over(shared, left):
    trainings = Trainings(2)
    program, counted = shared(trainings)
    if left == "by one":
        trainings.leave()
    else:
        trainings.begin(1)
    begin = time.monotonic()
    check_results(side_by_side(program, ROWS[1:2]), ROWS[1:2])
    assert time.monotonic() - begin < PATIENCE / 2
    ((_, rows),) = counted.calls
    np.testing.assert_array_equal(rows, ROWS[[1, 1]])


def test_a_call_goes_ahead_without_trainings_that_are_late(shared, monkeypatch):
    program, counted = shared(Trainings(2))
    monkeypatch.setattr(together, "_PATIENCE", 0.5)
    begin = time.monotonic()
    check_results(side_by_side(program, ROWS[:1]), ROWS[:1])
    assert time.monotonic() - begin > 0.5
    assert len(counted.calls) == 1


@pytest.mark.parametrize(("number", "expected"), [(4, 2), (3, 1)])
def test_workers_share_trainings_that_divide_evenly(shared, number, expected):
    program, counted = shared(Trainings(number), Workers(threads=2))
    assert counted.num_workers == expected
    check_results(side_by_side(program, ROWS[:number]), ROWS[:number])


def test_every_training_hears_why_there_is_no_program(shared):
    program, _ = shared(Trainings(2))
    program.release()
    errors = side_by_side(program, ROWS[:2])
    assert [str(error) for error in errors] == ["run of stage was released"] * 2
    with Compiler(Monitor()) as compiler:
        broken = SharedProgram(Program(compiler, "stage", "run"), Trainings(2))
        broken.fail(ArithmeticError("no such policy"))
        errors = side_by_side(broken, ROWS[:2])
    assert [str(error) for error in errors] == ["no such policy"] * 2


@pytest.mark.parametrize("where", ["stack", "call", "split"])
def test_an_error_of_a_call_reaches_all_who_made_it(shared, monkeypatch, where):
    program, _ = shared(Trainings(2))

    def full(*_):
        raise MemoryError(where)

    if where == "stack":
        monkeypatch.setattr(jnp, "stack", full)
    elif where == "call":
        monkeypatch.setattr(devices, "joined", full)
    else:
        monkeypatch.setattr(Counted, "__call__", lambda *_: {"scaled": jnp.zeros((1, 2)), "sum": 3})
    errors = side_by_side(program, ROWS[:2])
    assert len(errors) == 2
    assert all(isinstance(error, Exception) for error in errors)
    # The next calls are made without those.
    monkeypatch.undo()
    monkeypatch.setattr(together, "_PATIENCE", PATIENCE)
    check_results(side_by_side(program, ROWS[2:4]), ROWS[2:4])


def walking(name, farthest=np.inf):
    """A stage of 5 steps in 3 chunks, whose loss is NaN once its state is beyond `farthest`."""

    def begin(key, config):
        return jax.random.uniform(key)

    def advance(key, config, state):
        state += jax.random.uniform(key)
        loss = jnp.where(state > farthest, jnp.nan, state)
        return state, Progress(jnp.stack([loss, loss]), {})

    return Stage(name, begin, advance=advance, steps=5, chunks=3, shares="dqn")


@pytest.fixture
def train(monkeypatch, tmp_path):
    """Trains seeds side by side; gives what comes of each, and the steps that it reported."""
    monkeypatch.setattr(programs, "_trace_missions", lambda programs, compiler: None)

    def run(seeds, number=2, farthest=np.inf, stop=None, saved=False):
        # Both agents of a training call the same programs.
        stages = [walking("dqn_camera", farthest), walking("dqn_lidar", farthest)]
        monkeypatch.setattr(programs, "stages", lambda config: stages)
        monitor, steps = Monitor(), {seed: [] for seed in seeds}
        trainings = Trainings(number, total=len(seeds))

        def of_seed(seed):
            def listen(stage, done, total, metrics):
                if metrics:
                    steps[seed].append((stage, done))
                if (seed, stage, done) == stop:
                    monitor.stop()

            checkpoints = Checkpoints(tmp_path / str(seed) if saved else None, pytest.fail)
            try:
                own = monitor.beside(listen)
                return loop.train(jax.random.key(seed), SMOKE, compiled, own, checkpoints).outputs
            except (StageError, Stopped) as error:
                return error
            finally:
                trainings.leave()

        with pipeline.compiled(SMOKE, monitor, trainings=trainings) as compiled:
            trainings.begin(len(seeds))
            found = devices.side_by_side(lambda i: of_seed(seeds[i]), len(seeds))
            with pytest.raises(RuntimeError, match="advance of dqn was released"):
                compiled.of(stages[0]).advance.wait()
        return dict(zip(seeds, found, strict=True)), steps

    return run


@pytest.fixture
def alone(train):
    """What comes of three seeds one by one."""
    return {seed: train([seed], number=1)[0][seed] for seed in (0, 1, 2)}


EVERY = [(stage, done) for stage in ("dqn_camera", "dqn_lidar") for done in (2, 4, 5)]


def test_trainings_side_by_side_are_those_alone(train, alone):
    found, steps = train([0, 1, 2], number=3)
    assert found == alone
    assert len({output["dqn_camera"].item() for output in found.values()}) == 3
    assert [sorted(each) for each in steps.values()] == [EVERY] * 3


def test_a_training_that_fails_leaves_those_side_by_side(train, alone):
    reached = {seed: max(outputs.values()).item() for seed, outputs in alone.items()}
    *others, failing = sorted(reached, key=lambda seed: reached[seed])
    farthest = (reached[others[-1]] + reached[failing]) / 2
    found, steps = train([0, 1, 2], number=3, farthest=farthest)
    assert "loss = nan at step" in str(found[failing])
    for seed in others:
        assert found[seed] == alone[seed]
        assert sorted(steps[seed]) == EVERY


@pytest.mark.parametrize("stop", [(1, "dqn_lidar", 2), (1, "dqn_camera", 4)])
def test_trainings_that_stop_side_by_side_go_on_where_they_were(train, alone, stop):
    stopped, before = train([0, 1], stop=stop, saved=True)
    assert isinstance(stopped[1], Stopped)
    found, after = train([0, 1], saved=True)
    assert found == {seed: alone[seed] for seed in (0, 1)}
    for seed in (0, 1):
        # No step is trained twice or left out.
        assert sorted([*before[seed], *after[seed]]) == EVERY
    assert stop in [(1, *step) for step in before[1]]
    assert len(after[1]) > 0


def test_a_training_goes_on_without_those_that_were_side_by_side(train, alone):
    train([0, 1], stop=(1, "dqn_lidar", 2), saved=True)
    found, _ = train([1], saved=True)
    assert found == {1: alone[1]}


def after(key, config, *, walked):
    """A stage for those whose walk has not failed."""
    return walked + jax.random.uniform(key)


def walks(farthest=np.inf):
    return [
        walking("dqn_camera", farthest),
        Stage("after", after, {"walked": "dqn_camera"}),
    ]


@pytest.fixture
def write(monkeypatch, tmp_path, patient):
    """Trains seeds in one group of the command; gives what it tells, pictures, and summaries."""
    monkeypatch.setattr(programs, "_trace_missions", lambda programs, compiler: None)

    def learn(key, config, programs, monitor, checkpoints):
        outputs = loop.train(key, config, programs, monitor, checkpoints).outputs
        return SimpleNamespace(results={name: x.item() for name, x in outputs.items()})

    def play(key, config, programs, monitor, learned, checkpoints):
        return SimpleNamespace(missions=-learned.results["after"])

    monkeypatch.setattr(pipeline, "learn", learn)
    monkeypatch.setattr(pipeline, "play", play)

    def run(seeds, number, farthest=np.inf):
        drawn = {}
        report = SimpleNamespace(
            of_training=lambda config, learned: {"curve": learned.results["after"]},
            of_missions=lambda config, learned, played: {"film": played.missions},
            write=lambda run, pictures, found: drawn.update({run.settings.seed: pictures}),
        )
        monkeypatch.setattr(command, "_report", lambda: report)
        monkeypatch.setattr(programs, "stages", lambda config: walks(farthest))
        arguments, monitor = command.parse(["--preset", "smoke", "--quiet"]), Monitor()
        trainings = Trainings(number, total=len(seeds))
        with (
            pipeline.compiled(SMOKE, monitor, trainings=trainings) as compiled,
            contextlib.ExitStack() as opened,
        ):
            runs = [
                opened.enter_context(
                    RunDirectory.create(tmp_path / str(seed), Settings("smoke", seed, SMOKE))
                )
                for seed in seeds
            ]
            failed = command._train_together(
                arguments, runs, compiled, monitor, Console(quiet=True)
            )
        summaries = {
            seed: json.loads((tmp_path / str(seed) / "summary.json").read_text(encoding="utf-8"))
            for seed in seeds
            if (tmp_path / str(seed) / "summary.json").exists()
        }
        return failed, drawn, summaries

    return run


@jax.jit
def walked(seed):
    """Outputs of a seed alone, in one program."""
    return compose(jax.random.key(seed), SMOKE, walks()).outputs


def test_the_command_writes_of_each_seed_what_it_gets_alone(write, tmp_path):
    seeds = [7, 3, 5]
    begin = time.monotonic()
    failed, drawn, summaries = write(seeds, number=4)  # the last group of many seeds
    assert time.monotonic() - begin < PATIENCE / 2
    assert failed == {}
    expected = {seed: {name: x.item() for name, x in walked(seed).items()} for seed in seeds}
    assert len({outputs["after"] for outputs in expected.values()}) == 3
    for seed in seeds:
        found, after = summaries[seed], expected[seed]["after"]
        assert found["seed"] == seed
        assert {name: found[name] for name in expected[seed]} == expected[seed]
        assert found["mission"] == -after
        assert drawn[seed] == {"curve": after, "film": -after}
        lines = (tmp_path / str(seed) / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        reported = [json.loads(line) for line in lines]
        assert [each["step"] for each in reported if "loss" in each] == [2, 4, 5]
        assert reported[-1]["loss"] == pytest.approx(expected[seed]["dqn_camera"])


def test_the_command_writes_other_seeds_when_one_fails(write, tmp_path, capsys):
    reached = {seed: walked(seed)["dqn_camera"].item() for seed in (7, 3, 5)}
    *others, failing = sorted(reached, key=lambda seed: reached[seed])
    farthest = (reached[others[-1]] + reached[failing]) / 2
    begin = time.monotonic()
    failed, drawn, summaries = write([7, 3, 5], number=3, farthest=farthest)
    assert time.monotonic() - begin < PATIENCE / 2
    ((seed, reason),) = failed.items()
    assert seed == failing
    assert "loss = nan at step 5 of 5" in reason
    assert f"earlier checkpoints are in {tmp_path / str(failing)}" in capsys.readouterr().err
    assert {seed: found["after"] for seed, found in summaries.items()} == {
        seed: walked(seed)["after"].item() for seed in others
    }
    assert set(drawn) == set(others)

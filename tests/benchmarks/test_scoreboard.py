"""The scoreboard of the frozen tasks: learners, curves, tables and the page."""

import dataclasses
import functools
import importlib
import itertools
import json
import os
import pickle
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from matplotlib.backends.backend_agg import FigureCanvasAgg

import jaxsense
from benchmarks.tasks import __main__ as program
from benchmarks.tasks import board, dqn, jobs, learner, learners, plot, record
from benchmarks.tasks.board import Row
from benchmarks.tasks.record import Point, Recorder

make = functools.cache(jaxsense.make)
ABOUT = {"device": "cpu", "commit": "0123456789abcdef", "date": "2026-11-26", "cores": 2,
         "command": "python -m benchmarks.tasks", "versions": {"python": "3.11.7"}}  # fmt: skip
ROW = Row(
    *("map-v0", "camera", "mine"),
    returns=(1.0, 1.0, 1.0, 1.0),
    best="optimal",
    best_returns=(2.0, 2.0, 2.0, 2.0),
    steps=131072,
    seconds=12.345,
    wall_seconds=60.0,
    settings={"discount": 0.9},
    about=ABOUT,
)


def train(found, name, seeds=(20, 21)):
    """What a learner reports of the shortest training, and what is known at the end of it."""
    recorder = Recorder(make(name), found.name, 2.0, episodes=4)
    found.train(make(name), seeds, 1, recorder)
    assert [*recorder.policies] == [*seeds]
    curves = [[p for p in recorder.points if p.seed == seed] for seed in seeds]
    for curve in curves:
        steps = [point.steps for point in curve]
        assert steps[0] == 0
        assert steps == sorted(steps)
        assert curve[0].seconds == 0
        assert curve[-1].seconds > 0
        assert all(p.fraction == pytest.approx(p.mean_return / 2) for p in curve)
    return recorder


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_our_dqn_trains_in_every_kind_of_task(name):
    small = dqn.Dqn(num_envs=32, updates=1, batch=32, replay=1024)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dqn, "NUM_STARTS", 32)
        recorder = train(small, name)
    # Ten points of one step of each environment.
    assert max(point.steps for point in recorder.points) == 320
    one, other = (jax.tree.leaves(each) for each in recorder.policies.values())
    assert any((np.asarray(x) != np.asarray(y)).any() for x, y in zip(one, other, strict=True))


def peer(module, package):
    """A module with learners of another library."""
    reason = f"{package}: needs the extra of jaxsense"
    pytest.importorskip(package, reason=reason)
    return pytest.importorskip(f"benchmarks.tasks.{module}", reason=reason)


def draws(recorder, name):
    """Whether the policies that are scored draw their actions, from one observation."""
    _, state = make(name).reset(jax.random.key(0))
    seen, keys = make(name).observe(state), jax.random.split(jax.random.key(1), 64)
    return [
        len(set(jax.vmap(policy, (0, None))(keys, seen).tolist())) > 1
        for policy in recorder.policies.values()
    ]


@pytest.mark.parametrize("number", [0, 1])
def test_learners_of_rejax_train_and_ppo_draws_its_actions(number, monkeypatch):
    rejax = peer("rejax", "rejax")
    monkeypatch.setattr(rejax, "NUM_STARTS", 32)
    recorder = train(dataclasses.replace(rejax.LEARNERS[number], num_envs=16), "map-v0")
    assert draws(recorder, "map-v0") == [number == 1] * 2


@pytest.mark.parametrize("number", [0, 1])
def test_learners_of_stable_baselines3_train_and_ppo_draws_its_actions(number, monkeypatch):
    sb3 = peer("sb3", "stable_baselines3")
    monkeypatch.setattr(sb3, "NUM_STARTS", 32)
    learner = dataclasses.replace(sb3.LEARNERS[number], num_envs=16)
    recorder = train(learner, "map-v0", seeds=(20,))
    assert draws(recorder, "map-v0") == [number == 1]


def test_networks_of_stable_baselines3_choose_as_they_do_in_jax():
    sb3 = peer("sb3", "stable_baselines3")
    # Only there if Stable-Baselines3 is.
    gymnasium, torch = map(importlib.import_module, ("gymnasium", "torch"))

    class Env(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-10, 10, (6,))
        action_space = gymnasium.spaces.Discrete(5)

    seen = np.random.default_rng(0).normal(size=(64, 6)).astype(np.float32)
    on_policy, off_policy = (kind("MlpPolicy", Env()) for kind in (sb3.PPO, sb3.DQN))
    network = on_policy.policy.mlp_extractor.policy_net, on_policy.policy.action_net
    with torch.no_grad():
        for linear in network[1], *network[0][::2]:
            linear.bias.normal_()
            linear.weight.mul_(20)
    ours = {
        on_policy: sb3.Dense(sb3.layers(*network), jnp.tanh, sb3.best),
        off_policy: sb3.Dense(sb3.layers(off_policy.q_net.q_net), jax.nn.relu, sb3.best),
    }
    for model, policy in ours.items():
        chosen = jax.vmap(lambda x: policy(None, x))(seen)  # noqa: B023
        theirs = model.predict(seen, deterministic=True)[0]
        np.testing.assert_array_equal(chosen, theirs)
        assert len(set(theirs.tolist())) > 1


def test_the_recurrent_ppo_trains_and_draws_its_actions(monkeypatch):
    sb3, contrib = peer("sb3", "stable_baselines3"), peer("sb3_recurrent", "sb3_contrib")
    monkeypatch.setattr(sb3, "NUM_STARTS", 32)
    learner = dataclasses.replace(contrib.LEARNERS[0], num_envs=16, lstm=8)
    recorder = train(learner, "map-v0", seeds=(20,))
    policy = recorder.policies[20]
    assert [each.shape for each in policy.memory] == [(8,), (8,)]
    recorder.policies[20] = lambda key, seen: policy.act(key, policy.memory, seen)[0]
    assert draws(recorder, "map-v0") == [True]


def test_the_recurrent_ppo_takes_a_share_of_the_steps(monkeypatch):
    sb3, contrib = peer("sb3", "stable_baselines3"), peer("sb3_recurrent", "sb3_contrib")
    asked = []
    monkeypatch.setattr(sb3, "_train", lambda *arguments: asked.append(arguments[-2]))
    for steps in (65536, 1):
        contrib.RecurrentPpo(share_of_steps=0.25).train(make("map-v0"), (20,), steps, None)
    assert asked == [16384, 1]


def test_a_recurrent_network_chooses_and_remembers_as_it_does_in_jax():
    sb3, contrib = peer("sb3", "stable_baselines3"), peer("sb3_recurrent", "sb3_contrib")
    gymnasium, torch = map(importlib.import_module, ("gymnasium", "torch"))

    class Env(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-10, 10, (6,))
        action_space = gymnasium.spaces.Discrete(5)

    model = contrib.RecurrentPpo(lstm=7).make(Env(), seed=0)
    lstm = model.policy.lstm_actor
    dense = model.policy.mlp_extractor.policy_net, model.policy.action_net
    with torch.no_grad():
        for each in (each for module in (lstm, *dense) for each in module.parameters()):
            each.normal_()
    policy = contrib.recurrent(lstm, sb3.Dense(sb3.layers(*dense), jnp.tanh, sb3.best))
    memory = jax.tree.map(lambda x: jnp.tile(x, (64, 1)), policy.memory)
    state, start, found = None, np.ones(64, bool), []
    for seen in np.random.default_rng(0).normal(size=(5, 64, 6)).astype(np.float32):
        chosen, memory = jax.vmap(lambda m, x: policy.act(None, m, x))(memory, seen)
        theirs, state = model.predict(seen, state, start, deterministic=True)
        start = np.zeros(64, bool)
        np.testing.assert_array_equal(chosen, theirs)
        for mine, other in zip(memory, state, strict=True):
            np.testing.assert_allclose(mine, other[0], atol=1e-5)
        found.append(theirs)
    assert len(set(np.ravel(found).tolist())) > 1


def nop(key, observation):
    return jnp.int32(3)


def test_the_clock_stands_still_while_policies_play(monkeypatch):
    times = iter([100.0, 101.0, 105.0, 106.0, 207.0, 209.0])
    monkeypatch.setattr(record.time, "process_time", lambda: next(times))
    recorder = Recorder(make("map-v0"), "mine", 1.0, episodes=2)
    for steps in (0, 64, 128):
        recorder(steps, {0: Partial(nop), 1: Partial(nop)})
    # From 101 to 105 s and from 106 to 207 s, shared by two seeds.
    assert [p.seconds for p in recorder.points if p.seed == 1] == [0, 2, 2 + 101 / 2]
    assert recorder.points[-1] == Point("map-v0", "camera", "mine", 1, 128, 52.5, 0.0, 0.0)


def test_parts_of_a_training_fill_its_steps():
    assert learner.part(131072, 128) == 102  # 10 x 102 x 128 = 130,560
    assert learner.part(1, 1024) == 1


def test_curves_are_read_as_they_were_written(tmp_path):
    points = [Point("map-v0", "camera", "mine", 0, 64 * i, 0.5 * i, -1.0, -0.5) for i in range(3)]
    record.write(tmp_path / jobs.CURVES, points)
    lines = (tmp_path / jobs.CURVES).read_text().splitlines()
    assert lines[0] == "task,agent,learner,seed,steps,seconds,mean_return,fraction"
    assert lines[2] == "map-v0,camera,mine,0,64,0.5000,-1.0000,-0.5000"
    assert record.read(tmp_path / jobs.CURVES) == points


def test_rows_are_read_as_they_were_written(tmp_path):
    board.write(tmp_path / jobs.SCORES, [ROW])
    assert board.read(tmp_path / jobs.SCORES) == [ROW]
    assert board.read(tmp_path / "none.json") == []


def test_a_table_shows_what_policies_reach():
    assert board.tables([]).startswith("### `map-v0`, `camera`")
    text = board.tables([dataclasses.asdict(ROW)])
    assert text.startswith("![Learning curves")
    assert "### `map-v0`, `camera`" in text
    half = "0.500 (0.500 to 0.500)"
    assert f"| mine | 1.000 (1.000 to 1.000) | {half} | 131,072 | 12.3 |" in text
    assert "- mine: discount 0.9" in text
    assert "mine: cpu, commit 0123456789 on 2026-11-26; python 3.11.7." in text
    assert "1 minute of a core" in text
    # What the files of the tasks store.
    returns = jaxsense.tasks.estimate(np.asarray(make("map-v0").returns)[0])
    assert f"| `optimal` | {returns} | 1.000 (1.000 to 1.000) |  |  |" in text
    assert "fraction of `nearest`" in text
    other = dataclasses.replace(ROW, task="many-v0", settings={"discount": 0.5})
    assert "- mine in `many-v0`: discount 0.5" in board.tables(
        [*map(dataclasses.asdict, (ROW, other))]
    )


def test_the_picture_has_a_curve_of_each_learner():
    points = [
        Point(task, "camera", name, seed, steps, 1.0, 1.0, 0.9 if name == "mine" else 0.25)
        for task in ("map-v0", "noisy-v0")
        for name in ("mine", "yours")
        for seed in range(3)
        for steps in (0, 64, 128)
    ]
    figure = plot.draw(points)
    assert [axis.get_title() for axis in figure.axes] == ["map-v0, camera", "noisy-v0, camera"]
    line, other = figure.axes[0].get_lines()[:2]
    assert (line.get_label(), other.get_label()) == ("mine", "yours")
    np.testing.assert_allclose(line.get_ydata(), 0.9)
    assert list(line.get_xdata()) == [0, 64, 128]
    # Names at the ends of curves, upwards, of those below the plot with their last value.
    assert [text.get_text() for text in figure.axes[0].texts] == ["yours: 0.25", "mine"]


def test_names_of_curves_that_end_together_do_not_overlap():
    points = [
        Point(task, "camera", name, 0, steps, 1.0, 1.0, 0.9)
        for task in ("map-v0", "noisy-v0", "many-v0")
        for name in ("mine", "yours", "theirs")
        for steps in (0, 64)
    ]
    figure = plot.draw(points)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    *with_curves, empty = figure.axes
    assert not empty.axison
    for axis in with_curves:
        boxes = [text.get_window_extent(renderer) for text in axis.texts]
        assert all(low.y1 < high.y0 for low, high in itertools.pairwise(boxes))
        assert min(box.x0 for box in boxes) > axis.get_window_extent(renderer).x1
    of_left, of_right = (axis.texts[0] for axis in with_curves[:2])
    right = of_left.get_window_extent(renderer).x1
    assert right < with_curves[1].get_window_extent(renderer).x0
    assert of_right.get_window_extent(renderer).x1 < figure.bbox.x1


@dataclasses.dataclass(frozen=True)
class Nop:
    """Learns nothing."""

    name = "nop"
    packages = ()

    def train(self, task, seeds, steps, report):
        for seed in seeds:
            report(0, {seed: Partial(nop)})
            report(steps, {seed: Partial(nop)})


@pytest.mark.slow
def test_a_row_of_a_job_holds_all_seeds():
    job = jobs.Job("map-v0", "camera", Nop(), (20, 21, 22), 64)
    row, points = jobs.do(job, {"commit": "0", "date": "2026-11-26"})
    assert row.place == ("map-v0", "camera", "nop")
    assert row.returns == (0.0, 0.0, 0.0)
    assert row.steps == 64
    assert row.wall_seconds > row.seconds > 0
    assert len(points) == 6
    json.dumps(dataclasses.asdict(row), allow_nan=False)


@dataclasses.dataclass(frozen=True)
class Wrong:
    """A learner that does one thing wrong."""

    how: str
    name = "wrong"

    @property
    def packages(self):
        return ("no-such-package",) if self.how == "package" else ()

    def train(self, task, seeds, steps, report):
        if self.how == "swapped":
            report({seeds[0]: nop}, 0)
        if self.how == "late":
            report(steps, {seeds[0]: nop})
        if self.how == "some":
            report(0, {seeds[0]: nop})
        if self.how in ("package", "untrained"):
            report(0, dict.fromkeys(seeds, nop))
        if self.how == "others":
            report(0, {7: nop})
            report(64, {7: nop})


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("silent", r"wrong has not reported policies of the seeds \[20, 21\]"),
        ("some", r"wrong has not reported policies of the seeds \[20, 21\]"),
        ("swapped", "wrong: ValueError: report must be called with steps and a dictionary of pol"),
        ("late", "wrong: ValueError: report must be called with 0 steps first, for each seed"),
        ("untrained", r"wrong has not reported policies of the seeds \[20, 21\]"),
        ("others", r"wrong has not reported policies of the seeds \[7, 20, 21\]"),
        ("package", "wrong: PackageNotFoundError: No package metadata was found for no-such-pack"),
    ],
)
def test_a_learner_that_does_something_wrong_is_named(how, expected, monkeypatch):
    monkeypatch.setattr(record, "mean_return", lambda *_: 1.0)
    monkeypatch.setattr(record, "best_return", lambda *_: 2.0)
    job = jobs.Job("map-v0", "camera", Wrong(how), (20, 21), 64)
    with pytest.raises(learner.LearnerError, match=expected):
        jobs.do(job, {})


def test_jobs_travel_to_other_processes():
    for each in learners.load():
        sent = jobs.do, jobs.Job("map-v0", "camera", each, (20,), 64)
        assert pickle.loads(pickle.dumps(sent)) == sent


@dataclasses.dataclass(frozen=True)
class Elsewhere(Nop):
    """Learns nothing, in a process other than this one."""

    process: int

    def train(self, task, seeds, steps, report):
        assert os.getpid() != self.process
        assert not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) == 1
        assert jax.config.jax_default_matmul_precision == "highest"
        super().train(task, seeds, steps, report)


@pytest.mark.slow  # a new process imports everything
def test_a_job_is_done_in_a_process_of_its_own(tmp_path):
    job = jobs.Job("map-v0", "camera", Elsewhere(os.getpid()), (20,), 64)
    jobs.run([job], 1, tmp_path, "python -m benchmarks.tasks nop")
    (row,) = board.read(tmp_path / jobs.SCORES)
    assert row.settings == {"process": os.getpid()}
    assert [p.steps for p in record.read(tmp_path / jobs.CURVES)] == [0, 64]


def test_results_of_other_learners_stay(tmp_path, monkeypatch):
    """One job, without a process of its own."""
    board.write(tmp_path / jobs.SCORES, [ROW, dataclasses.replace(ROW, policy="nop")])
    old = Point("map-v0", "camera", "nop", 5, 1, 0.0, 0.0, 0.0)
    record.write(tmp_path / jobs.CURVES, [old, dataclasses.replace(old, learner="mine")])
    monkeypatch.setattr(jobs, "ProcessPoolExecutor", lambda number, *_: ThreadPoolExecutor(number))
    job = jobs.Job("map-v0", "camera", Nop(), (20,), 64)
    jobs.run([job], 1, tmp_path, "python -m benchmarks.tasks nop")
    rows = {row.policy: row for row in board.read(tmp_path / jobs.SCORES)}
    assert rows["mine"] == ROW
    assert rows["nop"].about["command"] == "python -m benchmarks.tasks nop"
    assert [p.learner for p in record.read(tmp_path / jobs.CURVES)] == ["mine", "nop", "nop"]


def test_the_command_of_a_row_can_be_copied(tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(jobs, "run", lambda *arguments: asked.append(arguments[-1]))
    (tmp_path / jobs.SCORES).write_text("[]")
    program.main(["our DQN", "--seeds", "1", "--out", str(tmp_path)])
    # With the tables of that folder, for now those of the references.
    assert "### `map-v0`, `camera`" in capsys.readouterr().out
    assert asked == [f"python -m benchmarks.tasks 'our DQN' --seeds 1 --out {tmp_path}"]


def test_learners_have_names_of_their_own_and_settings():
    names = [each.name for each in learners.load()]
    assert len(set(names)) == len(names)
    assert all(dataclasses.asdict(each) for each in learners.load())


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["none"], "learners = ('none',): must be some of 'our DQN'"),
        (["--only", "map-v1"], "only = ('map-v1',): must be some of many-v0, map-v0"),
        (["--quick"], "quick = True: needs --out FOLDER"),
        (["--page", "--out", "x"], "page = True: trains nothing and remakes only the repository's"),
        (["--page", "our DQN"], "page = True: trains nothing and remakes only the repository's"),
    ],
)
def test_wrong_options_are_told_in_one_line(argv, message, capsys):
    with pytest.raises(SystemExit):
        program.main(argv)
    assert message in capsys.readouterr().err

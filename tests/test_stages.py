"""The stages of a training: what they train on; `learn` and a run are the same training."""

import dataclasses
import functools
import json
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxsense.stages import learn

from jaxsense import examine, models, observe, stages
from jaxsense.config import (
    PRESETS,
    DetectorConfig,
    JmvaeConfig,
    MdpConfig,
    MissionConfig,
    TeamConfig,
    ToursConfig,
)
from jaxsense.core.types import Belief
from jaxsense.dqn import optimum
from jaxsense.run import loop, missions, pipeline
from jaxsense.run.monitor import Monitor
from jaxsense.sim.world import make_world
from jaxsense.vae import detectors, jmvae

SMOKE, KEY = PRESETS["smoke"], jax.random.key(7)
# As little as shows every stage: learning is chaotic, and two programs round differently.
TINY = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(hidden=(8,), num_scans=96, num_held_out=48, steps=41, batch=16),
    jmvae=JmvaeConfig(hidden=(8,), restarts=2, samples_per_class=32, steps=41, batch=16),
    dqn=dataclasses.replace(
        SMOKE.dqn, hidden=(8,), num_envs=8, epochs=4, chunk=2, updates=2, batch=16,
        replay_capacity=64, num_starts=8,
    ),
    mission=MissionConfig(episodes=1, time_limit=0.5),
)  # fmt: skip
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
        patch.setattr(missions, "Player", lambda *given: None)  # none is played
        with pipeline.compiled(with_observe(request.param), monitor) as programs:
            yield programs, loop.train(KEY, programs.config, programs, monitor)


def first_chunk(stage, begin_key, chunk_key, config, inputs):
    """What `learn` does of a stage at first."""
    state = stage.begin(begin_key, config, *inputs)
    if not isinstance(stage, stages.Steps):
        return state
    return jax.lax.scan(
        lambda state, key: stage.advance(key, config, state, *inputs), state, chunk_key[None]
    )


def test_every_stage_of_learn_is_that_of_a_run(trained):
    programs, found = trained
    keys, config, together = jnp.stack([KEY, jax.random.key(8)]), programs.config, {}
    for stage in programs.stages:
        inputs, compiled = stage.select(found.outputs), programs.of(stage)
        begin_keys, chunk_keys = jax.vmap(stage.key)(keys), keys
        if stage.has_rows:
            inputs = jax.tree.map(lambda x: x[:2], inputs)
            of_run = jax.tree.map(lambda x: x[:2], found.outputs[stage.name])
        elif isinstance(stage, stages.Steps):
            chunk_keys = jax.vmap(stage.chunk_keys)(keys)[:, 0]
            state = compiled.begin(begin_keys[0], config, *inputs)
            of_run = compiled.advance(chunk_keys[0], config, state, *inputs)
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
            # Relative to the size of the array: a number that is nearly zero has no digits.
            scale = np.abs(there[np.isfinite(there)]).max(initial=0)
            np.testing.assert_allclose(
                here, there, rtol=TOLERANCE, atol=TOLERANCE * scale, err_msg=stage.name
            )


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
        stages.models(outputs, programs.config) for outputs in (learned.outputs, found.outputs)
    )
    jax.tree.map(close, of_learn, of_run)
    for name, progress in learned.progress.items():
        assert len(progress.loss) == next(s.steps for s in programs.stages if s.name == name)
        for metric, values in progress.metrics.items():
            close(values, found.curves[name][metric])


def test_learn_stops_after_the_stage_that_is_named():
    names = [stage.name for stage in stages.stages(TINY)]
    shapes = jax.eval_shape(lambda: learn(KEY, TINY, until="jmvae"))
    assert set(shapes.outputs) == set(names[: names.index("jmvae") + 1])
    with pytest.raises(ValueError, match=r"until = 'vae': must be one of scenes, survey"):
        learn(KEY, TINY, until="vae")


@pytest.mark.slow  # with simulated scans; `test_traced_settings.py` has all settings
def test_settings_vary_in_one_program_as_they_do_in_several():
    config = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, steps=5))

    def params(key, alpha):
        varied = dataclasses.replace(config, jmvae=dataclasses.replace(config.jmvae, alpha=alpha))
        return learn(key, varied, until="jmvae").outputs["jmvae"]

    keys = jax.random.split(jax.random.key(0))
    together = jax.jit(jax.vmap(params))(keys, jnp.array([0.1, 2.0]))
    alone = jax.jit(lambda key: params(key, 2.0))(keys[1])
    close = lambda x, y: np.testing.assert_allclose(x[1], y, atol=1e-4)  # noqa: E731
    jax.tree.map(close, together, alone)


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
    config = dataclasses.replace(TINY, detector=dataclasses.replace(TINY.detector, steps=steps))
    stage = next(s for s in stages.stages(config) if s.name == "detector_camera")
    size = -(-steps // stage.chunks)
    assert (stage.chunks, size) == expected
    assert (stage.chunks - 1) * size < stage.steps <= stage.chunks * size


def keys_of(stage):
    chunks = list(stage.chunk_keys(KEY)) if isinstance(stage, stages.Steps) else []
    return [stage.key(KEY), *chunks]


def data(keys):
    return [tuple(jax.random.key_data(key).tolist()) for key in keys]


def test_keys_follow_from_the_names_of_stages_alone():
    more = dataclasses.replace(TINY, jmvae=dataclasses.replace(TINY.jmvae, restarts=5))
    few, many = ({s.name: data(keys_of(s)) for s in stages.stages(c)} for c in (TINY, more))
    assert all(many[name] == keys for name, keys in few.items())
    used = [key for keys in few.values() for key in keys] + data([stages.mission_key(KEY)])
    assert len(set(used)) == len(used)


def test_the_last_chunk_makes_no_step_too_many():
    config = dataclasses.replace(SMOKE.detector, hidden=(3,), steps=5, batch=4)
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


def of_stage(name, config):
    return next(stage for stage in stages.stages(config) if stage.name == name)


@pytest.mark.parametrize(("share", "trained_on"), [(0.0, 10), (0.1, 9), (0.25, 7), (0.5, 5)])
def test_looks_that_calibrate_a_detector_are_not_trained_on(share, trained_on, monkeypatch):
    config = dataclasses.replace(TINY.detector, calibration=share)
    config = dataclasses.replace(TINY, detector=config)
    # Of .25 of ten looks, three calibrate.
    windows, labels = jnp.arange(20.0).reshape(10, 2), jnp.arange(10) % 2
    examples, used = ((windows, labels),) * 2, {}

    def train(key, fit, detector, windows, labels, config, steps):
        used["train"], used["labels"] = windows, labels
        return fit, jnp.zeros(steps)

    def calibrate(detector, windows, labels):
        used["calibrate"] = windows
        np.testing.assert_array_equal(labels, (windows[:, 0] / 2) % 2)
        return "calibrated"

    monkeypatch.setattr(detectors, "train", train)
    monkeypatch.setattr(detectors, "calibrate", calibrate)
    stage = of_stage("detector_lidar", config)
    state = stage.begin(KEY, config, examples)
    state, _ = stage.advance(KEY, config, state, examples)
    found = stage.finish(config, state, examples)
    np.testing.assert_allclose(state[0].offset, windows[:trained_on].mean(axis=0))
    np.testing.assert_array_equal(used["train"], windows[:trained_on])
    np.testing.assert_array_equal(used["labels"], labels[:trained_on])
    if share:
        np.testing.assert_array_equal(used["calibrate"], windows[trained_on:])
        assert found == "calibrated"
    else:
        assert "calibrate" not in used


def test_without_calibration_a_detector_is_what_was_trained():
    windows, labels = jax.random.normal(KEY, (48, 6)), jnp.arange(48) % 2
    examples, config = ((windows, labels),) * 2, TINY.detector
    assert config.calibration == 0
    stage = of_stage("detector_camera", TINY)
    state = stage.begin(KEY, TINY, examples)
    detector = detectors.init(KEY, windows, 2, config)
    fit = detectors.start(detector, config)
    for key in stage.chunk_keys(KEY)[:2]:
        state, _ = stage.advance(key, TINY, state, examples)
        fit, _ = detectors.train(key, fit, detector, windows, labels, config, 3)
    found = stage.finish(TINY, state, examples)
    expected = dataclasses.replace(detector, params=fit.params)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def detections_of(bank):
    """Detections for training, without any to measure on."""
    nothing: Any = ()
    return stages.Detections(bank, nothing, nothing, nothing, nothing)


def test_a_class_is_read_by_its_detections_for_training(monkeypatch):
    monkeypatch.setattr(examine, "class_beliefs", lambda params, bank, config: (params, bank))
    stage, bank = of_stage("class_beliefs", TINY), (jnp.zeros((3, 2, 2)),) * 2
    assert stage.begin(KEY, TINY, {}, detections_of(bank)) == ({}, bank)


@pytest.mark.parametrize("reward", ["nats", "paper"])
def test_values_of_looks_are_of_detections_for_training_and_of_the_mdps_reward(reward):
    mdp = MdpConfig(reward=reward, look_cost=0.125, min_increase=0.01)
    fusion = dataclasses.replace(TINY.jmvae, fusion="filter", latent_size=1)
    config = dataclasses.replace(TINY, jmvae=fusion, mdp=mdp)
    # The camera is sure, red or green; the LiDAR knows nothing: two cylinders to one cube.
    camera, lidar = jnp.array([[0, 1], [1, 0], [1, 0]]), jnp.full((3, 2), 1 / 3).at[:, 0].set(2 / 3)
    bank = tuple(jnp.repeat(x[:, None].astype(jnp.float32), 4, axis=1) for x in (camera, lidar))
    # Classes in one dimension of deviation 1, at 0, 3 and 3 + sqrt(12).
    mean = jnp.array([[0.0], [3.0], [3.0 + 12**0.5]])
    classes = Belief(mean, jnp.ones((3, 1)))
    stage = of_stage("look_values", config)
    camera, lidar = jax.jit(stage.begin)(KEY, config, classes, detections_of(bank))
    even = jnp.full(3, 1 / 3)
    if reward == "nats":
        # ln 3 before; nothing after a green one, and ln 2 after each of two red ones.
        expected = first = [np.log(3) - np.log(2) * 2 / 3 - 0.125, -0.125]
    else:
        # Before, a variance of 1 + that of the three means. After a green one 1, and after a red
        # one 1 + 12 / 4 = 4.
        before = 1 / np.sqrt(1 + np.var(mean))
        expected = [((1 - before) + 2 * (1 / 2 - before)) / 3, -1.0]
        # An unseen PoI has a variance of 20, so that even the LiDAR's first look pays.
        unseen = 1 / np.sqrt(20)
        first = [((1 - unseen) + 2 * (1 / 2 - unseen)) / 3, before - unseen]
    found = [optimum.interpolate(values.gain, even) for values in (camera, lidar)]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    np.testing.assert_allclose([camera.first_gain, lidar.first_gain], first, atol=1e-4)
    # A second look of the camera adds nothing, and so costs more than it pays.
    np.testing.assert_allclose(optimum.interpolate(camera.total, even), expected[0], atol=1e-4)
    np.testing.assert_allclose(camera.first_total, first[0], atol=1e-4)


def test_other_numbers_of_pois_are_played_an_eighth_as_often_but_always_once(monkeypatch):
    played = []
    monkeypatch.setattr(stages, "_play_policies", lambda key, config, *_: played.append(config))
    team = PRESETS["team"]
    for repeats in (1, 96):
        settings = dataclasses.replace(team.evaluation, num_repeats=repeats, num_pois=(5, 20))
        config = dataclasses.replace(team, evaluation=settings)
        stages._play_numbers(KEY, config, jnp.int32(0))
    assert [config.arena.num_pois for config in played] == [5, 20, 5, 20]
    assert [config.evaluation.num_repeats for config in played] == [1, 1, 12, 12]


def test_the_loss_of_a_restart_is_the_mean_of_its_last_chunk(monkeypatch):
    # 41 steps are 14 chunks of 3, the last of which has 2.
    def train(key, state, model, bank, config, steps):
        losses = state.step + 1.0 + jnp.arange(steps)
        after = jnp.minimum(state.step + steps, config.steps)
        return dataclasses.replace(state, step=after), losses

    monkeypatch.setattr(jmvae, "train", train)
    stage = next(s for s in stages.stages(TINY) if s.name == "jmvae_1")
    bank: Any = stages.Detections((), (), (), jnp.zeros(2), ())  # pyright: ignore
    state, seen = stage.begin(KEY, TINY, bank), []
    for _ in range(stage.chunks):
        state, progress = stage.advance(KEY, TINY, state, bank)
        seen.append(float(stage.finish(TINY, state, bank)[1]))
        assert len(progress.loss) == 3
    assert seen[0] == 2.0  # of 1, 2, 3
    assert seen[-1] == 40.5  # of 40 and 41


@pytest.mark.slow  # compiles trials of the auction, with the map's readout
def test_a_team_learns_its_tours_from_all_trials_so_far():
    config = dataclasses.replace(
        TINY,
        dqn=dataclasses.replace(TINY.dqn, task="team", observe="bank"),
        team=TeamConfig(
            num_pois=(2, 3), tours=ToursConfig(states=20, tries=2, walk=1, steps=41, batch=8)
        ),
    )
    untrained = models.init(KEY, config)
    bank = tuple(jnp.ones((3, 4, n)) / n for n in models.make_jmvae(config).feature_sizes)
    # The first look at a PoI pays, and no other.
    values = tuple(dataclasses.replace(v, first_gain=jnp.ones(())) for v in untrained.look_values)
    given: Any = stages.Detections(bank, (), (), jnp.zeros(2), ())  # pyright: ignore
    inputs = values, untrained.class_beliefs, untrained.jmvae, given
    stage: Any = next(s for s in stages.stages(config) if s.name == "tours")
    state = stage.begin(KEY, config, *inputs)
    first = state[0].params
    advance = jax.jit(lambda key, state: stage.advance(key, config, state, *inputs))
    # 41 steps are 14 chunks of 3, the last of which has 2; 20 states are 2 in each chunk.
    written = []
    for key in stage.chunk_keys(KEY):
        state, progress = advance(key, state)
        assert np.isfinite(progress.loss).all()
        written.append(np.asarray(state[1].observation))
    assert len(written) == 14
    for i, observed in enumerate(written):
        assert np.any(observed[:, : 2 * i + 2], axis=0).all()
        assert not np.any(observed[:, 2 * i + 2 :])
        np.testing.assert_array_equal(observed[:, : 2 * i + 2], written[-1][:, : 2 * i + 2])
    assert int(state[0].step) == 41
    assert state[1].is_tried.sum(axis=0).max() == 2
    learned = stage.finish(config, state, *inputs)
    assert any(np.any(x != y) for x, y in zip(*map(jax.tree.leaves, (first, learned)), strict=True))


def test_the_restart_with_the_lowest_loss_is_kept():
    stage = next(s for s in stages.stages(TINY) if s.name == "jmvae")

    def best(*losses):
        return int(stage.begin(KEY, TINY, *((jnp.int32(i), x) for i, x in enumerate(losses))))

    assert best(jnp.float32(1), jnp.float32(0.5), jnp.float32(0.9)) == 1
    assert best(jnp.float32(1), jnp.float32(jnp.nan), jnp.float32(0.9)) == 2
    assert best(jnp.float32(jnp.nan), jnp.float32(jnp.inf)) == 0


@pytest.fixture
def surveys(monkeypatch) -> stages.Surveys:
    """Surveys whose windows, and scenes, hold the key that the scene was simulated with."""

    def survey(keys, world, classes):
        key = jax.random.key_data(keys)[:, -1].astype(jnp.uint32)
        windows = jnp.broadcast_to(key[:, None, None], (*classes.shape, 1))
        return key, (windows, windows)

    monkeypatch.setattr(observe, "surveys", survey)
    listed = {stage.name: stage for stage in stages.stages(MEASURED)}
    scenes = listed["scenes"].begin(KEY, MEASURED)
    return listed["survey"].begin(KEY, MEASURED, scenes)


MEASURED = dataclasses.replace(
    SMOKE,
    detector=DetectorConfig(num_scans=31, num_held_out=25, steps=1),
    jmvae=JmvaeConfig(samples_per_class=10),
    dqn=dataclasses.replace(SMOKE.dqn, observe="live", num_starts=2 * SMOKE.dqn.num_envs),
)


def used(arrays):
    return set(np.concatenate([np.ravel(x) for x in jax.tree.leaves(arrays)]).tolist())


def test_a_training_measures_on_scenes_that_it_did_not_train_on(surveys, monkeypatch):
    assert len(used(surveys.scenes)) == sum(stages.num_scenes(MEASURED))  # no key twice
    trained_on = []

    def train(key, fit, detector, windows, labels, config, steps):
        trained_on.append(np.asarray(windows))
        return fit, jnp.zeros(steps)

    listed = {stage.name: stage for stage in stages.stages(MEASURED)}
    monkeypatch.setattr(detectors, "init", lambda key, windows, number, config: None)
    monkeypatch.setattr(detectors, "start", lambda detector, config: None)
    monkeypatch.setattr(detectors, "train", train)
    monkeypatch.setattr(detectors, "detect", lambda detector, window: window)
    for name in ("detector_camera", "detector_lidar"):
        examples = listed["examples"].begin(KEY, MEASURED, surveys)
        state = listed[name].begin(KEY, MEASURED, examples)
        listed[name].advance(KEY, MEASURED, state, examples)
    detections = jax.jit(listed["detections"].begin)
    looks = detections(KEY, MEASURED, surveys, None, None)

    seen, bank, held_out = used(trained_on), used(looks.bank), used(looks.held_out)
    starts, shown = used(looks.starts[1]), used(looks.windows)
    assert seen.isdisjoint(bank)
    assert held_out.isdisjoint(seen | bank | starts)
    assert starts.isdisjoint(seen)
    assert shown <= held_out
    # All of them were looked at.
    assert len(seen) >= 31 / 3
    assert [x.shape[:2] for x in looks.held_out] == [(3, 9), (3, 9)]


def test_a_scene_is_the_same_whoever_works_it_out():
    listed = {stage.name: stage for stage in stages.stages(TINY, make_world(TINY))}
    keys, classes = listed["scenes"].begin(KEY, TINY)
    survey = jax.jit(listed["survey"].begin)
    first, second = (survey(KEY, TINY, (keys[i : i + 4], classes[i : i + 4])) for i in (0, 2))
    same = jax.tree.map(lambda x, y: np.abs(x[2:] - y[:2]).max(), first.scenes, second.scenes)
    assert max(jax.tree.leaves(same)) < 1e-6
    assert np.abs(first.scenes.poses[0] - first.scenes.poses[1]).max() > 0.01


@pytest.mark.slow  # compiles three trainings at once; before a release
def test_the_example_of_the_documentation_runs(monkeypatch, capsys):
    page = (Path(__file__).parents[1] / "docs" / "getting-started.md").read_text()
    (example,) = re.findall(r"```python\n(.*?jaxsense\.learn\(.*?)```", page, re.DOTALL)
    monkeypatch.setitem(PRESETS, "smoke", TINY)
    exec(compile(example, "getting-started.md", "exec"), {})
    assert len(json.loads(capsys.readouterr().out.replace(" ", ","))) == 3

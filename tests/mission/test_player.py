"""Missions in batches: their results and the recording of the first, however they are split."""

import dataclasses
import importlib

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG, NAIVE, with_config

from jaxsense import mission
from jaxsense.core.types import Belief
from jaxsense.mission.state import Record
from jaxsense.run import devices, missions
from jaxsense.run.compilation import Compiler
from jaxsense.run.devices import Workers
from jaxsense.run.monitor import Monitor, StageError, Stopped

# The package gives its function this name.
ROLLOUT = importlib.import_module("jaxsense.mission.rollout")
KEY = jax.random.key(5)
CHUNK = missions.CHUNK
SHORT = dataclasses.replace(CONFIG.mission, time_limit=30.0)
LAST = 2 * CHUNK - 3  # control periods, within the second chunk


def fake_step(keys, team, models, states):
    """No physics, which would take long to compile: every robot walks where chance takes it."""
    moves = jax.vmap(lambda key: jax.random.normal(key, states.scene.poses.shape[1:]))(keys)
    moves = jnp.where(states.done[:, None, None], 0.0, moves)
    scene = dataclasses.replace(states.scene, poses=states.scene.poses + moves)
    steps = states.steps + ~states.done
    states = dataclasses.replace(states, scene=scene, steps=steps, done=steps >= LAST)
    fields = dict.fromkeys((f.name for f in dataclasses.fields(Record)), steps)
    return states, Record(**{**fields, "poses": scene.poses})


WORKERS = {
    "one device": Workers,
    "threads": lambda: Workers(threads=2),
    "mesh": lambda: Workers(mesh=devices.make_mesh(2)),
}


@pytest.fixture(scope="module")
def begun(team, models):
    """A mission of which all missions here have the shapes."""
    return jax.jit(lambda: mission.reset(KEY, team, models, NAIVE))()


@pytest.fixture(scope="module")
def players():
    """Players with compiled programs, by workers, batch and step."""
    return {}


@pytest.fixture
def play(team, models, begun, players, monkeypatch):
    """Plays nine missions of some policies with `fake_step` or another one, four at a time."""

    def fake_reset(key, team, models, policy, faults):
        poses = jax.random.normal(key, begun.scene.poses.shape)
        belief = jax.tree.map(lambda x: jnp.tile(x, (3, 1)), models.fusion.prior)
        scene = dataclasses.replace(begun.scene, poses=poses)
        classes = jax.random.randint(key, begun.classes.shape, 0, 4)
        changed = {"scene": scene, "belief": belief, "classes": classes, "policy": policy}
        return dataclasses.replace(begun, **changed)

    def measure(team, models, s):
        return {"steps": s.steps, "poses": s.scene.poses}

    def player_of(split, batch, step):
        monkeypatch.setattr(ROLLOUT, "step", step)
        monkeypatch.setattr(missions, "reset", fake_reset)
        monkeypatch.setattr(missions, "measure", measure)
        monkeypatch.setattr(missions, "batch_of", lambda *_: batch)
        with Compiler(Monitor()) as compiler:
            player = missions.Player(team, compiler, batch, WORKERS[split](), models)
            waited = []
            wait = missions.Program.wait
            with monkeypatch.context() as patch:
                patch.setattr(missions.Program, "wait", lambda p: (waited.append(p), wait(p)))
                player.wait()
            assert len(set(waited)) == 2  # before anything is timed
        return player

    def run(
        split="one device", models=models, batch=4, episodes=9, policies=("naive",), step=fake_step
    ):
        case = split, batch, step
        if case not in players:
            players[case] = player_of(*case)
        cases = mission.cases(CONFIG)
        return players[case].play(KEY, models, {name: cases[name] for name in policies}, episodes)

    return run


def walk_of(episode, shape):
    """`[LAST, ...]` poses of an episode, whose second chunk starts with a key of its own."""
    arena_key, play_key = missions.keys_of_episode(KEY, episode)
    step_keys = [
        key
        for number in range(2)
        for key in jax.random.split(jax.random.fold_in(play_key, number), CHUNK)
    ]
    moves = [jax.random.normal(key, shape) for key in step_keys[:LAST]]
    return np.asarray(jax.random.normal(arena_key, shape)) + np.cumsum(moves, axis=0)


def test_missions_begin_with_the_models_that_play_them(play, models):
    prior = Belief(jnp.array([0.5, -1.0]), jnp.array([2.0, 3.0]))
    fusion = dataclasses.replace(models.fusion, prior=prior)
    end = play(models=dataclasses.replace(models, fusion=fusion)).recordings["naive"].end
    np.testing.assert_array_equal(end.belief.mean, [[0.5, -1.0]] * 3)


@pytest.mark.parametrize("split", WORKERS)
def test_the_whole_first_mission_is_recorded(split, play):
    played = play(split)
    np.testing.assert_array_equal(played.metrics["naive"]["steps"], np.full(9, LAST))
    recording = played.recordings["naive"]
    records, end = recording.records, recording.end
    walk = walk_of(0, end.scene.poses.shape)
    assert len(records.time) == 2 * CHUNK
    np.testing.assert_array_equal(records.time, np.minimum(np.arange(2 * CHUNK) + 1, LAST))
    np.testing.assert_allclose(records.poses[:LAST], walk, atol=1e-4)
    np.testing.assert_array_equal(records.poses[LAST:], records.poses[LAST - 1 : -1])
    np.testing.assert_array_equal(end.scene.poses, records.poses[-1])
    assert end.done
    assert played.control_steps == 9 * LAST


@pytest.mark.parametrize("split", WORKERS)
def test_naive_exploration_is_recorded_with_the_first_mission(split, play, team):
    played = play(split, policies=("random", "latent", "naive"))
    assert [*played.recordings] == ["random", "naive"]
    for name, recording in played.recordings.items():
        walk = walk_of(0, recording.end.scene.poses.shape)
        np.testing.assert_allclose(recording.records.poses[:LAST], walk, atol=1e-4)
        np.testing.assert_array_equal(recording.end.scene.poses, recording.records.poses[-1])
        assert [*team.policies][recording.end.policy] == name
    for name in ("random", "latent", "naive"):
        np.testing.assert_allclose(played.metrics[name]["poses"][0], walk[-1], atol=1e-4)


def test_events_of_a_mission_do_not_depend_on_when_it_is_played(play):
    """Missions 4 to 8 take the places of missions that are over."""
    poses = play().metrics["naive"]["poses"]
    for episode in (0, 3, 4, 8):
        walk = walk_of(episode, poses.shape[1:])
        np.testing.assert_allclose(poses[episode], walk[-1], atol=1e-4)


def uneven(keys, team, models, states):
    """Every mission lasts as long as its classes tell."""
    states, records = fake_step(keys, team, models, states)
    last = CHUNK // 2 + jnp.abs(states.classes.sum(axis=-1)) * CHUNK // 2
    return dataclasses.replace(states, done=states.steps >= last), records


@pytest.mark.parametrize("split", WORKERS)
def test_results_do_not_depend_on_how_many_missions_play_at_once(split, play):
    few = play(split, batch=8, episodes=64, step=uneven)
    many = play(batch=64, episodes=64, step=uneven)
    assert len(set(many.metrics["naive"]["steps"].tolist())) > 3
    chex.assert_trees_all_equal(few.metrics, many.metrics)
    assert few.control_steps == many.control_steps == many.metrics["naive"]["steps"].sum()
    chex.assert_trees_all_equal(few.recordings, many.recordings)


@pytest.mark.slow  # the physics of two batch sizes is compiled
def test_missions_with_physics_do_not_depend_on_how_many_play_at_once(team, models, monkeypatch):
    short = with_config(team, dataclasses.replace(CONFIG, mission=SHORT))
    every = mission.cases(CONFIG)
    cases = {name: every[name] for name in ("latent", "naive")}

    def play(batch, split="one device"):
        monkeypatch.setattr(missions, "batch_of", lambda *_: batch)
        with Compiler(Monitor()) as compiler:
            player = missions.Player(short, compiler, batch, WORKERS[split](), models)
            return player.play(KEY, models, cases, episodes=32)

    many = play(64)
    assert len(set(many.metrics["naive"]["time_s"].tolist())) > 3
    for few in (play(8), play(16, "mesh")):
        assert few.control_steps == many.control_steps
        # Products of more rows may be summed in another order: some last bits of 24, in every look.
        for here, there in zip(*map(jax.tree.leaves, (few.metrics, many.metrics)), strict=True):
            is_exact = here.dtype.kind != "f"
            np.testing.assert_allclose(here, there, rtol=0 if is_exact else 1e-5)


def test_a_map_that_is_not_finite_ends_the_missions(play):
    def diverging(keys, team, models, states):
        states, record = fake_step(keys, team, models, states)
        is_bad = (states.steps > CHUNK)[:, None, None]
        belief = dataclasses.replace(
            states.belief, std=jnp.where(is_bad, jnp.nan, states.belief.std)
        )
        return dataclasses.replace(states, belief=belief), record

    with pytest.raises(StageError, match="mission: beliefs after 2 chunks are not finite"):
        play(step=diverging)


def test_values_that_are_not_finite_end_the_missions(play):
    def lost(keys, team, models, states):
        states, record = fake_step(keys, team, models, states)
        target = jnp.where((states.steps > CHUNK)[:, None], -1, states.robots.target)
        robots = dataclasses.replace(states.robots, target=target)
        return dataclasses.replace(states, robots=robots), record

    with pytest.raises(StageError, match="mission: values of policy naive are not finite"):
        play(step=lost)


def test_kept_programs_are_told_apart_by_the_policies_in_them(team, monkeypatch):
    made = []

    class Program:
        def __init__(self, compiler, stage, name, closed):
            made.append(closed)

        def compile(self, *args, **options):
            raise Stopped

    monkeypatch.setattr(missions, "Program", Program)
    for names in (["latent"], ["naive"], ["naive", "latent"]):
        with Compiler(Monitor()) as compiler, pytest.raises(Stopped):
            missions.Player(team.playing(names), compiler, 1)
    assert made[::2] == [("latent",), ("naive",), ("latent", "naive")]

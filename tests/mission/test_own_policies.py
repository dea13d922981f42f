"""Policies of missions: those of the table, and one of the user's own."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest
from teams import CONFIG, POSES, POSITIONS, decide_alone

from jaxsense import evaluate, mission, train
from jaxsense.config import ConfigError
from jaxsense.mission.outcome import require_playable
from jaxsense.mission.state import DRIVING, FAILED
from jaxsense.run import output, programs
from jaxsense.run.compilation import Compiler
from jaxsense.run.monitor import Monitor, StageError, Stopped


def last_first(key, models, known):
    """A policy of one's own, which visits the last PoI first and looks once at each."""
    del key, models
    number = len(known.looks)
    return jnp.append(jnp.where(known.is_seen, -1.0, jnp.arange(1.0, number + 1)), 0.0)


def lost(key, models, known):
    """A value that is NaN, of the last PoI."""
    del key, models, known
    return jnp.array([1.0, 0.5, jnp.nan, 0.0])


OWN = {"mine": last_first, "lost": lost}


@pytest.fixture(scope="module")
def own():
    return mission.make_mission(CONFIG, OWN)


@pytest.fixture(scope="module")
def decides(own, models):
    return jax.jit(lambda state: decide_alone(jax.random.key(0), own, models, state, 0))


def test_a_policy_of_ones_own_chooses_pois(own, decides, arena_of):
    state = arena_of(POSITIONS, POSES)
    state = replace(state, policy=jnp.int32(own.policy("mine")))
    assert decides(state).robots.target[0] == 2
    state = replace(state, times_seen=jnp.array([[0, 0], [0, 0], [0, 1]], jnp.int32))
    after = decides(state)
    assert (after.robots.target[0], after.robots.phase[0]) == (1, DRIVING)
    state = replace(state, times_seen=jnp.ones((3, 2), jnp.int32))
    assert decides(state).robots.target[0] == 3  # NOP


def test_a_robot_whose_policy_has_no_value_fails(own, decides, arena_of):
    state = arena_of(POSITIONS, POSES)
    state = replace(state, policy=jnp.int32(own.policy("lost")))
    after = decides(state).robots
    assert (after.target[0], after.phase[0], after.goals[0]) == (-1, FAILED, 0)
    # Not of a PoI that it has given up.
    given_up = state.robots.undetected.at[0, 2].set(True)
    state = replace(state, robots=replace(state.robots, undetected=given_up))
    assert decides(state).robots.phase[0] == DRIVING


def playing(*names):
    return replace(CONFIG, mission=replace(CONFIG.mission, policies=names))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("all", "must not be all, policies"),
        ("latent", "must not be latent, greedy, "),
        ("a/b", "must be a word of 1 to 64 letters"),
        ("", "must be a word of 1 to 64 letters"),
    ],
)
def test_the_name_of_a_policy_is_a_word_that_is_free(name, reason):
    with pytest.raises(ConfigError, match=rf"^policies = {name!r}: {reason}"):
        require_playable(CONFIG, {name: lost})


RUN = ["--preset", "smoke", "--quiet", "--mission.policies", "latent", "mine"]


def test_train_passes_own_policies_on_and_keeps_no_programs(tmp_path, monkeypatch):
    given = []

    def compiled(config, compiler, workers, trainings, policies):
        given.append((config.mission.policies, compiler.kept, policies))
        raise Stopped

    monkeypatch.setattr(train, "Programs", compiled)
    argv = [*RUN, "--out", str(tmp_path / "run"), "--cache", str(tmp_path / "cache")]
    with pytest.raises(SystemExit) as stop:
        train.main(argv, policies=OWN)
    assert stop.value.code == output.INTERRUPTED
    assert given == [(("latent", "mine"), None, OWN)]


def test_own_policies_reach_the_programs_of_a_run(monkeypatch):
    played = lambda mission, compiler, total, workers: mission  # noqa: E731
    monkeypatch.setattr(programs.missions, "Player", played)
    monkeypatch.setattr(programs.stages, "train", lambda drive, config: None)
    made = programs.Programs(playing("mine"), Compiler(Monitor()), policies=OWN)
    assert [*made.player.result().policies] == ["mine"]
    with pytest.raises(ConfigError, match=r"mission\.policies = \('mine',\): must be among"):
        require_playable(playing("mine"))


def test_evaluate_plays_own_policies_and_keeps_no_programs(tmp_path, monkeypatch, models, capsys):
    found = []

    class Player:
        def __init__(self, team, compiler, total, workers):
            found.append(([*team.policies], compiler.kept))

        def wait(self):
            pass

        def play(self, key, models, played, episodes):
            found.append([*played])
            raise StageError("mission", "made up")

    monkeypatch.setattr(evaluate.rundir, "load", lambda run, trust: (CONFIG, models))
    monkeypatch.setattr(evaluate, "_report", lambda run, config: None)
    monkeypatch.setattr(evaluate.missions, "Player", Player)
    options = ["--policy", "mine", "--cache", str(tmp_path / "cache")]
    with pytest.raises(SystemExit):
        evaluate.main([str(tmp_path), *options], OWN)
    assert "made up" in capsys.readouterr().err
    assert found == [(["mine"], None), ["mine"]]

"""Scores of policies in frozen tasks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import dqn, tasks
from jaxsense.config import ConfigError
from jaxsense.tasks import registry
from jaxsense.tasks.score import estimate
from jaxsense.tasks.task import EPISODES, Task

NAME = "map-v0"


def uniform(key, observation):
    return jax.random.randint(key, (), 0, 4)


def nop(key, observation):
    return jnp.int32(3)


@pytest.fixture(scope="module")
def of_uniform():
    return jaxsense.score(NAME, uniform)


def test_a_random_policy_reaches_what_the_random_reference_does(of_uniform):
    assert of_uniform.returns.shape == (10,)
    known = estimate(of_uniform.references["random"])
    assert known.low < of_uniform.mean_return.value < known.high
    assert of_uniform.has_optimum
    assert of_uniform.best == "optimal"


SETTINGS = {
    "jax_threefry_partitionable": False,
    "jax_random_seed_offset": 1,
    "jax_default_prng_impl": "rbg",
}


def test_a_score_does_not_depend_on_settings_of_random_numbers(of_uniform, monkeypatch):
    usual, task = {name: getattr(jax.config, name) for name in SETTINGS}, jaxsense.make(NAME)
    for name, value in SETTINGS.items():
        jax.config.update(name, value)
    try:
        found = jaxsense.score(NAME, [uniform])
        monkeypatch.setattr(Task, "references", ("random",))  # the others take time
        played = registry.reference_returns(task, 1, EPISODES)["random"]
    finally:
        for name, value in usual.items():
            jax.config.update(name, value)
    np.testing.assert_array_equal(found.returns, of_uniform.returns[:1])
    # Of 1,024 episodes one or two may round otherwise than where they were stored.
    np.testing.assert_allclose(played, task.returns[-1, :1], atol=2e-3)


def with_reward(task, reward):
    return dataclasses.replace(task, mdp=dataclasses.replace(task.mdp, reward=reward))


@pytest.mark.parametrize("reward", [dqn.Nats(0.2), dqn.Paper(0.0)])
def test_a_changed_task_has_no_score_under_its_name(reward):
    changed = with_reward(jaxsense.make("noisy-v0"), reward)
    with pytest.raises(ConfigError, match=r"task = Task: must be as made; give a changed"):
        jaxsense.score(changed, nop)


def test_a_task_with_a_name_of_its_own_is_compared_in_itself(monkeypatch):
    monkeypatch.setattr(Task, "references", ("optimal",))  # the others take time
    task = jaxsense.make("noisy-v0")
    named = dataclasses.replace(with_reward(task, dqn.Nats(0.2)), name="mine")
    found = jaxsense.score(named, [nop])
    assert found.task == "mine"
    # Looks cost .2 in place of .1 nats: the optimum earns less than the one that is stored.
    assert 0 < found.references["optimal"][0] < 0.9 * task.returns[0, 0]


def test_a_policy_on_the_host_may_use_jax_and_write_into_its_observations():
    def first_unknown(observations):
        observations -= 1.5
        widths = jnp.asarray(observations)[:, 2::4]
        return jnp.where(widths.max(axis=1) > 0, widths.argmax(axis=1), 3)

    assert jaxsense.score(NAME, [tasks.on_host(first_unknown)]).mean_return.value > 0


def test_the_interval_is_of_the_interquartile_mean():
    # The middle half of 1, 2, 3, 100: 2.5.
    found = estimate(np.array([3.0, 100.0, 1.0, 2.0]))
    assert found.value == 2.5
    assert 1 <= found.low < 2.5 < found.high <= 100
    # Of 0, 1, 1, 1, resamples with three zeros have 0: 13 of 256, and more than 1 of 40.
    assert estimate(np.array([0.0, 1.0, 1.0, 1.0])) == tasks.Estimate(1.0, 0.0, 1.0)
    assert estimate(np.array([1.0, 0.0, 0.0, 0.0])) == tasks.Estimate(0.0, 0.0, 1.0)
    assert estimate(np.array([4.0])) == tasks.Estimate(4.0, 4.0, 4.0)


def test_actions_from_the_host_stay_integers():
    def turns_real(observations):
        return np.full(len(observations), 2.7 if observations.any() else 2)

    with pytest.raises(jax.errors.JaxRuntimeError, match="act = turns_real: must return"):
        jaxsense.score(NAME, [tasks.on_host(turns_real)], episodes=1)


@pytest.mark.parametrize(
    "act", [lambda x: np.asarray(x).argmax(), lambda x: int(x[0]), lambda x: x[0] > 0 and 1]
)
def test_a_policy_that_cannot_be_traced_is_told_what_to_do(act):
    with pytest.raises(
        ValueError, match=r"^policy: must be a function .* wrap others in tasks\.on_host"
    ):
        jaxsense.score(NAME, lambda key, observation: act(observation), episodes=1)


def test_a_score_of_one_seed_shows_no_interval():
    returns = np.array([0.5])
    references = {"optimal": np.array([1.0]), "naive": np.array([0.25])}
    one = tasks.Score(NAME, "camera", returns, references, True)
    assert str(one).splitlines() == [
        f"{NAME}, camera, 1 seed: return 0.500",
        "  fraction of the optimum: 0.500",
        "  optimal: 1.000",
        "  naive: 0.250",
    ]
    # Where no optimum is known, the best rule takes its place.
    rules = {"nearest": np.array([0.25]), "auction": np.array([0.75])}
    team = tasks.Score("team-v0", "team", returns, rules, False)
    assert (team.best, team.fraction_of_optimal.value) == ("auction", pytest.approx(2 / 3))
    assert str(team).splitlines()[1] == "  fraction of the best rule, auction: 0.667"
    two = {name: np.repeat(found, 2) for name, found in references.items()}
    shown = str(tasks.Score(NAME, "camera", np.repeat(returns, 2), two, True)).splitlines()
    assert shown[0] == f"{NAME}, camera, 2 seeds: return 0.500 (0.500 to 0.500)"

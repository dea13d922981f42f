"""The scoreboard of the frozen tasks: its learners, its rows and its tables."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxsense
from benchmarks import dqn, peers, scoreboard
from jaxsense.dqn import Environment

make = functools.cache(jaxsense.make)


def peer(name, package):
    """The module of a library."""
    pytest.importorskip(package, reason=f"{package}: needs the extra of jaxsense")
    return peers.load(name) or pytest.skip(f"{name} cannot be imported")


def draws(policy, name):
    """Whether a policy draws its actions, from one observation."""
    _, state = make(name).reset(jax.random.key(0))
    seen, keys = make(name).observe(state), jax.random.split(jax.random.key(1), 64)
    return len(set(jax.vmap(policy, (0, None))(keys, seen).tolist())) > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map-v0", "team-v0"])
def test_our_dqn_trains_in_every_kind_of_task(name, monkeypatch):
    monkeypatch.setattr(dqn, "NUM_STARTS", 32)
    small = dqn.Dqn(num_envs=32, updates=1, batch=32, replay=1024)
    policies = small.train(make(name), (20, 21), 64)
    one, other = (jax.tree.leaves(policies[seed]) for seed in (20, 21))
    assert any((np.asarray(x) != np.asarray(y)).any() for x, y in zip(one, other, strict=True))
    assert not draws(policies[20], name)


def test_our_dqn_takes_the_best_action_of_what_it_learned_from():
    task, agent = make("team-v0"), make("team-v0").models.agent
    params, learning = agent.init(jax.random.key(1)), Environment(agent, task.mdp)

    @jax.vmap
    def start(key):
        state = learning.reset(key)
        values = agent.values(params, learning.observe(state))
        return dqn._act(task, agent, params, key, task.observe(state.now)), jnp.argmax(values)

    chosen, best = jax.jit(start)(jax.random.split(jax.random.key(2), 64))
    np.testing.assert_array_equal(chosen, best)
    assert len(set(best.tolist())) > 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_learners_of_rejax_train_and_ppo_draws_its_actions(number, monkeypatch):
    rejax = peer("rejax", "rejax")
    monkeypatch.setattr(rejax, "NUM_STARTS", 32)
    learner = dataclasses.replace(rejax.LEARNERS[number], num_envs=16)
    policies = learner.train(make("map-v0"), (20, 21), 1)
    assert [draws(policies[seed], "map-v0") for seed in (20, 21)] == [number == 1] * 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1, 2])
def test_learners_of_stable_baselines3_train_and_ppo_draws_its_actions(number, monkeypatch):
    sb3 = peer("sb3", "stable_baselines3")
    monkeypatch.setattr(sb3, "NUM_STARTS", 32)
    learner = dataclasses.replace(sb3.LEARNERS[number], num_envs=16)
    policy = learner.train(make("map-v0"), (20,), 1)[20]
    if number == 2:
        policy = Partial(lambda given, key, seen: given.act(key, given.memory, seen)[0], policy)
        policy = functools.partial(policy.func, policy.args[0])
    assert draws(policy, "map-v0") == (number > 0)


def env(sb3):
    """A space without dynamics."""

    class Env(sb3.gymnasium.Env):
        observation_space = sb3.gymnasium.spaces.Box(-10, 10, (6,))
        action_space = sb3.gymnasium.spaces.Discrete(5)

    return Env()


@pytest.fixture
def best(monkeypatch):
    """Policies of Stable-Baselines3 whose drawn action is the most likely one."""
    monkeypatch.setattr(jax.random, "categorical", lambda key, outputs: jnp.argmax(outputs))


@pytest.mark.parametrize("number", [0, 1])
def test_networks_of_stable_baselines3_choose_as_they_do_in_jax(number, best):
    sb3 = peer("sb3", "stable_baselines3")
    model = sb3.LEARNERS[number].make(env(sb3), 0)
    seen = np.random.default_rng(0).normal(size=(64, 6)).astype(np.float32)
    with sb3.torch.no_grad():
        for each in model.policy.parameters():
            each.normal_()
    chosen = jax.vmap(lambda x: sb3.LEARNERS[number].policy(model)(None, x))(seen)
    theirs = model.predict(seen, deterministic=True)[0]
    np.testing.assert_array_equal(chosen, theirs)
    assert len(set(theirs.tolist())) > 1


def test_a_recurrent_network_chooses_and_remembers_as_it_does_in_jax(best):
    sb3 = peer("sb3", "stable_baselines3")
    learner = sb3.RecurrentPpo(lstm=7)
    model = learner.make(env(sb3), 0)
    with sb3.torch.no_grad():
        for each in model.policy.parameters():
            each.normal_()
    policy = learner.policy(model)
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


@dataclasses.dataclass(frozen=True)
class Nop:
    """Learns nothing."""

    process: int = 0
    name = "nop"
    packages = ()

    def train(self, task, seeds, steps):
        return {seed: Partial(nop) for seed in reversed(seeds)}


def test_a_row_holds_all_seeds_and_its_origin():
    row = scoreboard.Job("map-v0", "camera", Nop(7), range(3), 64, "python -m x").do()
    assert row["returns"] == [0.0, 0.0, 0.0]
    assert (row["best"], len(row["best_returns"])) == ("optimal", 3)
    assert (row["settings"], row["steps"]) == ({"process": 7}, 64)
    assert row["about"]["command"] == "python -m x"
    json.dumps(row, allow_nan=False)

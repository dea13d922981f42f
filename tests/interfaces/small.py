"""MDPs for the interfaces: detections are drawn from a bank, and a JMVAE trains in seconds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jaxsense.config import MODALITIES, PRESETS, Config, JmvaeConfig, TeamConfig
from jaxsense.core.types import Samples
from jaxsense.dqn import episodes, map_mdp, policies, rewards
from jaxsense.dqn.map_mdp import MapMdp, MapState
from jaxsense.dqn.optimum import value_iteration
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.looks import Bank, make_mdp
from jaxsense.models import Models, init, make_in_place, make_jmvae
from jaxsense.vae import jmvae, readout

CONFIG = dataclasses.replace(
    PRESETS["smoke"], jmvae=JmvaeConfig(hidden=(32, 32), restarts=1, steps=3000, batch=64)
)
# A price of time that is a sum of powers of 2.
TEAM = dataclasses.replace(
    CONFIG,
    dqn=dataclasses.replace(CONFIG.dqn, task="team", observe="bank"),
    robots=("camera", "camera", "lidar"),
    team=TeamConfig(num_pois=(1, 4), second_cost=0.125),
)
ONLY_CAMERAS = dataclasses.replace(
    TEAM,
    modalities=("camera",),
    robots=("camera",),
    jmvae=dataclasses.replace(CONFIG.jmvae, reconstruction_weights=(10.0,)),
)


def noisy_bank(key: jax.Array, config: Config, samples: int = 256) -> Samples:
    """Detections that give the true label a probability of .98 to 1."""

    def of_sensor(key: jax.Array, name: str) -> jax.Array:
        labels = jnp.array(config.arena.label_of_class(MODALITIES[name]))
        sure = 1 - 0.02 * jax.random.uniform(key, (len(labels), samples, 1))
        is_label = jax.nn.one_hot(labels, len(config.arena.labels(MODALITIES[name])))[:, None]
        return jnp.where(is_label > 0, sure, 1 - sure)

    @jax.jit
    def of_all(key: jax.Array) -> Samples:
        keys = jax.random.split(key, len(config.modalities))
        return tuple(map(of_sensor, keys, config.modalities))

    return of_all(key)


@functools.cache
def trained() -> tuple[Models, Samples]:
    """Models of which the JMVAE is trained, and their detections."""
    models = init(jax.random.key(0), CONFIG)
    bank, model, settings = noisy_bank(jax.random.key(1), CONFIG), make_jmvae(CONFIG), CONFIG.jmvae
    train = jax.jit(lambda key, params: jmvae.train(key, params, model, bank, settings)[0])
    params = train(jax.random.key(2), models.jmvae)
    joint = jax.jit(jax.vmap(jax.vmap(lambda *x: jmvae.posterior(params, model, x))))
    classes = jax.tree.map(lambda x: x.mean(axis=1), joint(*bank))
    fusion = make_in_place(CONFIG, params, classes)
    return dataclasses.replace(models, jmvae=params, fusion=fusion), bank


@functools.cache
def small_mdp() -> MapMdp:
    """The MDP."""
    models, bank = trained()
    return make_mdp(CONFIG, models, Bank(bank)).map


@functools.cache
def team() -> TeamMdp:
    """The MDP of a team, with an untrained JMVAE."""
    mdp = make_mdp(TEAM, init(jax.random.key(0), TEAM), Bank(noisy_bank(jax.random.key(1), TEAM)))
    assert isinstance(mdp, TeamMdp)
    # No interface may have the lonely episodes.
    return dataclasses.replace(mdp, robots_each=1, alone=1.0, max_steps=12)


@functools.cache
def noiseless() -> tuple[MapMdp, MapState]:
    """The MDP where every look at a class sees the same, and `[1]` start of all episodes."""
    models, bank = trained()
    mdp = make_mdp(CONFIG, models, Bank(tuple(features[:, :1] for features in bank))).map
    classes, seen = jnp.array([2, 0, 1]), jnp.array([[0, 0], [0, 1], [1, 0]], bool)
    start = jax.jit(lambda key: map_mdp.reset(key, mdp, classes, seen))(jax.random.key(5))
    return mdp, jax.tree.map(lambda x: x[None], start)


def returns(act, number: int = 256) -> jax.Array:
    """`[number]` total rewards of the camera's agent, from random starts."""
    mdp, exact = small_mdp(), trained()[0].bayes

    def play(key):
        start_key, play_key = jax.random.split(key)
        start = episodes.reset(start_key, mdp, exact)
        return episodes.run_episode(play_key, mdp, exact, act, start, 0)[0]

    return jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(3), number))


def optimal_return() -> float:
    """The mean of the optimal policy's, by dynamic programming on the exact posterior."""
    mdp, (models, bank) = small_mdp(), trained()
    likelihoods = jax.vmap(jax.vmap(lambda x: models.bayes.log_likelihoods(x, 0)))(bank[0])
    values = value_iteration(
        likelihoods,
        rewards.make(CONFIG.mdp),
        lambda weights: readout.mixture(mdp.fusion.classes, weights),
        mdp.fusion.prior,
        CONFIG.mdp,
        horizon=4,
    )
    knowing = dataclasses.replace(models, look_values=(values,))
    optimal = policies.POLICIES["optimal"].values
    return float(returns(lambda key, known: policies.best(optimal(key, knowing, known))).mean())

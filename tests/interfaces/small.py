"""MDPs for the interfaces: detections are drawn from a bank, and a JMVAE trains in seconds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxsense.observe import Bank

from jaxsense.config import MODALITIES, PRESETS, Config, JmvaeConfig, TeamConfig
from jaxsense.dqn import belief_mdp, episodes, policies
from jaxsense.dqn.team_mdp import TeamMdp
from jaxsense.interfaces import map_mdp, team_mdp
from jaxsense.models import Models, init, make_jmvae
from jaxsense.vae import jmvae

CONFIG = dataclasses.replace(
    PRESETS["smoke"], jmvae=JmvaeConfig(hidden=(32, 32), restarts=1, steps=3000, batch=64)
)
# A price of time that is a sum of powers of 2, and the lonely episodes that no interface may have.
TEAM = dataclasses.replace(
    CONFIG,
    robots=("camera", "camera", "lidar"),
    team=TeamConfig(num_pois=(1, 4), robots_each=1, alone=1.0, second_cost=0.125, max_steps=12),
)
ONLY_CAMERAS = dataclasses.replace(
    TEAM,
    modalities=("camera",),
    robots=("camera",),
    jmvae=dataclasses.replace(CONFIG.jmvae, reconstruction_weights=(10.0,)),
)


def noisy_bank(key: jax.Array, config: Config, samples: int = 256) -> Bank:
    """Detections that give the true label a probability of .98 to 1."""
    features = []
    for k, name in zip(
        jax.random.split(key, len(config.modalities)), config.modalities, strict=True
    ):
        labels = jnp.array(config.arena.label_of_class(MODALITIES[name]))
        sure = 1 - 0.02 * jax.random.uniform(k, (len(labels), samples, 1))
        is_label = jax.nn.one_hot(labels, len(config.arena.labels(MODALITIES[name])))[:, None]
        features.append(jnp.where(is_label > 0, sure, 1 - sure))
    return tuple(features)


@functools.cache
def trained() -> tuple[Models, Bank]:
    """Models of which the JMVAE is trained, and its bank."""
    models = init(jax.random.key(0), CONFIG)
    bank, model, settings = noisy_bank(jax.random.key(1), CONFIG), make_jmvae(CONFIG), CONFIG.jmvae
    state = jmvae.start(models.jmvae, settings)
    train = jax.jit(lambda key, state: jmvae.train(key, state, model, bank, settings, 3000)[0])
    state = train(jax.random.key(2), state)
    return dataclasses.replace(models, jmvae=state.params), bank


@functools.cache
def small_mdp() -> belief_mdp.MapMdp:
    """The MDP."""
    models, bank = trained()
    return map_mdp(CONFIG, models, bank)


@functools.cache
def team() -> TeamMdp:
    """The MDP of a team, with an untrained JMVAE."""
    models = init(jax.random.key(0), TEAM)
    return team_mdp(TEAM, models, noisy_bank(jax.random.key(1), TEAM))


@functools.cache
def noiseless() -> tuple[belief_mdp.MapMdp, belief_mdp.MapState]:
    """The MDP where every look at a class sees the same, and `[1]` start of all episodes."""
    models, bank = trained()
    mdp = map_mdp(CONFIG, models, tuple(features[:, :1] for features in bank))
    classes, seen = jnp.array([2, 0, 1]), jnp.array([[0, 0], [0, 1], [1, 0]], bool)
    start = jax.jit(lambda key: belief_mdp.reset(key, mdp, classes, seen))(jax.random.key(5))
    return mdp, jax.tree.map(lambda x: x[None], start)


def returns(policy: policies.Policy, number: int = 256) -> jax.Array:
    """`[number]` total rewards of the camera's agent, from random starts."""
    mdp = small_mdp()

    def play(key):
        start_key, play_key = jax.random.split(key)
        start = belief_mdp.reset(start_key, mdp)
        return episodes.run_episode(play_key, mdp, policy, start, 0)[0]

    return jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(3), number))


def optimal_return() -> float:
    """The mean of the optimal policy's."""
    mdp = small_mdp()
    labels = [CONFIG.arena.label_of_class(MODALITIES[m]) for m in CONFIG.modalities]
    table = jax.jit(lambda key: policies.expected_rewards(key, mdp, 0, 256))(jax.random.key(4))
    return float(returns(policies.optimal(mdp, table, jnp.array(labels))).mean())

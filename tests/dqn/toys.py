"""MDPs without networks, whose rewards are known: toy looks and toy fusions."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxsense.config import MdpConfig
from jaxsense.config.learning import TeamConfig
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import policies, rewards
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.mdp import Mdp
from jaxsense.dqn.policies import Known
from jaxsense.dqn.team import Teams, Travel, alone

SENSORS = ("camera", "lidar")
TRAVEL = Travel(speed=0.2, turn_rate=1.0, view_distance=0.9, look_seconds=1.0)
# From the origin 1.0, 2.0 and 3.0 m to drive: 5, 10 and 15 s.
PLACES = jnp.array([[1.9, 0.0], [0.0, 2.9], [-3.9, 0.0]])


@pytree
class Certain:
    """A look shows the true class and which sensor has looked; a scene is the PoIs' classes."""

    num_modalities: int = struct.field(pytree_node=False, default=2)

    def scene(self, key, classes):
        return classes

    def observe(self, key, scene, poi, modality, distance):
        return jnp.stack([scene[poi], modality]).astype(jnp.float32), scene


@pytree
class Uniform(Certain):
    """A look shows a random number that only its key decides."""

    def observe(self, key, scene, poi, modality, distance):
        return jax.random.uniform(key, (1,)), scene


@pytree
class Toy:
    """A fusion of no classes in particular: what fusions of these tests share."""

    prior: Belief
    num_classes: int = struct.field(pytree_node=False)

    @property
    def classes(self):
        return Belief(*jnp.ones((2, self.num_classes, *self.prior.mean.shape)))

    def class_probabilities(self, belief):
        return jnp.full(self.num_classes, 1 / self.num_classes)


@pytree
class Counting(Toy):
    """The more modalities have looked, the better a PoI is known."""

    def update(self, belief, seen, features, modality, weight=1.0):
        number = jnp.sum(jnp.asarray(seen).at[modality].set(True))
        return Belief(features, jnp.array([[3.0, 4.0], [0.6, 0.8], [0.3, 0.4]])[number - 1])


@pytree
class Adding(Toy):
    """A look adds to the information what it shows."""

    def update(self, belief, seen, features, modality, weight=1.0):
        return Belief(features, 1.0 / (1.0 / belief.std + features))


@pytree
class Once(Toy):
    """Every look writes the same."""

    def update(self, belief, seen, features, modality, weight=1.0):
        return Belief(jnp.array([1.0, 0.0]), jnp.array([0.6, 0.8]))


@pytree
class Fixed:
    """PoIs and robots that are always at the same positions."""

    positions: jax.Array
    poses: jax.Array

    def draw(self, key, num_robots):
        return self.positions, self.poses


@pytree
class Ignorant:
    """An exact Bayes filter that learns nothing."""

    def log_likelihoods(self, features, modality):
        return jnp.zeros(3)


def known_of(log_posterior, looks, modality=0, belief=None):
    """What a robot alone knows of PoIs, by `[N, C]` logarithms of posteriors and `[N, M]` looks."""
    log_posterior, looks = jnp.asarray(log_posterior), jnp.asarray(looks, jnp.int32)
    number = len(looks)
    team = alone(number, modality)
    belief = Belief(*jnp.ones((2, number, 2))) if belief is None else belief
    return Known(belief, looks, log_posterior, team, jnp.ones((1, number)), jnp.int32(0))


def policy(name, **models):
    """`(key, known) -> action` of a policy in the table, by what it reads of models."""
    values = {**policies.POLICIES, **policies.UNORDERED}[name]
    return lambda key, known: policies.best(values(key, SimpleNamespace(**models), known))


def make_mdp(looks, fusion, num_pois, **config):
    settings = MdpConfig(**config)
    return Mdp(looks, fusion, rewards.make(settings), settings, num_pois, (0,))


def classes_mdp(num_pois=3, num_modalities=2, **config):
    """A look sees the true class, and a PoI that more modalities have seen is known better.

    A belief's mean is (class, last modality to look). Its std is (3, 4) after looks of one
    modality, information 1/5; (.6, .8) after looks of two, information 1; (.3, .4) after three,
    information 2. Before any, the variance is 20 each: information 1 / sqrt(40) = .158114.
    """
    given = {"min_increase": 0.01, "partly_seen_starts": True, **config}
    prior = Belief(jnp.zeros(2), jnp.full(2, jnp.sqrt(20.0)))
    return make_mdp(Certain(num_modalities), Counting(prior, 3), num_pois, **given)


def agent_of(mdp, hidden, discount=0.5, second_cost=0.0):
    """An agent of an MDP."""
    travel = None if mdp.teams is None else mdp.teams.travel
    sizes = mdp.num_pois, mdp.num_modalities, mdp.fusion.prior.mean.size
    return Agent(discount, second_cost, travel, *sizes, hidden)


def team_mdp_of(mapped, places, travel=TRAVEL, robots=None, max_steps=300, **given):
    """An MDP of random teams on a map; what is given are fields of `Teams` or of its settings."""
    names = {name: given.pop(name) for name in ("num_pois", "second_cost") if name in given}
    sensors = SENSORS[: mapped.num_modalities]
    return dataclasses.replace(
        mapped,
        config=dataclasses.replace(mapped.config, max_steps=max_steps),
        robots=jnp.arange(len(sensors)) if robots is None else robots,
        teams=Teams(TeamConfig(**names), travel, places, sensors, **given),
    )


def noisy_mdp(num_pois=3, max_steps=20):
    """Each look adds to a PoI's information a random number that only the look's key decides."""
    fusion = Adding(Belief(jnp.zeros(1), jnp.ones(1)), 3)
    return make_mdp(Uniform(), fusion, num_pois, min_increase=0.0, max_steps=max_steps)


def paying_once_mdp(num_pois=2, max_steps=20):
    """One modality; the first look at a PoI raises its information from .2 to 1, later ones fail.

    The belief is N((0, 0), (3, 4)^2) before and N((1, 0), (.6, .8)^2) after, whatever the class.
    """
    fusion = Once(Belief(jnp.zeros(2), jnp.array([3.0, 4.0])), 1)
    return make_mdp(Certain(1), fusion, num_pois, max_steps=max_steps, partly_seen_starts=False)


# Every state of two PoIs of `paying_once_mdp`. A first look gains .8 and a second costs 1; with
# gamma = .5, for look 0, look 1 and NOP:
ONCE_SEEN = jnp.array([[[0], [0]], [[1], [0]], [[0], [1]], [[1], [1]]], bool)
ONCE_Q = np.array(
    [
        [1.2, 1.2, 0.0],  # .8 + .5 x .8
        [-0.6, 0.8, 0.0],  # -1 + .5 x .8; .8 + .5 x 0
        [0.8, -0.6, 0.0],
        [-1.0, -1.0, 0.0],  # -1 + .5 x 0
    ]
)

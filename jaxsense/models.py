"""All trained networks of a run, as one pytree."""

import functools

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsense.config import Config
from jaxsense.core import networks
from jaxsense.core.networks import Params
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.dqn import optimum, policies
from jaxsense.dqn.optimum import LookValues
from jaxsense.sim import sensors
from jaxsense.vae import detectors, filtering, fusion, jmvae
from jaxsense.vae.detectors import Detector
from jaxsense.vae.fusion import FILTER
from jaxsense.vae.jmvae import Jmvae


@pytree
class Models:
    """All trained networks of a run.

    Attributes:
      detectors: one for each modality.
      jmvae: parameters of the JMVAE; those of the filter, if there is one, are its entry `filter`.
      class_beliefs: `[C, D]` mean joint posterior of each class, to read the map with.
      moments_inverse: `[C, 2D + 1]` from `filtering.moments_inverse`, to read the classes'
        probabilities from the map with.
      unseen: `[D]` entry of an unseen PoI.
      look_values: for each modality, what a look is worth by dynamic programming.
      q_networks: parameters of the Q-network of each modality; those of a team are the same.
      tours: parameters of the network that orders a team's looks, see `dqn.tours`; else None.
    """

    detectors: tuple[Detector, ...]
    jmvae: Params
    class_beliefs: Belief
    moments_inverse: jax.Array
    unseen: Belief
    look_values: tuple[LookValues, ...]
    q_networks: tuple[Params, ...]
    tours: Params | None

    @property
    def readout(self) -> Params:
        """What `filtering.weights` reads the map with."""
        return readout(self.moments_inverse, self.unseen)


def readout(moments_inverse: jax.Array, unseen: Belief) -> Params:
    """What `filtering.weights` reads the map with, see `Models`."""
    return {"inverse": moments_inverse, "unseen": unseen}


def make_jmvae(config: Config) -> Jmvae:
    """The JMVAE for the modalities and classes of a configuration."""
    sizes = tuple(len(config.labels(m)) for m in config.modalities)
    return Jmvae(config.modalities, sizes, config.jmvae.latent_size, config.jmvae.hidden)


def _q_network(config: Config) -> tuple[nn.Module, int]:
    """The Q-network, and the size of its input."""
    num_pois, size, number = config.arena.num_pois, config.jmvae.latent_size, len(config.modalities)
    if config.dqn.task == "team":
        network = policies.team_network(size, number, config.dqn)
        return network, network.features * num_pois
    return policies.q_network(num_pois, config.dqn.hidden), 2 * size * num_pois


def expected(
    table: jax.Array, first: jax.Array, weights: jax.Array, is_seen: jax.Array
) -> jax.Array:
    """`[N]` values of a look at each PoI, from one table of `LookValues`.

    Args:
      table: `[P]` values by the classes' probabilities.
      first: `[]` value of a look at an unseen PoI.
      weights: `[N, C]` the classes' probabilities.
      is_seen: `[N]` bool.
    """
    known = jax.vmap(functools.partial(optimum.interpolate, table))(weights)
    return jnp.where(is_seen, known, first)


def expected_gains(
    readout: Params, look_values: tuple[LookValues, ...], belief: Belief, is_seen: jax.Array
) -> jax.Array:
    """`[M, N]` reward that each modality's look at each PoI promises, by what the map shows.

    Args:
      readout: see `Models.readout`.
      look_values: of each modality.
      belief: `[N, D]` the map.
      is_seen: `[N]` bool.
    """
    on_map = jax.vmap(functools.partial(filtering.weights, readout))(belief)
    of_each = jax.tree.map(lambda *x: jnp.stack(x), *look_values)
    by_map = jax.vmap(expected, in_axes=(0, 0, None, None))
    return by_map(of_each.gain, of_each.first_gain, on_map, is_seen)


def init(key: Key, config: Config) -> Models:
    """Models with random parameters, to try the functions before training."""
    detector_key, jmvae_key, dqn_key = jax.random.split(key, 3)
    filter_key = jax.random.fold_in(jmvae_key, 1)
    num_labels = make_jmvae(config).feature_sizes
    keys = jax.random.split(detector_key, len(config.modalities))
    trained = tuple(
        detectors.init(k, jnp.zeros((2, s.window * s.channels)), size, config.detector)
        for k, s, size in zip(keys, sensors.make(config), num_labels, strict=True)
    )
    q_network, size = _q_network(config)
    dqn_keys = jax.random.split(dqn_key, len(config.modalities))
    tour_key = jax.random.fold_in(dqn_key, 1)
    shape = (len(config.arena.classes), config.jmvae.latent_size)
    params, classes = (
        jmvae.init(jmvae_key, make_jmvae(config)),
        Belief(jnp.zeros(shape), jnp.ones(shape)),
    )
    lattice = optimum.lattice(len(config.arena.classes), config.evaluation.value_points)
    no_values, nothing = jnp.zeros(len(lattice)), jnp.zeros(())
    unseen = fusion.unseen(make_jmvae(config), config.mdp.unseen_variance)
    if config.jmvae.fusion == "filter":
        inputs = make_jmvae(config), classes, unseen, config.filter
        params[FILTER] = filtering.init(filter_key, *inputs)
    return Models(
        detectors=trained,
        jmvae=params,
        class_beliefs=classes,
        moments_inverse=filtering.moments_inverse(classes),
        unseen=unseen,
        look_values=(LookValues(no_values, no_values, nothing, nothing),) * len(config.modalities),
        q_networks=tuple(networks.init(k, q_network, size) for k in dqn_keys),
        tours=networks.init(tour_key, q_network, size) if config.dqn.task == "team" else None,
    )

"""Map MDPs without networks, whose rewards are known."""

import jax
import jax.numpy as jnp
from jaxsense.dqn.belief_mdp import MapMdp

from jaxsense.config import MdpConfig
from jaxsense.core.types import Belief


def classes_mdp(num_pois=3, num_modalities=2, **config):
    """A look sees the true class, and a PoI that more modalities have seen is known better.

    An entry's mean is (class, last modality to look). Its std is (3, 4) after looks of one
    modality, information 1/5; (.6, .8) after looks of two, information 1; (.3, .4) after three,
    information 2. Unseen, the variance is 20 each: information 1 / sqrt(40) = .158114.
    """

    def observe(key, classes, poi, modality):
        return jnp.stack([classes[poi], modality]).astype(jnp.float32), classes

    def write(belief, seen, features, modality):
        number = jnp.sum(seen.at[modality].set(True))
        table = jnp.array([[3.0, 4.0], [0.6, 0.8], [0.3, 0.4]])
        return Belief(features, table[number - 1])

    return MapMdp(
        config=MdpConfig(**{"min_increase": 0.01, "partly_seen_starts": True, **config}),
        num_pois=num_pois,
        num_classes=3,
        num_modalities=num_modalities,
        unseen=Belief(jnp.zeros(2), jnp.full(2, jnp.sqrt(20.0))),
        new_scene=lambda key, classes: classes,
        observe=observe,
        write=write,
    )


def noisy_mdp(num_pois=3, max_steps=20):
    """Each look adds to a PoI's information a random number that only the look's key decides."""

    def observe(key, classes, poi, modality):
        return jax.random.uniform(key, (1,)), classes

    def write(belief, seen, features, modality):
        return Belief(features, 1.0 / (1.0 / belief.std + features))

    return MapMdp(
        config=MdpConfig(min_increase=0.0, max_steps=max_steps),
        num_pois=num_pois,
        num_classes=3,
        num_modalities=2,
        unseen=Belief(jnp.zeros(1), jnp.ones(1)),
        new_scene=lambda key, classes: classes,
        observe=observe,
        write=write,
    )


def paying_once_mdp(num_pois=2, max_steps=20):
    """One modality; the first look at a PoI raises its information from .2 to 1, later ones fail.

    The entry is N((0, 0), (3, 4)^2) before and N((1, 0), (.6, .8)^2) after, whatever the class.
    """
    return MapMdp(
        config=MdpConfig(max_steps=max_steps, partly_seen_starts=False),
        num_pois=num_pois,
        num_classes=1,
        num_modalities=1,
        unseen=Belief(jnp.zeros(2), jnp.array([3.0, 4.0])),
        new_scene=lambda key, classes: classes,
        observe=lambda key, classes, poi, modality: (jnp.ones(1), classes),
        write=lambda belief, seen, features, modality: Belief(
            jnp.array([1.0, 0.0]), jnp.array([0.6, 0.8])
        ),
    )

"""Another reward, and a Q-network that learns from it: `python examples/new_reward.py`."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxsense
from jaxsense import Belief, dqn, pytree
from jaxsense.config import MdpConfig


@pytree
class Confident:
    """Rewards a look for the probability of the most likely class that it adds, minus a cost."""

    config: MdpConfig
    is_of_labels = False  # classes count, not only the labels of a sensor

    def information(self, belief: Belief, probabilities: jax.Array) -> jax.Array:
        """Probability of the most likely class, `[]`."""
        return jnp.max(probabilities)

    def of_gain(self, gain: jax.Array) -> jax.Array:
        """The reward of a look, `[...]`, by what it has added."""
        return gain - self.config.look_cost


if __name__ == "__main__":
    config, models = jaxsense.load_pretrained("default")  # or those of `jaxsense.load("runs/...")`
    look_key, train_key = jax.random.split(jax.random.key(0))
    settings = jaxsense.PRESETS["smoke"].dqn  # a short training
    looks = jaxsense.Bank(jaxsense.detections(look_key, config, models, samples=64))
    mdp, reward = jaxsense.make_mdp(config, models, looks), Confident(config.mdp)
    learning = dqn.Environment(models.agent, dataclasses.replace(mdp, reward=reward))
    settings = dataclasses.replace(settings, target_period=5, epsilon_decay=0.9)
    state, info = jax.jit(lambda key: dqn.train(key, learning, settings))(train_key)
    for name, part in (("first", slice(1, 16)), ("last", slice(-15, None))):
        print(f"episode return in the {name} 15 epochs: {info.episode_return[part].mean():.3f}")

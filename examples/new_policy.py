"""A custom policy, in the MDP of one robot and in missions: `python examples/new_policy.py`."""

from dataclasses import replace

import jax
import jax.numpy as jnp

import jaxsense
from jaxsense import dqn
from jaxsense.dqn import episodes, policies


def widest(key: jax.Array, models: policies.Trained, known: dqn.Known) -> jax.Array:
    """Values of actions, `[N + 1]`: looks at the PoI with the widest belief, twice at most."""
    width = jnp.linalg.norm(known.belief.std, axis=-1)
    is_left = known.looks[:, known.modality] < 2
    return jnp.append(jnp.where(is_left, width, -1.0), 0.0)  # NOP, the last, has a value of 0


if __name__ == "__main__":
    config, models = jaxsense.load_pretrained("noisy")  # or those of `jaxsense.load("runs/...")`
    start_key, play_key = jax.random.split(jax.random.key(0))
    mdp = jaxsense.make_mdp(replace(config, dqn=replace(config.dqn, task="map")), models)

    def act(key: jax.Array, known: dqn.Known, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
        """The action in the MDP, and what is remembered: nothing."""
        return policies.best(widest(key, models, known)), memory

    start = episodes.reset(start_key, mdp, models.bayes)
    play = jax.jit(lambda key: episodes.run_episode(key, mdp, models.bayes, act, start))
    total, first = play(play_key)
    print(f"one robot: total reward {total:.2f}, of the first look {first:.2f}")
    print(jaxsense.score_missions(config, models, {"widest": widest}, episodes=64))

"""Another fusion, a product of experts: `python examples/new_fusion.py`."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxsense
from jaxsense import dqn, mission, pytree, vae


@pytree
class Product(vae.InPlace):
    """A look multiplies the belief with what it says alone, and the prior counts once."""

    accumulates = True  # looks add up

    def update(self, belief, seen, features, modality, weight=1.0):
        """The belief after one more look, whichever sensors have `seen` the PoI."""
        return vae.product_of_experts(belief, self.together({modality: features}), self.prior)


def multiplying(models: jaxsense.Models) -> jaxsense.Models:
    """The same networks with another fusion."""
    parts = {part.name: getattr(models.fusion, part.name) for part in dataclasses.fields(Product)}
    return dataclasses.replace(models, fusion=Product(**parts))


if __name__ == "__main__":
    config, trained = jaxsense.load_pretrained("default")  # or `jaxsense.load("runs/...")`
    models, scenario = multiplying(trained), mission.make_mission(config)
    start_key, reset_key, play_key, *keys = jax.random.split(jax.random.key(0), 6)
    of_one = dataclasses.replace(config, dqn=dataclasses.replace(config.dqn, task="map"))
    mdp, step = jaxsense.make_mdp(of_one, models), jax.jit(dqn.step)
    state = dqn.reset(start_key, mdp, seen=jnp.zeros((mdp.num_pois, 2), bool))
    for look, key in enumerate(keys):
        state, outcome = step(key, mdp.of(jnp.int32(look % 2)), state, jnp.int32(0))
        print(f"sigma {state.belief.std[0]} after look {look + 1}, reward {outcome.reward:.2f}")
    reset = jax.jit(lambda key: mission.reset(key, scenario, models))
    play = jax.jit(lambda key, state: mission.rollout(key, scenario, models, state, 150)[0])
    print(f"looks in a mission:\n{play(play_key, reset(reset_key)).times_seen}")

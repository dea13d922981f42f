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
    key, models = jax.random.key(0), multiplying(trained)
    mdp, step = jaxsense.make_mdp(config, models), jax.jit(dqn.step)
    state = dqn.reset(key, mdp, seen=jnp.zeros((mdp.num_pois, 2), bool))
    for look in range(3):
        state, outcome = step(jax.random.key(look), mdp, state, jnp.int32(0), jnp.int32(look % 2))
        print(f"sigma {state.belief.std[0]} after look {look + 1}, reward {outcome.reward:.2f}")
    scenario = mission.make_mission(config)
    play = jax.jit(lambda k, m: mission.rollout(k, scenario, m, mission.reset(k, scenario, m), 150))
    print(f"looks in a mission:\n{play(key, models)[0].times_seen}")

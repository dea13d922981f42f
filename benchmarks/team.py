"""The MDP of a team: choices per second of random teams, without learning."""

import dataclasses

import jax
import jax.numpy as jnp

from benchmarks import measure
from benchmarks.maps import untrained_task
from benchmarks.measure import Options, Row
from jaxsense import models, observe
from jaxsense.config import PRESETS
from jaxsense.dqn import team_mdp as teams


def team_mdp(options: Options) -> Row:
    """Random choices in 512 environments with the settings of `team`; ended episodes restart."""
    number, steps = (16, 4) if options.quick else (512, 200)
    task, _ = untrained_task(PRESETS["team"].dqn)
    config = dataclasses.replace(task.config, team=PRESETS["team"].team)
    shape = models.make_jmvae(config)

    @jax.jit
    def begin(keys: jax.Array, params, bank) -> teams.TeamState:
        mdp = observe.team_mdp(config, bank, params, shape)
        return jax.vmap(lambda key: teams.reset(key, mdp))(keys)

    def play(key: jax.Array, starts: teams.TeamState, params, bank) -> jax.Array:
        mdp = observe.team_mdp(config, bank, params, shape)
        choice_key, look_key = jax.random.split(key)
        draws = jax.random.uniform(choice_key, (steps, number))
        keys = jax.random.split(look_key, (steps, number))

        def step(states, drawn):
            draw, keys = drawn
            present = jnp.sum(states.team.present, axis=1)
            choice = jnp.floor(draw * (present + 1)).astype(jnp.int32)
            choice = jnp.where(choice == present, mdp.map.num_pois, choice)
            states, outcome = jax.vmap(lambda k, s, a: teams.step(k, mdp, s, a))(
                keys, states, choice
            )
            ended = outcome.terminated | outcome.truncated
            states = jax.tree.map(
                lambda x, y: jnp.where(ended.reshape(-1, *[1] * (x.ndim - 1)), x, y),
                starts,
                states,
            )
            return states, outcome.reward

        return jax.lax.scan(step, starts, (draws, keys))[1]

    networks = task.params, task.bank
    # A start looks at everything it has seen; a training prepares them once.
    starts = begin(jax.random.split(jax.random.key(1), number), *networks)
    inputs = jax.random.key(0), starts, *networks
    side = measure.compiled(play, *inputs, work=number * steps, batch=number)
    return measure.compare("team_mdp", "env-steps/s", [side], [], options)

"""The MDP of teams: choices per second of random teams, without learning."""

import jax
import jax.numpy as jnp

from benchmarks import measure
from benchmarks.dqn import untrained_task
from benchmarks.measure import Options, Row
from jaxsense import PRESETS, Bank, init, make_mdp
from jaxsense.dqn import Mdp, State, reset, step


def team_mdp(options: Options) -> Row:
    """Random choices in 512 environments with the settings of `team`; ended episodes restart."""
    number, steps = (16, 4) if options.quick else (512, 200)
    config = PRESETS["team"]
    task = untrained_task(PRESETS["default"].dqn)
    mdp = make_mdp(config, init(jax.random.key(0), config), Bank(task.bank))

    @jax.jit
    def begin(keys: jax.Array, mdp: Mdp) -> State:
        return jax.vmap(lambda key: reset(key, mdp))(keys)

    def play(key: jax.Array, starts: State, mdp: Mdp) -> jax.Array:
        choice_key, look_key = jax.random.split(key)
        draws = jax.random.uniform(choice_key, (steps, number))
        keys = jax.random.split(look_key, (steps, number))

        def choose(states, drawn):
            draw, keys = drawn
            present = jnp.sum(states.team.present, axis=1)
            choice = jnp.floor(draw * (present + 1)).astype(jnp.int32)
            choice = jnp.where(choice == present, mdp.num_pois, choice)
            states, outcome = jax.vmap(lambda k, s, a: step(k, mdp, s, a))(keys, states, choice)
            ended = outcome.terminated | outcome.truncated
            states = jax.tree.map(
                lambda x, y: jnp.where(ended.reshape(-1, *[1] * (x.ndim - 1)), x, y),
                starts,
                states,
            )
            return states, outcome.reward

        return jax.lax.scan(choose, starts, (draws, keys))[1]

    # A start looks at everything it has seen; a training prepares them once.
    starts = begin(jax.random.split(jax.random.key(1), number), mdp)
    inputs = jax.random.key(0), starts, mdp
    side = measure.compiled(play, *inputs, work=number * steps, batch=number)
    return measure.compare("team_mdp", "env-steps/s", [side], [], options)

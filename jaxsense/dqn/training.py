"""Deep Q-learning in many environments side by side (Mnih et al. 2015), as pure functions.

Random numbers are drawn once for a whole chunk of epochs: in the loop they would dominate its cost.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from jaxsense.config import DqnConfig
from jaxsense.core import checks
from jaxsense.core.networks import Params
from jaxsense.core.supervised import adam
from jaxsense.core.types import Key, Transition, pytree
from jaxsense.dqn import replay
from jaxsense.dqn.agent import Environment, Underway

Evaluate = Callable[[Key, Params], jax.Array]
"""`(key, parameters) -> []` total reward of the learned policy."""
_EVALUATED = 10  # epochs
_FIRST_EPSILON = 1.0
_FINAL_RATE = 0.01  # share of the learning rate that is left in the last epoch


@pytree
class DqnState:
    """State of a training between two chunks of epochs.

    Attributes:
      envs: `[E]` states of the environments.
      done: `[E]` bool, environments whose episode has ended.
      total_reward: `[E]` reward of each environment's episode so far.
    """

    params: Params
    target: Params
    optimiser: optax.OptState
    replay: replay.Replay
    envs: Underway
    done: jax.Array
    total_reward: jax.Array
    epoch: jax.Array


@pytree
class EpochInfo:
    """Metrics of one epoch.

    Attributes:
      loss: `[]` mean over the gradient steps.
      episode_return: `[]` mean total reward of the exploring policy's episodes that ended.
      episodes: `[]` int32 episodes that ended.
      evaluation_return: `[]` mean total reward of the learned policy after the epoch; NaN in epochs
        without an evaluation, see `train_chunk`; None if there is none.
      epsilon: `[]` chance of a random action.
      is_finite: `[]` bool, whether values, rewards, loss and new parameters are finite.
    """

    loss: jax.Array
    episode_return: jax.Array
    episodes: jax.Array
    evaluation_return: jax.Array | None
    epsilon: jax.Array
    is_finite: jax.Array


@pytree
class _Draws:
    """Random numbers of one epoch.

    Attributes:
      coin: `[E]` in [0, 1), below epsilon to explore.
      action: `[E]` in [0, 1), for the action to explore.
      start: `[E]` int32 start to follow an ended episode.
      step: `[E]` keys of the steps.
      replay: `[updates, blocks, 2]` in [0, 1), see `replay.sample`.
    """

    coin: jax.Array
    action: jax.Array
    start: jax.Array
    step: jax.Array
    replay: jax.Array


def init(key: Key, environment: Environment, config: DqnConfig, prepared: Underway) -> DqnState:
    """The state before the first chunk: a new network, an empty replay, no episode started.

    Args:
      prepared: from `starts`; only its shapes matter.
    """
    envs = jax.tree.map(lambda x: jnp.zeros((config.num_envs, *x.shape[1:]), x.dtype), prepared)
    size = jax.eval_shape(jax.vmap(environment.observe), prepared).shape[1]
    params = environment.agent.init(key)
    rounds, blocks = config.replay_capacity // config.num_envs, config.num_envs // config.block
    return DqnState(
        params=params,
        target=params,
        optimiser=_optimiser(config).init(params),
        replay=replay.init(size, rounds, blocks, config.block),
        envs=envs,
        done=jnp.ones(config.num_envs, bool),
        total_reward=jnp.zeros(config.num_envs),
        epoch=jnp.int32(0),
    )


def starts(key: Key, environment: Environment, config: DqnConfig) -> Underway:
    """Random states, `[num_starts]`, for episodes to start from.

    A training prepares them once: a start simulates every look already taken, which costs far more
    than a step.
    """
    return jax.vmap(environment.reset)(jax.random.split(key, config.num_starts))


def train(key: Key, environment: Environment, config: DqnConfig) -> tuple[DqnState, EpochInfo]:
    """Trains one agent by deep Q-learning; `vmap` over `key` for several seeds."""
    checks.require_key(key)
    init_key, start_key, chunk_key = jax.random.split(key, 3)
    prepared = starts(start_key, environment, config)
    state = init(init_key, environment, config, prepared)
    keys = jax.random.split(chunk_key, config.epochs // config.chunk)
    state, infos = jax.lax.scan(
        lambda state, key: train_chunk(key, environment, config, state, prepared), state, keys
    )
    return state, jax.tree.map(lambda x: x.reshape(-1), infos)


def train_chunk(
    key: Key,
    environment: Environment,
    config: DqnConfig,
    state: DqnState,
    prepared: Underway,
    evaluate: Evaluate | None = None,
) -> tuple[DqnState, EpochInfo]:
    """Trains for `config.chunk` epochs.

    Args:
      prepared: `[num_starts]` from `starts`. Each environment has a share of them, and starts every
        episode from a random one of its share.
      evaluate: called after every tenth epoch, or after the last if ten do not divide the chunk.
    """
    chex.assert_tree_shape_prefix(prepared, (config.num_starts,))
    shares = jax.tree.map(lambda x: x.reshape(config.num_envs, -1, *x.shape[1:]), prepared)
    *draw_keys, evaluation_key = jax.random.split(key, 4)
    draws = _draw(draw_keys, config)
    epoch = functools.partial(_epoch, environment, config, shares)
    if evaluate is None:
        return jax.lax.scan(epoch, state, draws)
    every = _EVALUATED if config.chunk % _EVALUATED == 0 else config.chunk

    def advance(state: DqnState, of_group: tuple[Key, _Draws]) -> tuple[DqnState, EpochInfo]:
        key, draws = of_group
        state, infos = jax.lax.scan(epoch, state, draws)
        found = jnp.full(every, jnp.nan).at[-1].set(evaluate(key, state.params))
        return state, dataclasses.replace(infos, evaluation_return=found)

    keys = jax.random.split(evaluation_key, config.chunk // every)
    groups = jax.tree.map(lambda x: x.reshape(-1, every, *x.shape[1:]), draws)
    state, infos = jax.lax.scan(advance, state, (keys, groups))
    return state, jax.tree.map(lambda x: x.reshape(-1), infos)


def _draw(keys: Sequence[Key], config: DqnConfig) -> _Draws:
    """Random numbers of `[chunk]` epochs."""
    env_key, step_key, replay_key = keys
    shape, blocks = (config.chunk, config.num_envs), config.batch // config.block
    coin, action, start = jax.random.uniform(env_key, (3, *shape))
    return _Draws(
        coin=coin,
        action=action,
        start=jnp.floor(start * (config.num_starts // config.num_envs)).astype(jnp.int32),
        step=jax.random.split(step_key, shape),
        replay=jax.random.uniform(replay_key, (config.chunk, config.updates, blocks, 2)),
    )


def _epoch(
    environment: Environment,
    config: DqnConfig,
    shares: Underway,
    state: DqnState,
    draws: _Draws,
) -> tuple[DqnState, EpochInfo]:
    """One step of each environment and `config.updates` gradient steps."""
    decay = jax.lax.pow(jnp.asarray(config.epsilon_decay, jnp.float32), state.epoch)
    epsilon = jnp.maximum(config.epsilon_min, _FIRST_EPSILON * decay)
    started = _restart(draws.start, state.envs, shares, state.done)
    envs, has_ended, transitions, values = _explore(
        environment, config, state.params, started, epsilon, draws
    )
    memory = replay.add(state.replay, transitions)

    total_reward = state.total_reward + transitions.r_t
    episodes = jnp.sum(has_ended)
    ended_reward = jnp.sum(jnp.where(has_ended, total_reward, 0.0))

    params, optimiser, loss = _learn(config, environment, state, memory, draws.replay)
    target = optax.periodic_update(params, state.target, state.epoch + 1, config.target_period)
    checked = values, transitions.r_t, loss, params
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(checked)]).all()
    info = EpochInfo(
        loss=loss,
        episode_return=ended_reward / jnp.maximum(episodes, 1),
        episodes=episodes,
        evaluation_return=None,
        epsilon=epsilon,
        is_finite=is_finite,
    )
    state = DqnState(
        params=params,
        target=target,
        optimiser=optimiser,
        replay=memory,
        envs=envs,
        done=has_ended,
        total_reward=jnp.where(has_ended, 0.0, total_reward),
        epoch=state.epoch + 1,
    )
    return state, info


def _explore(
    environment: Environment,
    config: DqnConfig,
    params: Params,
    started: Underway,
    epsilon: jax.Array,
    draws: _Draws,
) -> tuple[Underway, jax.Array, Transition, jax.Array]:
    """Next states, which episodes have ended, transitions and `[A, E]` values before them."""
    s_tm1 = jax.vmap(environment.observe, out_axes=-1)(started)
    values = environment.agent.values(params, s_tm1)
    highest = jnp.argmax(values, axis=0).astype(jnp.int32)
    a_tm1 = jnp.where(draws.coin < epsilon, _explored(started, draws.action), highest)

    columns = Transition(-1, 0, 0, 0, -1)  # pyright: ignore[reportArgumentType]
    steps = jax.vmap(environment.step, in_axes=(0, 0, -1, 0), out_axes=(0, columns, 0))
    envs, transitions, outcome = steps(draws.step, started, s_tm1, a_tm1)
    return envs, outcome.terminated | outcome.truncated, transitions, values


def _explored(states: Underway, draws: jax.Array) -> jax.Array:
    """Random `[E]` int32 actions that exist in `[E]` states, from `[E]` draws in [0, 1)."""
    exist = jax.vmap(lambda state: state.now.team.action_mask)(states)
    number = jnp.floor(draws * jnp.sum(exist, axis=1, dtype=draws.dtype)).astype(jnp.int32)
    return jnp.argmax(jnp.cumsum(exist, axis=1) > number[:, None], axis=1).astype(jnp.int32)


def _learn(
    config: DqnConfig,
    environment: Environment,
    state: DqnState,
    memory: replay.Replay,
    draws: jax.Array,
) -> tuple[Params, optax.OptState, jax.Array]:
    """Gradient steps, one for each of the `[updates, blocks, 2]` draws."""
    optimiser = _optimiser(config)

    def loss(params: Params, batch: Transition) -> jax.Array:
        q_tm1 = environment.agent.q(params, batch.s_tm1)
        q_t = environment.agent.values(state.target, batch.s_t)
        error = td_error(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t)
        return jnp.mean(pseudo_huber(error))

    def update(carry, draws: jax.Array):
        params, optimiser_state = carry
        batch = replay.sample(draws, memory)
        value, gradient = jax.value_and_grad(loss)(params, batch)
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), value

    (params, optimiser_state), values = jax.lax.scan(update, (state.params, state.optimiser), draws)
    return params, optimiser_state, jnp.mean(jnp.asarray(values))


def _optimiser(config: DqnConfig) -> optax.GradientTransformation:
    return adam(config.learning_rate, config.epochs * config.updates, _FINAL_RATE)


def _restart(rows: jax.Array, envs: Underway, shares: Underway, done: jax.Array) -> Underway:
    """Restarts each environment that needs it from that row of its share."""

    def pick(env: jax.Array, share: jax.Array) -> jax.Array:
        mask = done.reshape(-1, *[1] * (env.ndim - 1))
        return jnp.where(mask, share[jnp.arange(len(rows)), rows], env)

    return jax.tree.map(pick, envs, shares)


def td_error(
    q_tm1: Float[Array, "A ..."],
    a_tm1: Int[Array, "..."],
    r_t: Float[Array, "..."],
    discount_t: Float[Array, "..."],
    q_t: Float[Array, "A ..."],
) -> Float[Array, "..."]:
    """One-step Q-learning error (Mnih et al. 2015, Eq. 2) of one or many transitions.

    Args:
      discount_t: discount factor, 0 where the episode ended.
      q_t: the target network's values after the action; no gradient flows into them.
    """
    chex.assert_equal_shape([a_tm1, r_t, discount_t])
    chex.assert_shape([q_tm1, q_t], (q_tm1.shape[0], *a_tm1.shape))
    target = r_t + discount_t * jnp.max(q_t, axis=0)
    # Cheaper than indexing, whose gradient is a scatter.
    actions = jnp.arange(q_tm1.shape[0]).reshape(-1, *[1] * a_tm1.ndim)
    value = jnp.sum(jnp.where(actions == a_tm1[None], q_tm1, 0.0), axis=0)
    return jax.lax.stop_gradient(target) - value


def pseudo_huber(error: Float[Array, "..."]) -> Float[Array, "..."]:
    """`sqrt(1 + e^2) - 1`: quadratic near zero, linear far away, smooth everywhere."""
    return jnp.sqrt(1.0 + error**2) - 1.0

"""Deep Q-learning over many environments at once (Mnih et al. 2015), as pure functions."""

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxsense.config import DqnConfig
from jaxsense.dqn import belief_mdp, losses, replay
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.dqn.policies import q_network
from jaxsense.training import Params
from jaxsense.types import Key, Transition


@struct.dataclass
class DqnState:
    """Everything that training carries from one chunk of epochs to the next.

    Attributes:
      params: of the Q-network.
      target: of the target network.
      optimiser: state of Adam.
      replay: the replay memory.
      envs: `[E]` states of the environments.
      needs_start: `[E]` bool, environments whose episode has ended.
      total_reward: `[E]` reward of each environment's episode so far.
      epoch: `[]` int32 epochs so far.
    """

    params: Params
    target: Params
    optimiser: optax.OptState
    replay: replay.Replay
    envs: MapState
    needs_start: jax.Array
    total_reward: jax.Array
    epoch: jax.Array


@struct.dataclass
class EpochInfo:
    """What happened in one epoch.

    Attributes:
      loss: `[]` mean over the gradient steps.
      episode_return: `[]` mean total reward of the episodes that ended, of the exploring policy.
      episodes: `[]` int32 episodes that ended.
      epsilon: `[]` chance of a random action.
    """

    loss: jax.Array
    episode_return: jax.Array
    episodes: jax.Array
    epsilon: jax.Array


def init(key: Key, mdp: MapMdp, config: DqnConfig) -> DqnState:
    """A fresh network, an empty replay, and environments that wait for their first start."""
    shapes = jax.eval_shape(lambda: _starts(key, mdp, config.num_envs))
    envs = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    s = belief_mdp.as_state(jax.tree.map(lambda x: x[0], envs.belief))
    params = q_network(mdp, config.hidden).init(key, s)
    example = Transition(s, jnp.int32(0), jnp.float32(0), jnp.float32(0), s)
    return DqnState(
        params=params,
        target=params,
        optimiser=_optimiser(config).init(params),
        replay=replay.init(example, config.replay_capacity),
        envs=envs,
        needs_start=jnp.ones(config.num_envs, bool),
        total_reward=jnp.zeros(config.num_envs),
        epoch=jnp.int32(0),
    )


def train(key: Key, mdp: MapMdp, modality: int, config: DqnConfig) -> tuple[DqnState, EpochInfo]:
    """A whole training; `vmap` over `key` for several seeds.

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor; static.
      config: the settings.

    Returns:
      The last state and the `[epochs]` infos.
    """
    init_key, chunk_key = jax.random.split(key)
    state = init(init_key, mdp, config)
    keys = jax.random.split(chunk_key, config.epochs // config.chunk)
    state, infos = jax.lax.scan(
        lambda state, key: train_chunk(key, mdp, modality, config, state), state, keys
    )
    return state, jax.tree.map(lambda x: x.reshape(-1), infos)


def train_chunk(
    key: Key, mdp: MapMdp, modality: int, config: DqnConfig, state: DqnState
) -> tuple[DqnState, EpochInfo]:
    """`config.chunk` epochs.

    Episodes that end are followed by one of `num_starts` start states that are prepared here, once
    for the chunk; a start takes a look at everything that has been seen in it, which would cost far
    more than a step if every environment prepared its own at every step.

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor; static.
      config: the settings.
      state: the present state.

    Returns:
      The next state and the `[chunk]` infos.
    """
    start_key, epoch_key = jax.random.split(key)
    starts = _starts(start_key, mdp, config.num_starts)
    keys = jax.random.split(epoch_key, config.chunk)
    return jax.lax.scan(
        lambda state, key: _epoch(key, mdp, modality, config, starts, state), state, keys
    )


def _epoch(
    key: Key, mdp: MapMdp, modality: int, config: DqnConfig, starts: MapState, state: DqnState
) -> tuple[DqnState, EpochInfo]:
    explore_key, step_key, start_key, learn_key = jax.random.split(key, 4)
    epsilon = jnp.maximum(
        config.epsilon_min, config.epsilon_start * config.epsilon_decay**state.epoch
    )

    started = _restart(start_key, state.envs, starts, state.needs_start)
    s_tm1 = jax.vmap(belief_mdp.as_state)(started.belief)
    a_tm1 = _epsilon_greedy(explore_key, mdp, config, state.params, s_tm1, epsilon)
    step_keys = jax.random.split(step_key, config.num_envs)
    envs, outcome = jax.vmap(lambda k, env, a: belief_mdp.step(k, mdp, env, a, modality))(
        step_keys, started, a_tm1
    )
    s_t = jax.vmap(belief_mdp.as_state)(envs.belief)
    discount_t = jnp.where(outcome.is_over, 0.0, 1.0)
    transitions = Transition(s_tm1, a_tm1, outcome.reward, discount_t, s_t)
    memory = replay.add(state.replay, transitions)

    has_ended = outcome.is_over | outcome.is_cut
    total_reward = state.total_reward + outcome.reward
    episodes = jnp.sum(has_ended)
    ended_reward = jnp.sum(jnp.where(has_ended, total_reward, 0.0))

    params, optimiser, loss = _learn(learn_key, mdp, config, state, memory)
    is_copied = (state.epoch + 1) % config.target_period == 0
    target = jax.tree.map(lambda new, old: jnp.where(is_copied, new, old), params, state.target)
    info = EpochInfo(loss, ended_reward / jnp.maximum(episodes, 1), episodes, epsilon)
    state = DqnState(
        params=params,
        target=target,
        optimiser=optimiser,
        replay=memory,
        envs=envs,
        needs_start=has_ended,
        total_reward=jnp.where(has_ended, 0.0, total_reward),
        epoch=state.epoch + 1,
    )
    return state, info


def _epsilon_greedy(key: Key, mdp: MapMdp, config: DqnConfig, params: Params, s, epsilon):
    coin_key, action_key = jax.random.split(key)
    values = jnp.asarray(q_network(mdp, config.hidden).apply(params, s))
    chex.assert_shape(values, (config.num_envs, mdp.num_pois + 1))
    explores = jax.random.uniform(coin_key, (config.num_envs,)) < epsilon
    random = jax.random.randint(action_key, (config.num_envs,), 0, mdp.num_pois + 1)
    return jnp.where(explores, random, jnp.argmax(values, axis=-1).astype(jnp.int32))


def _learn(key: Key, mdp: MapMdp, config: DqnConfig, state: DqnState, memory: replay.Replay):
    """`config.updates` gradient steps."""
    network = q_network(mdp, config.hidden)
    optimiser = _optimiser(config)

    def loss(params: Params, batch: Transition) -> jax.Array:
        q_tm1 = jnp.asarray(network.apply(params, batch.s_tm1))
        q_t = jnp.asarray(network.apply(state.target, batch.s_t))
        error = jax.vmap(losses.td_error)(
            q_tm1, batch.a_tm1, batch.r_t, config.discount * batch.discount_t, q_t
        )
        return jnp.mean(losses.pseudo_huber(error))

    def update(carry, key: Key):
        params, optimiser_state = carry
        batch = replay.sample(key, memory, config.batch)
        value, gradient = jax.value_and_grad(loss)(params, batch)
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), value

    keys = jax.random.split(key, config.updates)
    (params, optimiser_state), values = jax.lax.scan(update, (state.params, state.optimiser), keys)
    return params, optimiser_state, jnp.mean(jnp.asarray(values))


def _optimiser(config: DqnConfig) -> optax.GradientTransformation:
    schedule = optax.cosine_decay_schedule(
        config.learning_rate,
        config.epochs * config.updates,
        config.final_learning_rate / config.learning_rate,
    )
    return optax.adam(schedule)


def _starts(key: Key, mdp: MapMdp, number: int) -> MapState:
    keys = jax.random.split(key, number)
    return jax.vmap(lambda key: belief_mdp.reset(key, mdp))(keys)


def _restart(key: Key, envs: MapState, starts: MapState, needs_start: jax.Array) -> MapState:
    """Gives each environment that needs it a random one of the starts."""
    rows = jax.random.randint(key, needs_start.shape, 0, starts.steps.shape[0])

    def pick(env: jax.Array, start: jax.Array) -> jax.Array:
        mask = needs_start.reshape(-1, *[1] * (env.ndim - 1))
        return jnp.where(mask, start[rows], env)

    return jax.tree.map(pick, envs, starts)

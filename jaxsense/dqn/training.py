"""Deep Q-learning over many environments at once (Mnih et al. 2015), as pure functions.

Random numbers are drawn for a whole chunk of epochs at once: in the loop they would dominate its
cost.
"""

import dataclasses
import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import optax

from jaxsense.config import DqnConfig
from jaxsense.core.networks import Params
from jaxsense.core.types import Index, Key, Transition, pytree
from jaxsense.dqn import losses, replay
from jaxsense.dqn.belief_mdp import MapMdp
from jaxsense.dqn.environments import Environment, State, environment
from jaxsense.dqn.team_mdp import TeamMdp

_EVALUATED = 10  # epochs


@pytree
class DqnState:
    """Training state between two chunks of epochs.

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
    envs: State
    needs_start: jax.Array
    total_reward: jax.Array
    epoch: jax.Array


@pytree
class EpochInfo:
    """Metrics of one epoch.

    Attributes:
      loss: `[]` mean over the gradient steps.
      episode_return: `[]` mean total reward of the exploring policy's episodes that ended.
      episodes: `[]` int32 episodes that ended.
      greedy_return: `[]` mean total reward of the greedy policy after the epoch; NaN after most.
      epsilon: `[]` chance of a random action.
      is_finite: `[]` bool, whether values, rewards, loss and new parameters are.
    """

    loss: jax.Array
    episode_return: jax.Array
    episodes: jax.Array
    greedy_return: jax.Array
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


def init(key: Key, mdp: MapMdp | TeamMdp, config: DqnConfig, prepared: State) -> DqnState:
    """Fresh network, empty replay, and environments before their first start.

    Args:
      key: random key of the network.
      mdp: the MDP.
      config: the settings.
      prepared: from `starts`; only its shapes count.
    """
    envs = jax.tree.map(lambda x: jnp.zeros((config.num_envs, *x.shape[1:]), x.dtype), prepared)
    place = environment(mdp, 0, config)
    size = jax.eval_shape(jax.vmap(place.observation), prepared).shape[1]
    params = place.init(key)
    rounds, blocks = config.replay_capacity // config.num_envs, config.num_envs // config.block
    return DqnState(
        params=params,
        target=params,
        optimiser=_optimiser(config).init(params),
        replay=replay.init(size, rounds, blocks, config.block),
        envs=envs,
        needs_start=jnp.ones(config.num_envs, bool),
        total_reward=jnp.zeros(config.num_envs),
        epoch=jnp.int32(0),
    )


def starts(key: Key, mdp: MapMdp | TeamMdp, config: DqnConfig) -> State:
    """Random states, `[num_starts]`, for episodes to start from.

    A training prepares them once: a start looks at everything it has seen, which costs far more
    than a step.
    """
    reset = environment(mdp, 0, config).reset
    return jax.vmap(reset)(jax.random.split(key, config.num_starts))


def train(
    key: Key, mdp: MapMdp | TeamMdp, modality: Index, config: DqnConfig
) -> tuple[DqnState, EpochInfo]:
    """Trains one agent; `vmap` over `key` for several seeds, over `modality` for several agents.

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `belief_mdp.step`; a team has all of them.
      config: the settings.

    Returns:
      The last state and the `[epochs]` infos.
    """
    init_key, start_key, chunk_key = jax.random.split(key, 3)
    prepared = starts(start_key, mdp, config)
    state = init(init_key, mdp, config, prepared)
    keys = jax.random.split(chunk_key, config.epochs // config.chunk)
    state, infos = jax.lax.scan(
        lambda state, key: train_chunk(key, mdp, modality, config, state, prepared),
        state,
        keys,
    )
    return state, jax.tree.map(lambda x: x.reshape(-1), infos)


def train_chunk(
    key: Key,
    mdp: MapMdp | TeamMdp,
    modality: Index,
    config: DqnConfig,
    state: DqnState,
    prepared: State,
    evaluate: Callable[[Key, Params], jax.Array] | None = None,
) -> tuple[DqnState, EpochInfo]:
    """Trains for `config.chunk` epochs.

    Args:
      key: random key.
      mdp: the MDP.
      modality: index of the agent's own sensor, see `belief_mdp.step`; a team has all of them.
      config: the settings.
      state: the current state.
      prepared: `[num_starts]` from `starts`. Each environment has a share of them, and starts every
        episode from a random one of its share.
      evaluate: `(key, parameters) -> []` total reward of the greedy policy, called after every
        tenth epoch, or after the last if ten do not divide the chunk.

    Returns:
      The next state and the `[chunk]` infos.
    """
    for part in jax.tree.leaves(prepared):
        chex.assert_axis_dimension(part, 0, config.num_starts, custom_message="prepared")
    shares = jax.tree.map(lambda x: x.reshape(config.num_envs, -1, *x.shape[1:]), prepared)
    place = environment(mdp, modality, config)
    draws = _draw(key, config)
    epoch = functools.partial(_epoch, place, config, shares)
    if evaluate is None:
        return jax.lax.scan(epoch, state, draws)
    every = _EVALUATED if config.chunk % _EVALUATED == 0 else config.chunk

    def advance(state: DqnState, of_group: tuple[Key, _Draws]) -> tuple[DqnState, EpochInfo]:
        key, draws = of_group
        state, infos = jax.lax.scan(epoch, state, draws)
        found = infos.greedy_return.at[-1].set(evaluate(key, state.params))
        return state, dataclasses.replace(infos, greedy_return=found)

    # `_draw` splits the key itself in three, as without evaluation.
    keys = jax.random.split(jax.random.fold_in(key, 3), config.chunk // every)
    groups = jax.tree.map(lambda x: x.reshape(-1, every, *x.shape[1:]), draws)
    state, infos = jax.lax.scan(advance, state, (keys, groups))
    return state, jax.tree.map(lambda x: x.reshape(-1), infos)


def _draw(key: Key, config: DqnConfig) -> _Draws:
    """Random numbers of `[chunk]` epochs."""
    env_key, step_key, replay_key = jax.random.split(key, 3)
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
    place: Environment,
    config: DqnConfig,
    shares: State,
    state: DqnState,
    draws: _Draws,
) -> tuple[DqnState, EpochInfo]:
    """One step of each environment and `config.updates` gradient steps."""
    epsilon = jnp.maximum(
        config.epsilon_min, config.epsilon_start * config.epsilon_decay**state.epoch
    )
    started = _restart(draws.start, state.envs, shares, state.needs_start)
    envs, has_ended, transitions, values = _explore(
        place, config, state.params, started, epsilon, draws
    )
    memory = replay.add(state.replay, transitions)

    total_reward = state.total_reward + transitions.r_t
    episodes = jnp.sum(has_ended)
    ended_reward = jnp.sum(jnp.where(has_ended, total_reward, 0.0))

    params, optimiser, loss = _learn(config, place, state, memory, draws.replay)
    is_copied = (state.epoch + 1) % config.target_period == 0
    target = jax.tree.map(lambda new, old: jnp.where(is_copied, new, old), params, state.target)
    checked = values, transitions.r_t, loss, params
    is_finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(checked)]).all()
    info = EpochInfo(
        loss=loss,
        episode_return=ended_reward / jnp.maximum(episodes, 1),
        episodes=episodes,
        greedy_return=jnp.float32(jnp.nan),
        epsilon=epsilon,
        is_finite=is_finite,
    )
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


def _explore(
    place: Environment,
    config: DqnConfig,
    params: Params,
    started: State,
    epsilon: jax.Array,
    draws: _Draws,
) -> tuple[State, jax.Array, Transition, jax.Array]:
    """Next states, which episodes have ended, transitions and `[A, E]` values before them."""
    observations = jax.vmap(place.observation, out_axes=-1)
    s_tm1 = observations(started)
    values = place.values(params, s_tm1)
    chex.assert_shape(values, (place.num_actions, None))
    greedy = jnp.argmax(values, axis=0).astype(jnp.int32)
    a_tm1 = jnp.where(draws.coin < epsilon, _explored(place, started, draws.action), greedy)

    def step(key: Key, state: State, s_tm1: jax.Array, action: jax.Array):
        after, learned, outcome = place.step(key, state, s_tm1, action)
        numbers = learned.a_tm1, learned.r_t, learned.discount_t
        return after, (learned.s_tm1, learned.s_t), numbers, outcome

    steps = jax.vmap(step, in_axes=(0, 0, -1, 0), out_axes=(0, -1, 0, 0))
    envs, (s_tm1, s_t), numbers, outcome = steps(draws.step, started, s_tm1, a_tm1)
    transitions = Transition(s_tm1, *numbers, s_t)
    return envs, outcome.terminated | outcome.truncated, transitions, values


def _explored(place: Environment, states: State, draws: jax.Array) -> jax.Array:
    """Random `[E]` int32 actions among those that exist in `[E]` states, by `[E]` in [0, 1)."""
    exists = jax.vmap(place.exists)(states)
    number = jnp.floor(draws * jnp.sum(exists, axis=1)).astype(jnp.int32)
    return jnp.argmax(jnp.cumsum(exists, axis=1) > number[:, None], axis=1).astype(jnp.int32)


def _learn(
    config: DqnConfig,
    place: Environment,
    state: DqnState,
    memory: replay.Replay,
    draws: jax.Array,
) -> tuple[Params, optax.OptState, jax.Array]:
    """Gradient steps, one for each of the `[updates, blocks, 2]` draws."""
    optimiser = _optimiser(config)

    def loss(params: Params, batch: Transition) -> jax.Array:
        q_tm1 = place.learned(params, batch.s_tm1)
        q_t = place.values(state.target, batch.s_t)
        error = losses.td_error(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t)
        return jnp.mean(losses.pseudo_huber(error))

    def update(carry, draws: jax.Array):
        params, optimiser_state = carry
        batch = replay.sample(draws, memory)
        value, gradient = jax.value_and_grad(loss)(params, batch)
        change, optimiser_state = optimiser.update(gradient, optimiser_state, params)
        return (optax.apply_updates(params, change), optimiser_state), value

    (params, optimiser_state), values = jax.lax.scan(update, (state.params, state.optimiser), draws)
    return params, optimiser_state, jnp.mean(jnp.asarray(values))


def _optimiser(config: DqnConfig) -> optax.GradientTransformation:
    schedule = optax.cosine_decay_schedule(
        config.learning_rate,
        config.epochs * config.updates,
        config.final_learning_rate / config.learning_rate,
    )
    # As one vector: the network is so small that each array costs more than its content.
    return optax.flatten(optax.adam(schedule))


def _restart(rows: jax.Array, envs: State, shares: State, needs_start: jax.Array) -> State:
    """Restarts each environment that needs it from that row of its share."""

    def pick(env: jax.Array, share: jax.Array) -> jax.Array:
        mask = needs_start.reshape(-1, *[1] * (env.ndim - 1))
        return jnp.where(mask, share[jnp.arange(len(rows)), rows], env)

    return jax.tree.map(pick, envs, shares)

"""Scores of policies in frozen tasks, compared with policies whose scores are known."""

import dataclasses
import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PyTree
from scipy import stats

from jaxsense.config import ConfigError
from jaxsense.config.section import require_function
from jaxsense.core import checks
from jaxsense.core.types import Key
from jaxsense.tasks.registry import TASKS, as_task, reference_returns, require_unchanged
from jaxsense.tasks.task import EPISODES, SEEDS, Act, Task, fixed_draws, key_of_seed

_UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
_IS_POLICY = "must be a function (key, observation) -> action, a Recurrent, or a list of them"
_IS_RECURRENT = "must be a function (key, memory, observation) -> (action, memory)"
_IS_ON_HOST = "must be a function of [B, S] observations that returns [B] integer actions"
_RESAMPLES = 2000
_LEVEL = 0.95

Policy = Callable[[Key, jax.Array], jax.Array]
"""`(key, observation [S]) -> []` action, an integer; a pure function that JAX can trace, or one
from `on_host`."""


@dataclasses.dataclass(frozen=True)
class Recurrent:
    """A policy with memory, for `score`.

    Attributes:
      act: `(key, memory, observation [S]) -> ([] action, memory)`.
      memory: before the first action of an episode; a pytree of arrays.
    """

    act: Act[PyTree]
    memory: PyTree


@dataclasses.dataclass(frozen=True)
class Estimate:
    """An interquartile mean over seeds, with its 95 % interval.

    Attributes:
      value: interquartile mean over seeds (Agarwal et al. 2021, Deep RL at the edge of the
        statistical precipice, Sec. 4).
      low: lower end of the 95 % interval, by a bootstrap over seeds.
    """

    value: float
    low: float
    high: float

    def __str__(self):
        return f"{self.value:.3f} ({self.low:.3f} to {self.high:.3f})"


@dataclasses.dataclass(frozen=True)
class Score:
    """Result of `score`: returns of a policy, and of known policies to compare it with.

    Attributes:
      returns: `[seeds]` mean return of an episode, without discount, with each seed.
      references: by name, `[seeds]` the same of known policies from the same starts.
      has_optimum: whether the first of them is optimal.
    """

    task: str
    agent: str
    returns: np.ndarray
    references: dict[str, np.ndarray]
    has_optimum: bool

    @property
    def best(self) -> str:
        """The reference to measure against: the optimum, or else that with the highest return."""
        if self.has_optimum:
            return next(iter(self.references))
        return max(self.references, key=lambda name: self.references[name].mean())

    @property
    def mean_return(self) -> Estimate:
        """Return of an episode."""
        return estimate(self.returns)

    @property
    def fraction_of_optimal(self) -> Estimate:
        """Return over that of `best`, from the same starts.

        The optimum is that of exact Bayes. Rewards are read from the map, whose probabilities are
        not quite exact, so a fraction may exceed 1 by a few thousandths. Where no optimum is known
        (`has_optimum` is False), `best` is a hand-written rule, and any fraction is possible.
        """
        return estimate(self.returns / self.references[self.best])

    def __str__(self):
        def shown(found: Estimate) -> str:
            # A single seed has no interval.
            return str(found) if len(self.returns) > 1 else f"{found.value:.3f}"

        seeds = f"{len(self.returns)} seed{'s' * (len(self.returns) > 1)}"
        lines = [f"{self.task}, {self.agent}, {seeds}: return {shown(self.mean_return)}"]
        known = "optimum" if self.has_optimum else f"best rule, {self.best}"
        lines += [f"fraction of the {known}: {shown(self.fraction_of_optimal)}"]
        lines += [f"{name}: {shown(estimate(found))}" for name, found in self.references.items()]
        return "\n  ".join(lines)


@fixed_draws()
def score(
    task: Task | str,
    policy: Policy | Recurrent | list[Policy | Recurrent],
    *,
    agent: str | None = None,
    episodes: int = EPISODES,
) -> Score:
    """Evaluates a policy in a task, next to the optimum and other known policies.

    Args:
      policy: the policy; or several, one for each seed that they were trained with, so that the
        interval covers the spread of trainings. One policy plays with `SEEDS` seeds, and its
        interval covers the spread of starts and looks alone. Policies that are pytrees of numbers,
        such as a `jax.tree_util.Partial` of parameters, are compiled once for all.
      agent: see `make`; only with a name.

    Returns:
      The score. Its starts and looks are always the same, whatever JAX's settings of random
      numbers are, and no training should see them.

    Raises:
      ConfigError: if there is no such task or agent, if a task was changed and kept its name, if a
        policy is not such a function, or if its actions do not exist.
      ValueError: if JAX cannot trace a policy, or it returns no integer.
    """
    checks.require_number("episodes", episodes)
    task = as_task(task, agent)
    require_unchanged(task)
    policies = list(policy) if isinstance(policy, list | tuple) else [policy] * SEEDS
    if not policies:
        raise ConfigError("policy", policy, "must be one policy or several")
    seeds = len(policies)
    players = {id(each): _player(each) for each in policies}
    returns = [
        players[id(each)](key_of_seed(seed), task, episodes) for seed, each in enumerate(policies)
    ]
    if task.name in TASKS and episodes == EPISODES and seeds <= SEEDS:
        known = np.asarray(task.returns)[:, :seeds]
        references = dict(zip(task.references, known, strict=True))
    else:
        references = reference_returns(task, seeds, episodes)
    return Score(task.name, task.agent, np.array(returns), references, task.has_optimum)


def on_host(act: Callable[[np.ndarray], np.ndarray]) -> Policy:
    """Wraps a policy that JAX cannot trace, for example one in NumPy or PyTorch.

    Raises:
      ConfigError: if `act` is not such a function. The policy raises it if `act` returns an array
        of another shape or dtype.
    """
    require_function("act", act, 1, _IS_ON_HOST)

    def choose(observations: np.ndarray) -> np.ndarray:
        actions = np.asarray(act(observations))
        if actions.shape != observations.shape[:1] or actions.dtype.kind not in "iu":
            expected = f"must return {len(observations)} integers for as many observations"
            raise ConfigError("act", act, f"{expected}; not {actions.dtype}{[*actions.shape]}")
        # What 32 bits cannot hold is no action, either.
        return np.where((actions >= 0) & (actions < 2**31), actions, -1).astype(np.int32)

    def policy(key: Key, observation: jax.Array) -> jax.Array:
        del key
        shape = jax.ShapeDtypeStruct((), jnp.int32)
        # An error within a program would lose its message among many lines.
        with jax.ensure_compile_time_eval():
            choose(np.zeros((2, *observation.shape), np.float32))

        def call(observations: ArrayLike) -> np.ndarray:
            batch = np.array(observations)  # a copy, as policies may write into it
            return choose(batch.reshape(-1, batch.shape[-1])).reshape(batch.shape[:-1])

        return jax.pure_callback(call, shape, observation, vmap_method="broadcast_all")

    policy.__name__ = getattr(act, "__name__", policy.__name__)  # for messages
    return policy


def estimate(values: Float[np.ndarray, " seeds"]) -> Estimate:
    """Computes the interquartile mean over seeds, with a bootstrap interval."""
    checks.require_shape("values", values, (None,))

    def middle(values: np.ndarray, axis: int = -1) -> np.ndarray:
        return stats.trim_mean(values, 0.25, axis=axis)

    value = float(middle(values))
    if len(values) < 2:
        return Estimate(value, value, value)
    draws = np.random.default_rng(0).integers(len(values), size=(_RESAMPLES, len(values)))
    tails = [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2]
    low, high = np.quantile(middle(values[draws]), tails)
    return Estimate(value, float(low), float(high))


def mean_return(key: Key, task: Task | str, policy: Policy | Recurrent, episodes: int) -> float:
    """Computes the mean return of a policy, for example for a learning curve.

    Starts and looks differ from those of a score.

    Args:
      policy: see `score`; compiled anew in each call, unless it is a pytree of numbers.

    Raises:
      ConfigError: if the policy is not such a function, or its actions do not exist.
      ValueError: if JAX cannot trace it, it returns no integer, or another argument is wrong.
    """
    checks.require_key(key)
    checks.require_number("episodes", episodes)
    return _player(policy)(key, as_task(task), episodes)


def _player(policy: Policy | Recurrent) -> Callable[[Key, Task, int], float]:
    """`mean_return` of a policy, which is compiled once for all keys."""
    act, memory = policy, ()
    if isinstance(policy, Recurrent):
        act, memory = policy.act, policy.memory
        require_function("policy.act", act, 3, _IS_RECURRENT)
    else:
        require_function("policy", act, 2, _IS_POLICY)
        act = Partial(_forget, act)
    play = functools.partial(_play_compiled, act)
    if not all(isinstance(leaf, checks.NUMBERS) for leaf in jax.tree.leaves(act)):
        # A program of its own, which goes when the policy does.
        play = jax.jit(functools.partial(_play, act), static_argnums=3)

    def checked(key: Key, task: Task, episodes: int) -> float:
        found = float(play(memory, key, task, episodes))
        if np.isnan(found):
            last = task.num_actions - 1
            raise ConfigError("policy", policy, f"must return actions from 0 to {last}")
        return found

    return checked


def _play(
    act: Act[PyTree], memory: PyTree, key: Key, task: Task, episodes: int
) -> Float[Array, ""]:
    """Mean return of some episodes; NaN if there is no such action."""
    keys, choose = jax.random.split(key, episodes), functools.partial(_choose, act)
    return jnp.mean(jax.vmap(lambda key: task.play(key, choose, memory))(keys))


_play_compiled = jax.jit(_play, static_argnums=4)


def _choose(
    act: Act[PyTree], key: Key, memory: PyTree, observation: jax.Array
) -> tuple[Int[Array, ""], PyTree]:
    """Action and memory of a policy; raises `ValueError` unless the action is an integer."""
    try:
        found = act(key, memory, observation)
    except _UNTRACEABLE as error:
        expected = "must be a function that JAX can trace; wrap others in tasks.on_host"
        raise ValueError(f"policy: {expected}") from error
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise ValueError("policy: must return an action and a memory")
    action, after = found
    form = type(action).__name__
    if isinstance(action, checks.NUMBERS):
        action = jnp.asarray(action)
        form = f"{action.dtype}{[*action.shape]}"
    if not isinstance(action, jax.Array) or action.shape or action.dtype.kind not in "iu":
        raise ValueError(f"policy: must return an integer of shape []; not {form}")
    try:
        chex.assert_trees_all_equal_shapes_and_dtypes(*jax.tree.map(jnp.asarray, (after, memory)))
    except AssertionError as error:
        form = "a memory with the structure, shapes and dtypes of the first"
        raise ValueError(f"policy: must return {form}") from error
    return action.astype(jnp.int32), after


def _forget(
    policy: Policy, key: Key, memory: tuple[()], observation: jax.Array
) -> tuple[jax.Array, tuple[()]]:
    """A policy without memory."""
    return policy(key, observation), memory

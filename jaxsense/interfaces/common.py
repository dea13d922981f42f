"""What the interfaces share: imports of extras, spaces, starts, and robots of a team."""

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxsense.config import Config
from jaxsense.config.whole import names_of_robots
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn.mdp import Mdp, State
from jaxsense.tasks.task import Environment, Task, TimeStep

T = TypeVar("T")


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Names the extra of jaxsense that installs a package whose import fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or name).partition(".")[0]
        message = f"{package} is not installed: pip install 'jaxsense[{name}]'"
        raise ModuleNotFoundError(message, name=package) from None


def environment(mdp: Mdp | Environment) -> Environment:
    """A task as it is, or an MDP."""
    return Environment(mdp) if isinstance(mdp, Mdp) else mdp


def prepared_starts(key: Key, mdp: Mdp | Environment, number: int) -> PyTree:
    """Random states, `[number]`, of a task or an MDP, for episodes to start from.

    A start looks at everything it has seen, which costs several steps; a draw from a few thousand
    prepared ones costs nothing.
    """
    checks.require_key(key)
    checks.require_number("number of starts", number)
    reset = jax.jit(jax.vmap(lambda key, played: played.reset(key)[1], (0, None)))
    return reset(jax.random.split(key, number), environment(mdp))


def start(key: Key, played: Environment, starts: PyTree) -> tuple[Float[Array, " S"], PyTree]:
    """Observation and state: one of `starts` at random, or a new one if they are None."""
    if starts is None:
        return played.reset(key)
    row = jax.random.randint(key, (), 0, len(jax.tree.leaves(starts)[0]))
    state = jax.tree.map(lambda x: x[row], starts)
    expected = jax.eval_shape(played.reset, key)[1]
    shapes = [[x.shape for x in jax.tree.leaves(each)] for each in (state, expected)]
    if shapes[0] != shapes[1]:
        raise ValueError("starts are of another MDP: must be from prepared_starts of this one")
    return played.observe(state), state


@pytree
class Robots:
    """A team, each robot of which is an agent.

    Robots take turns. In each step one robot chooses, and the actions of the others are ignored.
    Action n < N heads for PoI n, and action N is NOP, after which the robot is done. If nobody else
    has to choose, time passes until the next look. The robot that has looked earns the reward of
    its look and chooses next; each robot that works pays for the time that passed.

    Attributes:
      played: a task of the team, or its MDP.
      names: of the robots.
    """

    played: Environment
    names: tuple[str, ...] = struct.field(pytree_node=False)

    def named(self, of_robots: Iterable[T]) -> dict[str, T]:
        """`[R, ...]` by the names of the robots."""
        return dict(zip(self.names, of_robots, strict=True))

    def observe(self, state: State) -> Float[Array, "R S"]:
        """What each robot knows."""
        return jax.vmap(self.played.seen_by, (0, None))(jnp.arange(len(self.names)), state)

    def action_mask(self, state: State) -> Bool[Array, "R A"]:
        """Actions of each robot: the PoIs that are present, if it is its turn, and NOP."""
        chooses = state.team.works & (jnp.arange(len(self.names)) == state.agent)
        return (chooses[:, None] & state.team.action_mask[None]).at[:, -1].set(True)

    def step(
        self, key: Key, state: State, actions: Int[Array, " R"]
    ) -> tuple[State, TimeStep, Float[Array, ""]]:
        """Lets the robot choose whose turn it is; a PoI that is not present counts as NOP.

        Traced actions that do not exist are not refused: they have a reward of NaN.

        Returns:
          The state; for each robot its observation, its reward, whether it chose NOP, and whether
          it would go on at the limit; and the seconds that passed.
        """
        mdp = self.played.mdp
        checks.require_index("actions", actions, mdp.num_actions)
        after, outcome = mdps.step(key, mdp, state, state.team.existing(actions[state.agent]))
        works, seconds = after.team.works, outcome.seconds
        price = jnp.where(works, mdp.second_cost * seconds, 0.0)
        earned = jnp.where(jnp.arange(len(self.names)) == after.agent, outcome.reward, 0.0)
        found = TimeStep(self.observe(after), earned - price, ~works, works & outcome.truncated)
        return after, found, seconds


def robots_of(mdp: Mdp | Task, config: Config | None = None) -> Robots:
    """Robots of a task; or of the MDP of teams, with the settings that name them."""
    if isinstance(mdp, Task) and mdp.mdp.teams and config is None:
        carried = tuple(mdp.modalities[int(m)] for m in mdp.mdp.robots)
        return Robots(mdp, names_of_robots(carried))
    if isinstance(mdp, Mdp) and mdp.teams and config and mdp.teams.modalities == config.modalities:
        robots = jnp.array(config.modality_of_robot, jnp.int32)
        whole = dataclasses.replace(mdp.teams, is_random=False)
        played = dataclasses.replace(mdp, robots=robots, teams=whole)
        return Robots(Environment(played), config.robot_names)
    given = type(mdp).__name__ if isinstance(mdp, Mdp) else repr(mdp)
    task = "must be a task of a team alone, such as jaxsense.make('team-v0')"
    raise ValueError(f"mdp = {given}: {task}, or an Mdp of teams and the settings it is made with")


def spaces_of(spaces: Any, played: Environment) -> tuple[Any, Any]:
    """Another library's spaces of an observation, and of an action."""
    shape = (played.observation_size,)
    box = spaces.Box(-played.bound, played.bound, shape, np.float32)
    return box, spaces.Discrete(played.num_actions)

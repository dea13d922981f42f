"""What the interfaces share: imports of extras, spaces, starts, and robots of a team."""

import contextlib
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
from jaxsense.dqn import team_mdp
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.tasks.environment import Environment, OneAgent, Scaling, TimeStep
from jaxsense.tasks.task import Task, TeamTask

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


def environment(mdp: MapMdp | Environment, modality: int | None) -> Environment:
    """A task as it is, or the map MDP of the agent whose sensor has the index `modality`."""
    if isinstance(mdp, MapMdp):
        checks.require_index("modality", modality, mdp.num_modalities)
        return OneAgent(mdp, modality)  # pyright: ignore[reportArgumentType]
    if modality is not None:
        raise ValueError(f"modality = {modality}: must be None with a task, which has its agent")
    return mdp


def prepared_starts(key: Key, mdp: MapMdp | Environment, number: int) -> PyTree:
    """Random states, `[number]`, of a task or a map MDP, for episodes to start from.

    A start looks at everything it has seen, which costs several steps; a draw from a few thousand
    prepared ones costs nothing.
    """
    checks.require_key(key)
    checks.require_number("number of starts", number)
    # A start is the same for all sensors.
    played = OneAgent(mdp, 0) if isinstance(mdp, MapMdp) else mdp
    reset = jax.jit(jax.vmap(lambda key, played: played.reset(key)[1], (0, None)))
    return reset(jax.random.split(key, number), played)


def start(key: Key, played: Environment, starts: PyTree) -> tuple[Float[Array, " S"], PyTree]:
    """Observation and state: one of `starts` at random, or a new one if they are None."""
    if starts is None:
        return played.reset(key)
    row = jax.random.randint(key, (), 0, len(jax.tree.leaves(starts)[0]))
    state = jax.tree.map(lambda x: x[row], starts)
    return played.observe(state), state


@pytree
class Robots:
    """A team, each robot of which is an agent.

    Robots take turns. In each step one robot chooses, and the actions of the others are ignored.
    Action n < N heads for PoI n, and action N is NOP, after which the robot is done. If nobody else
    has to choose, time passes until the next look. The robot that has looked earns the reward of
    its look and chooses next; each robot that works pays for the time that passed.

    Attributes:
      mdp: the MDP.
      sensors: `[R]` int32 index of each robot's sensor.
      scaling: of observations; None for those of `team_mdp.observation`.
      names: of the robots.
    """

    mdp: TeamMdp
    sensors: jax.Array
    scaling: Scaling | None
    names: tuple[str, ...] = struct.field(pytree_node=False)

    @property
    def observation_size(self) -> int:
        """S."""
        return self.mdp.num_features * self.mdp.map.num_pois

    @property
    def num_actions(self) -> int:
        """A look at each PoI, and NOP."""
        return self.mdp.map.num_pois + 1

    @property
    def bound(self) -> float:
        """Observations are within plus and minus this."""
        return float("inf") if self.scaling is None else self.scaling.bound

    def named(self, of_robots: Iterable[T]) -> dict[str, T]:
        """`[R, ...]` by the names of the robots."""
        return dict(zip(self.names, of_robots, strict=True))

    def reset(self, key: Key) -> TeamState:
        """Starts an episode of all robots."""
        return team_mdp.reset(key, self.mdp, self.sensors)

    def observe(self, state: TeamState) -> Float[Array, "R S"]:
        """What each robot knows."""

        def observation(robot: jax.Array) -> jax.Array:
            features = self.mdp.observe(state, robot)
            return features.reshape(-1) if self.scaling is None else self.scaling(features.T)

        return jax.vmap(observation)(jnp.arange(len(self.names)))

    def action_mask(self, state: TeamState) -> Bool[Array, "R A"]:
        """Actions of each robot: the PoIs that are present, if it is its turn, and NOP."""
        chooses = state.team.works & (jnp.arange(len(self.names)) == state.agent)
        return (chooses[:, None] & team_mdp.action_mask(state)[None]).at[:, -1].set(True)

    def step(
        self, key: Key, state: TeamState, actions: Int[Array, " R"]
    ) -> tuple[TeamState, TimeStep, Float[Array, ""]]:
        """Lets the robot choose whose turn it is; a PoI that is not present counts as NOP.

        Traced actions that do not exist are not refused: they have a reward of NaN.

        Returns:
          The state; for each robot its observation, its reward, whether it chose NOP, and whether
          it would go on at the limit; and the seconds that passed.
        """
        checks.require_index("actions", actions, self.num_actions)
        action = team_mdp.existing(state, actions[state.agent])
        after, outcome = team_mdp.step(key, self.mdp, state, action)
        works, seconds = after.team.works, jnp.asarray(outcome.seconds)
        price = jnp.where(works, self.mdp.config.second_cost * seconds, 0.0)
        earned = jnp.where(jnp.arange(len(self.names)) == after.agent, outcome.reward, 0.0)
        found = TimeStep(self.observe(after), earned - price, ~works, works & outcome.truncated)
        return after, found, seconds


def robots_of(mdp: TeamMdp | Task, config: Config | None = None) -> Robots:
    """Robots of a task; or of the MDP of a team, with the settings that name them."""
    if isinstance(mdp, TeamTask) and config is None:
        carried = tuple(mdp.modalities[m] for m in mdp.robots.tolist())
        return Robots(mdp.mdp, mdp.robots, mdp.scaling, names_of_robots(carried))
    if isinstance(mdp, TeamMdp) and config and mdp.modalities == config.modalities:
        sensors = jnp.array(config.modality_of_robot, jnp.int32)
        return Robots(mdp, sensors, None, config.robot_names)
    expected = "must be a task of a team alone, or a TeamMdp and the settings that it is made with"
    raise ValueError(f"mdp = {type(mdp).__name__}: {expected}")


def spaces_of(spaces: Any, played: Environment | Robots) -> tuple[Any, Any]:
    """Another library's spaces of an observation, and of an action."""
    shape = (played.observation_size,)
    box = spaces.Box(-played.bound, played.bound, shape, np.float32)
    return box, spaces.Discrete(played.num_actions)

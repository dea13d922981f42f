"""The frozen tasks by name, and how one is frozen."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense import models
from jaxsense.config import Config, ConfigError
from jaxsense.config.section import require_32_bits
from jaxsense.core.types import Key, Samples
from jaxsense.looks import Bank, make_mdp
from jaxsense.models import Models
from jaxsense.tasks.environment import Scaling
from jaxsense.tasks.pretrained import (
    DATA,
    PRETRAINED,
    Arrays,
    Origin,
    fill,
    read,
    write_trees,
)
from jaxsense.tasks.task import EPISODES, SEEDS, MapTask, Task, TeamTask, fixed_draws, key_of_seed
from jaxsense.training.comparison import models_of

TASKS = {
    "map-v0": "the paper's map of three PoIs, with detections that are almost always confident",
    "many-v0": "eight PoIs of sixteen classes; each sensor distinguishes four labels",
    "noisy-v0": "map-v0 with uncertain detections, from which beliefs accumulate evidence",
    "team-v0": "robots with a camera and a LiDAR drive among three to eight PoIs; time has a cost",
}
"""The frozen tasks, and what is special in each."""

_STATES, _STEPS = 1024, 12  # from which observations are scaled
_LEAST_SPREAD = 1e-6  # below which a feature is constant
_NONE = np.zeros((0, 0))


def registered() -> tuple[str, ...]:
    """Lists the names of all tasks that `make` accepts."""
    return tuple(TASKS)


def about(name: str) -> str:
    """Describes a task in a few words."""
    _require_name(name)
    return TASKS[name]


def origin(name: str) -> Origin:
    """Returns the origin of a task, or of the models of `load_pretrained`."""
    _require_name(name, (*PRETRAINED, *TASKS))
    return read(DATA / f"{name}.npz")[2]


def agents(name: str) -> tuple[str, ...]:
    """Lists the agents of a task that `make` accepts."""
    _require_name(name)
    return _agents(read(DATA / f"{name}.npz")[1])


def make(name: str, agent: str | None = None) -> Task:
    """Makes a frozen task by its name, for example `noisy-v0`.

    `map-v0` is the paper's map MDP, whose looks are almost certain. In `noisy-v0` they are not, and
    beliefs accumulate them. `many-v0` has eight PoIs of sixteen classes. In `team-v0`, two robots,
    with a camera and a LiDAR, drive among three to eight PoIs, and time has a cost.

    Args:
      name: one of `registered()`.
      agent: whose sensor looks, `camera` or `lidar`, by default the first; a team has one policy
        for all of its robots, and its agent is `team`.

    Raises:
      ConfigError: if there is no such task or agent, or if JAX computes in 64 bits.
    """
    _require_name(name)
    require_32_bits()
    arrays, config, _ = read(DATA / f"{name}.npz")
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    fusion = fill(arrays, "fusion", shapes.fusion)
    values = fill(arrays, "look_values", shapes.look_values)
    looks = Bank(tuple(jnp.asarray(arrays[f"looks/{m}"]) for m in range(len(config.modalities))))
    scaling = Scaling(jnp.asarray(arrays["scaling/offset"]), jnp.asarray(arrays["scaling/scale"]))
    parts = models_of(config, fusion, values)
    return _made(name, agent, config, parts, looks, scaling, arrays)


def as_task(task: Task | str, agent: str | None = None) -> Task:
    """A task, by its name or as it is.

    Args:
      agent: see `make`; only with a name.
    """
    require_32_bits()
    if isinstance(task, str) and task in TASKS:
        return make(task, agent)
    if not isinstance(task, Task):
        raise ConfigError("task", task, f"must be from make, or one of {', '.join(TASKS)}")
    if agent is not None:
        raise ConfigError("agent", agent, "must be None with a task; pass it to make(name, agent)")
    return task


def require_unchanged(task: Task) -> None:
    """Checks that a task with the name of a frozen one has its networks, looks and rewards."""
    if task.name not in TASKS:
        return
    made = make(task.name, task.agent)
    is_same = jax.tree.structure(task) == jax.tree.structure(made)
    if not is_same or not all(map(np.array_equal, jax.tree.leaves(task), jax.tree.leaves(made))):
        expected = "must be as made; give a changed task another name, with dataclasses.replace"
        raise ConfigError("task", task, expected)


def freeze(
    key: Key, file: Path, name: str, config: Config, trained: Models, looks: Samples, made: Origin
) -> None:
    """Writes the file of a task.

    Args:
      file: a new file; its name ends in `.npz`.
    """
    parts, bank = models_of(config, trained.fusion, trained.look_values), Bank(looks)
    unscaled = Scaling(jnp.zeros(1), jnp.ones(1))
    scaling = _scaling(key, _made(name, None, config, parts, bank, unscaled, {}))

    def returns(agent: str) -> np.ndarray:
        task = _made(name, agent, config, parts, bank, scaling, {})
        return np.stack([*reference_returns(task, SEEDS, EPISODES).values()])

    trees = {
        "fusion": trained.fusion,
        "look_values": trained.look_values,
        "looks": looks,
        "scaling": {"offset": scaling.offset, "scale": scaling.scale},
        "returns": {agent: returns(agent) for agent in _agents(config)},
    }
    write_trees(file, trees, config, made)


@fixed_draws()
def reference_returns(task: Task, seeds: int, episodes: int) -> dict[str, np.ndarray]:
    """Mean returns of the policies to compare with."""

    def mean(name: str) -> np.ndarray:
        @jax.jit
        def play(key: Key) -> jax.Array:
            keys = jax.random.split(key, episodes)
            return jnp.mean(jax.vmap(lambda key: task.play_reference(key, name))(keys))

        return np.array([float(play(key_of_seed(seed))) for seed in range(seeds)])

    return {name: mean(name) for name in task.references}


def _require_name(name: str, known: Iterable[str] = TASKS) -> None:
    """Raises `ConfigError` if there is no such task."""
    if name not in tuple(known):  # a list has no hash
        raise ConfigError("name", name, f"must be one of {', '.join(known)}")


def _agents(config: Config) -> tuple[str, ...]:
    """Who acts in a task with some settings."""
    learner = models.make_agent(config).learner
    return tuple(dict.fromkeys(map(learner, config.modalities)))


def _made(
    name: str,
    agent: str | None,
    config: Config,
    parts: Models,
    looks: Bank,
    scaling: Scaling,
    arrays: Arrays,
) -> Task:
    """The task of some settings, networks and looks; `arrays` hold returns of references."""
    acting = _agents(config)
    agent = acting[0] if agent is None else agent
    if agent not in acting:
        expected = "must be one of " if len(acting) > 1 else "must be "
        raise ConfigError("agent", agent, expected + ", ".join(acting))
    parts_of_all: dict[str, PyTree] = {
        "mdp": make_mdp(config, parts, looks),
        "models": parts,
        "scaling": scaling,
        "returns": jnp.asarray(arrays.get(f"returns/{agent}", _NONE)),
        "name": name,
        "agent": agent,
        "modalities": config.modalities,
    }
    if config.dqn.task == "team":
        # A task is a whole mission.
        parts_of_all["mdp"] = dataclasses.replace(parts_of_all["mdp"], partly_seen=0.0)
        return TeamTask(**parts_of_all, robots=jnp.array(config.modality_of_robot, jnp.int32))
    return MapTask(**parts_of_all, modality=config.modalities.index(agent))


def _scaling(key: Key, task: Task) -> Scaling:
    """Means and standard deviations of features over states after random looks."""

    def visit(key: Key) -> jax.Array:
        reset_key, walk_key = jax.random.split(key)
        _, state = task.reset(reset_key)

        def look(state, key: Key):
            choice_key, step_key = jax.random.split(key)
            chances = task.action_mask(state).at[-1].set(False)
            action = jax.random.choice(choice_key, len(chances), p=chances / chances.sum())
            after, _ = task.step(step_key, state, action)
            return after, task.features(state)

        return jax.lax.scan(look, state, jax.random.split(walk_key, _STEPS))[1]

    found = jax.jit(jax.vmap(visit))(jax.random.split(key, _STATES))
    found = found.reshape(-1, found.shape[-1])
    spread = jnp.std(found, axis=0)
    return Scaling(jnp.mean(found, axis=0), jnp.where(spread > _LEAST_SPREAD, spread, 1.0))

"""Files that travel with the package, by name: trained models, and frozen tasks."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxsense import models
from jaxsense.config import Config, ConfigError, from_plain
from jaxsense.config.section import require_32_bits, require_known
from jaxsense.core.types import Key, placed
from jaxsense.dqn.team import Travel
from jaxsense.looks import Bank, make_mdp
from jaxsense.models import Models
from jaxsense.tasks.task import Scaling, Task, fixed_draws, key_of_seed

Arrays = dict[str, np.ndarray]

DATA = Path(__file__).parent / "data"
"""Where the files are."""
PRETRAINED = ("default", "noisy", "many", "raw", "team")
"""Presets with trained models, for `load_pretrained`."""
PREFIX = "pretrained:"
"""What stands before a preset's name where the directory of a run may stand, too."""

TASKS = {
    "map-v0": "the paper's map of three PoIs, with detections that are almost always confident",
    "many-v0": "eight PoIs of sixteen classes; each sensor distinguishes four labels",
    "noisy-v0": "map-v0 with uncertain detections, from which beliefs accumulate evidence",
    "team-v0": "robots with a camera and a LiDAR drive among three to eight PoIs; time has a cost",
}
"""The frozen tasks, and what is special in each."""


# The others follow from the settings.
PARTS = "detectors", "jmvae", "fusion", "novelty", "look_values", "q_networks"


_TRAVEL = Travel(0.96, turn_rate=1.2, look_seconds=0.7)  # with which tasks were frozen


@dataclasses.dataclass(frozen=True)
class Origin:
    """Origin of trained models: command, seed, commit and versions.

    Attributes:
      versions: of jaxsense, Python and the packages that results depend on.
    """

    command: str
    preset: str
    seed: int
    commit: str
    versions: dict[str, str]


def load_pretrained(preset: str) -> tuple[Config, Models]:
    """Loads the settings and the trained models of a preset, which ship with the package."""
    require_32_bits()
    arrays, config, _ = _read("preset", preset, PRETRAINED)
    return config, models.make_models(config, **_trained(arrays, config, *PARTS))


def registered() -> tuple[str, ...]:
    """Lists the names of all tasks that `make` accepts."""
    return tuple(TASKS)


def origin(name: str) -> Origin:
    """Returns the origin of a task, or of the models of `load_pretrained`."""
    return _read("name", name, (*PRETRAINED, *TASKS))[2]


def agents(name: str) -> tuple[str, ...]:
    """Lists the agents of a task that `make` accepts."""
    return agents_of(_read("name", name, TASKS)[1])


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
    require_32_bits()
    arrays, config, _ = _read("name", name, TASKS)
    acting = agents_of(config)
    agent = acting[0] if agent is None else agent
    require_known("agent", agent, acting)
    looks = Bank(tuple(jnp.asarray(arrays[f"looks/{m}"]) for m in range(len(config.modalities))))
    scaling = Scaling(jnp.asarray(arrays["scaling/offset"]), jnp.asarray(arrays["scaling/scale"]))
    parts = models.make_models(config, **_trained(arrays, config, "fusion", "look_values"))
    returns = jnp.asarray(arrays[f"returns/{agent}"])
    return task_of(name, agent, config, parts, looks, scaling, returns)


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


def agents_of(config: Config) -> tuple[str, ...]:
    """Who acts in a task with some settings."""
    return ("team",) if config.dqn.task == "team" else config.modalities


def task_of(
    name: str,
    agent: str,
    config: Config,
    parts: Models,
    looks: Bank,
    scaling: Scaling,
    returns: jax.Array,
) -> Task:
    """The task of some settings, networks, looks and returns of the references."""
    mdp = make_mdp(config, parts, looks)
    if mdp.teams is None:
        mdp = mdp.of(config.modalities.index(agent))
    else:
        # A task is a whole mission.
        fixed = {"travel": _TRAVEL, "partly_seen": 0.0, "is_random": False}
        teams = dataclasses.replace(mdp.teams, **fixed, chooses_anew=False)
        mdp = dataclasses.replace(mdp, robots=jnp.array(config.modality_of_robot), teams=teams)
    return Task(mdp, parts, scaling, returns, name, agent, config.modalities)


def read(file: Path) -> tuple[Arrays, Config, Origin]:
    """Arrays by their places in trees, settings and origin, from a file of `benchmarks.ship`."""
    with np.load(file, allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    about = json.loads(str(arrays.pop("about")))
    return arrays, from_plain(about["config"], skips=True), Origin(**about["origin"])


def _read(field: str, name: str, known: Iterable[str]) -> tuple[Arrays, Config, Origin]:
    """The file of one of the known names; raises `ConfigError` for others."""
    require_known(field, name, known)
    return read(DATA / f"{name}.npz")


def _trained(arrays: Arrays, config: Config, *parts: str) -> dict[str, PyTree]:
    """Parts of models by their names."""
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    found = placed({name: getattr(shapes, name) for name in parts}, arrays)
    return jax.tree.map(jnp.asarray, found)

"""`jaxsense explore`: plays missions in places that the robots do not know."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxsense import exploration, mission
from jaxsense.config import Config
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.options import Positional
from jaxsense.config.section import Checked, limited, require_known
from jaxsense.core.types import Key
from jaxsense.dqn.agent import Agent
from jaxsense.dqn.policies import Trained, Values
from jaxsense.dqn.team import Known
from jaxsense.exploration import ExplorationState
from jaxsense.exploration.state import NUM_FRONTIERS, num_slots
from jaxsense.models import Models
from jaxsense.run import cli, devices, files, output, rundir
from jaxsense.run.output import say
from jaxsense.run.settings import MAX_SEED
from jaxsense.show import drawing, plots
from jaxsense.show.terminal import Display
from jaxsense.summary import blocks, make
from jaxsense.summary.compare import Measured
from jaxsense.summary.tables import of_metrics

PROGRAM = "jaxsense.explore"
_CHUNK = 100  # control periods between two reports
_SHOWN = "found", "false", "duplicates", "right", "position_error.median", "mean_time_s"


class PlaceArguments(Checked, place="arena"):
    """What robots explore.

    Attributes:
      side: Side of the arena, in metres.
      num_pois: Largest number of points of interest.
      fewest_pois: Smallest number; by default 4, or `num_pois` if that is less.
      inner_walls: Number of inner walls.
    """

    side: float = 8.0
    num_pois: int = 12
    fewest_pois: int | None = limited(None, at_least=1)
    inner_walls: int = 5


class PoseArguments(Checked, place="localisation"):
    """How well robots know their poses; by default as in the run.

    Attributes:
      error: Standard deviations of a robot's constant error, in metres and degrees.
      drift: Standard deviations of what a metre of driving adds, in metres and degrees.
    """

    error: tuple[float, float] | None = None
    drift: tuple[float, float] | None = None


class Arguments(Checked):
    """Plays missions in which robots find points of interest and walls, and compares policies.

    Attributes:
      run: The directory of a finished run, `latest` for the newest one in `runs/`, or
        `pretrained:PRESET` for models that ship.
      episodes: Number of missions per policy.
      seed: Seed of the arenas and of all noise, from 0 to 2^32 - 1.
      policy: One of `latent`, `auction`, `nearest`, `gain_rate`, `look_first` and `explore_first`,
        or `all`.
      robots: Sensors of the robots, one per robot; the run's by default.
      time_limit: Maximum length of a mission, in seconds.
      out: Directory for figures and pictures, new or empty; by default `runs/DATE-TIME-explore`.
      cache: Directory in which to cache compiled programs; `none` for no cache.
      trust: Trust the run's `config.json`: run the code of custom sensors that it names.
    """

    run: Positional[Path] = Path("pretrained:default")
    episodes: int = limited(32, at_least=1, at_most=8192)
    seed: int = limited(0, at_least=0, at_most=MAX_SEED)
    policy: str = "all"
    arena: PlaceArguments = PlaceArguments()
    localisation: PoseArguments = PoseArguments()
    robots: tuple[str, ...] | None = None
    time_limit: float = limited(600.0, at_least=CONTROL_PERIOD, at_most=3600)
    out: Path | None = None
    cache: Path | None = cli.CACHE
    trust: bool = False


def main(argv: list[str] | None = None) -> None:
    """Runs the program.

    Args:
      argv: the command line without the program; by default the process's own.
    """
    arguments = cli.parse(PROGRAM, Arguments, argv)
    with cli.ending(PROGRAM):
        devices.start(1)
        trained, models = rundir.load(arguments.run, arguments.trust)
        config = _elsewhere(arguments, trained)
        policies = _playable(models.agent, config)
        require_known("policy", arguments.policy, (*policies, "all"))
        names = [*policies] if arguments.policy == "all" else [arguments.policy]
        cli.keep_programs(PROGRAM, arguments.cache, config)
        play = Explorations(config, models, policies, arguments.episodes, arguments.seed)
        played = {"run": str(arguments.run), "seed": arguments.seed, "robots": config.carried}
        arena = {name: getattr(config.arena, name) for name in vars(arguments.arena)}
        errors = {x: getattr(config.mission.localisation, x) for x in vars(arguments.localisation)}
        played |= {"arena": arena, "localisation": errors, "time_limit": arguments.time_limit}
        with rundir.begun(arguments.out, "explore") as place, Display() as display:
            report = functools.partial(display.show, metrics={})
            if "latent" in names:
                learned = "latent has learned with {} to {} PoIs at known places"
                learned = learned.format(*config.team.num_pois)
                cli.warn(PROGRAM, f"{learned}, and chooses among up to {_num_places(config)} now")
            found = dict[str, blocks.Found]()
            for name in names:
                known = play.known(name, functools.partial(report, f"{name}, known places"))
                measured, over_time, shown = play.policy(name, functools.partial(report, name))
                limit = config.mission.time_limit
                found[name] = make.found(measured, known, over_time, limit)
                picture = drawing.svg(plots.explored(config, models.fusion, shown))
                files.write(place / f"explored-{name}.svg", picture)
                content = {**rundir.origin(), **played, "found": found}
                rundir.write_json(place / "found.json", content)
    metrics = [blocks.FOUND[key] for key in (*_SHOWN, "time_over_known", "late", "collisions")]
    say(str(of_metrics(f"{arguments.episodes} missions of each policy", found, metrics)))
    if missing := sum(each["overflow"] for each in found.values()):
        cli.warn(PROGRAM, f"{missing} times, a candidate found no slot on the map")
    say(f"All figures are in {place / 'found.json'}; pictures of the first mission beside it.")


class Explorations:
    """Missions of all policies in the same arenas, side by side, with one program for all."""

    def __init__(
        self,
        config: Config,
        models: Models,
        policies: Mapping[str, Values],
        episodes: int,
        seed: int,
    ):
        """Missions that have not begun.

        Raises:
          ConfigError: if missions cannot begin in such arenas.
        """
        begin_key, self._key = jax.random.split(jax.random.key(seed))
        self._scenario, self._models = mission.make_mission(config), models
        self._policies = policies
        self._chunks = math.ceil(config.mission.time_limit / CONTROL_PERIOD / _CHUNK)
        self._begin_keys = jax.random.split(begin_key, episodes)
        self._reset = jax.vmap(lambda key: exploration.reset(key, self._scenario, models))
        jax.eval_shape(self._reset, self._begin_keys)

    @functools.cached_property
    def _begun(self) -> ExplorationState:
        """The arenas, and what robots know of them."""
        return jax.jit(self._reset)(self._begin_keys)

    @functools.cached_property
    def _told(self) -> ExplorationState:
        """The arenas, and robots that know all places."""
        tell = jax.vmap(lambda state: exploration.told(self._scenario, state))
        return jax.jit(tell)(self._begun)

    def known(self, name: str, report: Callable[[int, int], None]) -> Measured:
        """Metrics of a policy whose robots are told all places."""
        *_, (metrics, _) = self._play(name, self._told, report)
        return metrics

    def policy(
        self, name: str, report: Callable[[int, int], None]
    ) -> tuple[Measured, list[float], list[ExplorationState]]:
        """Metrics of a policy; after each chunk, the share of PoIs found and right, and a state."""
        chunks = [*self._play(name, self._begun, report)]
        present = chunks[-1][0]["present"].sum()
        right = [float(metrics["right"].sum() / present) for metrics, _ in chunks]
        states = [state for _, state in chunks]
        over = next((i for i, state in enumerate(states) if state.done), len(states))
        return chunks[-1][0], right, states[: over + 1]

    def _play(
        self, name: str, states: ExplorationState, report: Callable[[int, int], None]
    ) -> Iterator[tuple[Measured, ExplorationState]]:
        """Metrics and the first mission after each chunk, until all missions are done."""
        report(0, 0)
        index = jnp.int32([*self._policies].index(name))
        for chunk in range(self._chunks):
            states, metrics = self._go_on(index, jax.random.fold_in(self._key, chunk), states)
            done = np.asarray(states.done)
            report(int(done.sum()), len(done))
            yield jax.tree.map(np.asarray, (metrics, jax.tree.map(lambda x: x[0], states)))
            if done.all():
                return

    @functools.partial(jax.jit, static_argnums=0)
    def _go_on(
        self, index: Int[Array, ""], key: Key, states: ExplorationState
    ) -> tuple[ExplorationState, Measured]:
        """Plays a chunk of all missions with the policy of an index."""
        models = self._models

        def policy(key: Key, models: Trained, known: Known) -> jax.Array:
            return jax.lax.switch(index, [*self._policies.values()], key, models, known)

        keys = jax.random.split(key, len(states.done))
        after = exploration.rollout_batch(keys, self._scenario, models, policy, states, _CHUNK)
        return after, jax.vmap(lambda state: exploration.measure(models, state))(after)


def _playable(agent: Agent, config: Config) -> dict[str, Values]:
    """The policies that can play; a network for one number of PoIs cannot."""
    plays = agent.plays(_num_places(config))
    return {name: x for name, x in exploration.POLICIES.items() if plays or name != "latent"}


def _num_places(config: Config) -> int:
    """Number of objects and frontiers that a robot chooses from."""
    return num_slots(config) + NUM_FRONTIERS


def _elsewhere(arguments: Arguments, config: Config) -> Config:
    """The run's settings with the places and the team of these missions."""
    fewest = arguments.arena.fewest_pois or min(4, arguments.arena.num_pois)
    places = {**vars(arguments.arena), "fewest_pois": fewest}
    if config.mission.communication.own_maps:
        cli.warn(PROGRAM, "robots share one map, other than in the run")
    errors = {name: x for name, x in vars(arguments.localisation).items() if x is not None}
    poses = dataclasses.replace(config.mission.localisation, **errors)
    return dataclasses.replace(
        config,
        arena=dataclasses.replace(config.arena, **places),
        mission=dataclasses.replace(
            config.mission, time_limit=arguments.time_limit, localisation=poses
        ),
        mdp=dataclasses.replace(config.mdp, partly_seen_starts=False),
        robots=config.robots if arguments.robots is None else arguments.robots,
    )


if __name__ == "__main__":
    output.run(main)

"""`python -m benchmarks.imperfect RUN`: missions of robots that are misplaced or hear badly.

Plays the same arenas with errors of pose and heading, constant or growing while the robots drive,
and, where looks add up, with maps by each robot between which messages are lost and late. All rows
are compared, arena by arena, with robots that know their poses and share one map. Errors and
messages of one arena are drawn alike for all sizes, so that a curve is smooth. `break` is the size
at which the accuracy has fallen by .01. If misplaced robots are to search, they play both without a
search and with one.
"""

import dataclasses
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import studies
from benchmarks.curves import Curves
from benchmarks.imperfect_tables import KEYS, MESSAGES, NO_SEARCH, SEARCH, point_in_words, tables
from benchmarks.measure import reserve
from benchmarks.same_accuracy import Need
from benchmarks.where import compare
from jaxsense import Config, Models, mission
from jaxsense.config import CommunicationConfig, ConfigError, LocalisationConfig, SearchConfig
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.config.section import Section
from jaxsense.mission import MissionState
from jaxsense.mission.maps import map_of
from jaxsense.run import cli

PROGRAM = "benchmarks.imperfect"
FALL = 0.01
"""Loss of accuracy that counts as broken."""
_DRAWS = 1000  # of the bootstrap
_DELAY_OF_LOSSES, _LOSS_OF_DELAYS = 2.0, 0.5  # s and share, of the sweeps of both together


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Plays missions with errors of localisation and with messages that are lost or late."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    episodes: int = 256
    """Missions of each row."""
    seed: int = 0
    """Seed of the arenas."""
    policy: str = "latent"
    """The policy that plays."""
    num_pois: int | None = None
    """Number of points of interest; the run's by default."""
    side: float | None = None
    """Side of the arena, in metres; the run's by default."""
    robots: tuple[str, ...] | None = None
    """Sensors of the robots, one per robot; the run's by default."""
    positions: tuple[float, ...] = (0.01, 0.02, 0.03, 0.05, 0.1)
    """Errors of the position in metres."""
    headings: tuple[float, ...] = (1.0, 2.0, 3.0, 5.0, 10.0)
    """Errors of the heading in degrees; a sweep of both takes them in pairs."""
    position_drifts: tuple[float, ...] = (0.005, 0.01, 0.02, 0.03, 0.05)
    """Errors of the position that driving adds, in metres after the first metre."""
    heading_drifts: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 5.0)
    """Errors of the heading that driving adds, in degrees after the first metre; a sweep of both
    takes them in pairs."""
    losses: tuple[float, ...] = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9)
    """Shares of the messages that are lost."""
    delays: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0, 10.0)
    """Mean delays of a message in seconds."""
    search_position: float = 0.0
    """Largest error of the position that misplaced robots search for, in metres."""
    search_heading: float = 0.0
    """Largest error of the heading that misplaced robots search for, in degrees."""
    json: Path | None = None
    """File to write; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(self.episodes >= 2, self, "episodes", "must be at least 2")
        for at, to in (("positions", "headings"), ("position_drifts", "heading_drifts")):
            is_paired = len(getattr(self, at)) == len(getattr(self, to))
            require(is_paired, self, to, f"must be as many as {at}")
        self.search  # noqa: B018

    @property
    def search(self) -> SearchConfig:
        """How far misplaced robots search."""
        return SearchConfig(position=self.search_position, heading=self.search_heading)


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One thing that gets worse.

    Attributes:
      name: of what varies.
      sizes: of each row.
      changes: the mission's sections of each row.
    """

    name: str
    sizes: tuple[float, ...]
    changes: tuple[Mapping[str, Section], ...]


class Imperfect(Curves):
    """Plays missions in the same arenas, and also measures what each robot knows."""

    def _result(self, config: Config, models: Models, state: MissionState) -> dict[str, jax.Array]:
        found, scenario = super()._result(config, models, state), self._with(config)
        measured = mission.measure(scenario, models, state)

        def of_robot(robot: jax.Array) -> jax.Array:
            known = map_of(scenario, state, robot).read(models)
            shown = jax.vmap(models.fusion.most_likely_class)(known.belief)
            is_seen = jnp.any(known.times_seen > 0, axis=-1)
            return jnp.mean(is_seen & (shown == state.classes))

        return {
            **found,
            "own": jnp.mean(jax.vmap(of_robot)(jnp.arange(len(config.carried)))),
            "nll": jnp.mean(measured["nll"]),
            "collisions": measured["collisions"].astype(jnp.float32),
        }


def poses(arguments: Arguments, search: SearchConfig) -> list[Sweep]:
    """Constant errors of position, of heading and of both, then those that driving adds.

    Args:
      arguments: of the program.
      search: of misplaced robots.
    """
    at, to = arguments.positions, arguments.headings
    moves, turns = arguments.position_drifts, arguments.heading_drifts
    of = lambda **errors: {"localisation": LocalisationConfig(search=search, **errors)}  # noqa: E731
    both, drifts = zip(at, to, strict=True), zip(moves, turns, strict=True)
    return [
        Sweep("position [m]", at, tuple(of(position_error=x) for x in at)),
        Sweep("heading [deg]", to, tuple(of(heading_error=x) for x in to)),
        Sweep("both [m]", at, tuple(of(position_error=x, heading_error=y) for x, y in both)),
        Sweep("position drift [m]", moves, tuple(of(position_drift=x) for x in moves)),
        Sweep("heading drift [deg]", turns, tuple(of(heading_drift=x) for x in turns)),
        Sweep(
            "both drifts [m]",
            moves,
            tuple(of(position_drift=x, heading_drift=y) for x, y in drifts),
        ),
    ]


def messages(arguments: Arguments) -> list[Sweep]:
    """Losses, delays, losses of late messages, and delays of messages half of which are lost.

    Args:
      arguments: of the program.
    """
    lost, late = arguments.losses, arguments.delays
    share, seconds = _LOSS_OF_DELAYS, _DELAY_OF_LOSSES

    def of(loss: float, delay: float) -> Mapping[str, Section]:
        return {"communication": CommunicationConfig(own_maps=True, loss=loss, delay=delay)}

    return [
        Sweep("loss", lost, tuple(of(x, 0.0) for x in lost)),
        Sweep("delay [s]", late, tuple(of(0.0, x) for x in late)),
        Sweep(f"loss, delay {seconds:g} s", lost, tuple(of(x, seconds) for x in lost)),
        Sweep(f"delay [s], loss {share:g}", late, tuple(of(share, x) for x in late)),
    ]


def elsewhere(arguments: Arguments, config: Config, models: Models) -> Config:
    """Settings with the arena and the robots of the arguments.

    Args:
      arguments: of the program.
      config: of the run.
      models: of the run.

    Raises:
      ConfigError: if they cannot be played.
    """
    given = {"num_pois": arguments.num_pois, "side": arguments.side}
    chosen = {name: value for name, value in given.items() if value is not None}
    arena = dataclasses.replace(config.arena, **chosen)
    if not models.agent.plays(arena.num_pois):
        raise ConfigError("num_pois", arena.num_pois, "must be a number that the run has learned")
    robots = config.robots if arguments.robots is None else arguments.robots
    return dataclasses.replace(config, arena=arena, robots=robots)


def changed(config: Config, sections: Mapping[str, Section]) -> Config:
    """Settings with other sections of the mission.

    Args:
      config: all settings.
      sections: by name.
    """
    return dataclasses.replace(config, mission=dataclasses.replace(config.mission, **sections))


def break_point(sizes: tuple[float, ...], lost: np.ndarray) -> Need | None:
    """Size at which the mean loss of accuracy reaches `FALL`, with a 95% interval.

    Args:
      sizes: K of them, rising.
      lost: `[K, E]` losses of accuracy in E arenas; 0 is lost at size 0.

    Returns:
      `mean` with `low` and `high`, the last of which is None if it may be larger than all sizes;
      None if the mean is.
    """
    middle = _reached(sizes, lost.mean(axis=1))
    if not np.isfinite(middle):
        return None
    draws = np.random.default_rng(0).integers(lost.shape[1], size=(_DRAWS, lost.shape[1]))
    again = [_reached(sizes, lost[:, rows].mean(axis=1)) for rows in draws]
    ends = np.quantile(again, (0.025, 0.975), method="inverted_cdf")
    low, high = (float(end) if np.isfinite(end) else None for end in ends)
    return {"mean": middle, "low": low, "high": high}


def _reached(sizes: tuple[float, ...], lost: np.ndarray) -> float:
    """First size at which lines through the points and the origin reach `FALL`, or infinity."""
    before = (0.0, 0.0)
    for size, loss in zip(sizes, lost, strict=True):
        if loss >= FALL:
            share = (FALL - before[1]) / (loss - before[1])
            return float(before[0] + share * (size - before[0]))
        before = (size, loss)
    return float("inf")


def play(
    curves: Curves, models: Models, policy: str, sweeps: list[Sweep], usual: dict[str, np.ndarray]
) -> Iterator[dict]:
    """Rows of each sweep, and its break point.

    Args:
      curves: plays missions, whose settings differ in numbers alone from those of the sweeps.
      models: of a finished run.
      policy: the name of the policy that plays.
      sweeps: what gets worse.
      usual: `[E]` figures of robots that know their poses and share one map.
    """
    for sweep in (each for each in sweeps if each.sizes):
        rows, lost = [], []
        for size, sections in zip(sweep.sizes, sweep.changes, strict=True):
            config = changed(curves.scenario.config, sections)
            found = curves.play(models, policy, config)
            rows.append({"size": size, **compare(found, usual, tuple(KEYS))})
            lost.append(usual["accuracy"] - found["accuracy"])
        point = break_point(sweep.sizes, np.stack(lost))
        print(sweep.name, point_in_words(point), file=sys.stderr)
        yield {"sweep": sweep.name, "rows": rows, "break": point}


def measure(arguments: Arguments, config: Config, models: Models) -> dict[str, object]:
    """The figures of the JSON file: without errors, and of each curve by sweep.

    Args:
      arguments: of the program.
      config: settings of the missions, without errors.
      models: of a finished run.
    """
    key, policy = jax.random.key(arguments.seed), arguments.policy
    share = Imperfect(key, config, arguments.episodes, only=(policy,))
    usual = share.play(models, policy)
    searches = {NO_SEARCH: SearchConfig()}
    if arguments.search.applies:
        searches[SEARCH] = arguments.search
    found = {
        name: [*play(share, models, policy, poses(arguments, search), usual)]
        for name, search in searches.items()
    }
    if models.fusion.accumulates:
        own_maps = {"communication": CommunicationConfig(own_maps=True)}
        each = Imperfect(key, changed(config, own_maps), arguments.episodes, only=(policy,))
        found[MESSAGES] = [*play(each, models, policy, messages(arguments), usual)]
    return {
        "usual": {name: float(usual[name].mean()) for name in KEYS},
        "curves": {name: sweeps for name, sweeps in found.items() if sweeps},
    }


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    trained, models = studies.load(PROGRAM, arguments.run)
    exact = {"localisation": LocalisationConfig(), "communication": CommunicationConfig()}
    try:
        config = elsewhere(arguments, trained, models)
        changed(config, {"localisation": LocalisationConfig(search=arguments.search)})
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    reserve(PROGRAM, "json", arguments.json)
    origin = studies.origin(PROGRAM, arguments)
    results = {**origin, **measure(arguments, changed(config, exact), models)}
    studies.write(arguments.json, results)
    print(*tables(results), sep="\n\n")


if __name__ == "__main__":
    main()

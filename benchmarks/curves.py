"""`python -m benchmarks.curves RUN`: looks and time that policies need for the same accuracy.

A single figure of a policy depends on when it stops, so each plays missions with several costs of a
look: the values of looks are computed and the Q-networks trained for each of them, with the
detectors and the fusion of the run. Naive exploration plays with one to five looks. The oracle
knows the classes: it looks at what its own sensor has to tell the map until that has the true class
with some probability, along the shortest tour. `benchmarks.same_accuracy` compares the curves.
"""

import dataclasses
import itertools
import math
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, cast

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import same_accuracy, studies
from benchmarks.measure import joined, reserve, save
from benchmarks.same_accuracy import Points, as_block, stacked
from jaxsense import Config, Key, Models, detections, mission
from jaxsense.config.checks import check_fields, require
from jaxsense.config.options import Name
from jaxsense.dqn import policies
from jaxsense.dqn.policies import Known, Policy, Trained
from jaxsense.mission import Mission, MissionState
from jaxsense.models import make_agent
from jaxsense.run import cli, devices
from jaxsense.sim.world import Scene, make_world
from jaxsense.training import agents
from jaxsense.training.detections import Detections, Starts
from jaxsense.training.stage import Stage, compose

PROGRAM = "benchmarks.curves"
ORACLE = (0.8, 0.95, 0.99)
NAIVE = 5
_BY_COST = ("latent", "greedy", "bayes", "optimal", "nearest", "auction", "rollout")
_SAMPLES = 4000  # detections of each class by each sensor
_CHUNK = 25  # control periods
_MOST_POIS = 6  # whose orders the oracle tries; it does not play with more


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Plays every policy with several costs of a look, and compares them at the same accuracy."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, `latest`, or `pretrained:PRESET`."""
    episodes: int = 256
    """Missions of each policy with each cost."""
    seed: int = 0
    """Seed of the arenas and of the trainings."""
    costs: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.5)
    """Costs of a look, which only rewards in nats read."""
    json: Path | None = None
    """File to write; must be new."""
    plot: Path | None = None
    """Picture to write, for example `curves.png`."""

    def __post_init__(self):
        check_fields(self, bits=64)
        require(self.episodes >= 2, self, "episodes", "must be at least 2")


def oracle(share: float) -> Policy:
    """The policy that knows the classes, which `_start` writes into the exact posterior.

    Args:
      share: probability of the true class on the map at which it stops.
    """

    def values(key: Key, models: Trained, known: Known) -> jax.Array:
        del key
        assert isinstance(models, Models)
        truth = jnp.argmax(known.log_posterior, axis=-1)
        on_map = jax.vmap(models.fusion.class_probabilities)(known.belief)
        labels = jnp.asarray(models.bayes.labels)[known.modality]
        has_label = labels[None] == labels[truth][:, None]
        of_label = jnp.sum(jnp.where(has_label, on_map, 0.0), axis=-1)
        is_useful = known.team.present & (of_label < share)
        return jnp.append(jnp.where(is_useful, -_tours(known, is_useful), -1e6), -1e5)

    return Policy(values, counts_time=lambda agent: True)


def _tours(known: Known, is_useful: jax.Array) -> jax.Array:
    """`[N]` metres of the shortest tour of the useful PoIs that starts with each."""
    places, start = known.team.positions, known.team.poses[known.robot, :2]
    orders = np.array([*itertools.permutations(range(len(places)))])

    def length(order: jax.Array) -> jax.Array:
        def go_on(carry: tuple[jax.Array, jax.Array], poi: jax.Array):
            position, total = carry
            onwards = total + jnp.linalg.norm(places[poi] - position)
            return jax.tree.map(
                lambda new, old: jnp.where(is_useful[poi], new, old), (places[poi], onwards), carry
            ), None

        return jax.lax.scan(go_on, (start, jnp.float32(0)), order)[0][1]

    lengths = jax.vmap(length)(jnp.asarray(orders))
    is_first = jnp.asarray(orders)[:, :1] == jnp.arange(len(places))[None]
    return jnp.min(jnp.where(is_first, lengths[:, None], jnp.inf), axis=0)


def of_costs(key: Key, config: Config, models: Models, costs: jax.Array) -> Models:
    """Models with the values of looks and the Q-networks for each of K costs, `[K]`.

    Args:
      key: random key.
      config: all settings.
      models: of a finished run.
      costs: `[K]` of a look.
    """
    world = make_world(config)
    bank_key, held_out_key, train_key = jax.random.split(key, 3)
    bank = detections(bank_key, config, models, _SAMPLES)
    held_out = detections(held_out_key, config, models, _SAMPLES)
    none = jnp.zeros((0, config.arena.num_pois), jnp.int32)
    found = Detections(
        bank=bank,
        held_out=held_out,
        starts=Starts(none, cast(Scene, ()), ()),
        windows=(),
    )
    names = tuple(f"detector_{name}" for name in config.modalities)
    given = {
        "detections": found,
        "fusion": models.fusion,
        "class_beliefs": models.fusion.classes,
        **dict(zip(names, models.detectors, strict=True)),
    }

    def known(name: str) -> Stage:
        return Stage(name, lambda key, config: given[name])

    inputs = {"classes": "class_beliefs", "detections": "detections"}
    stages = [
        *map(known, given),
        Stage("look_values", agents.look_values, inputs),
        *agents.agent_stages(world.arena, config),
    ]

    @jax.jit
    def train(cost: jax.Array) -> Models:
        priced = dataclasses.replace(config, mdp=dataclasses.replace(config.mdp, look_cost=cost))
        outputs = compose(train_key, priced, stages).outputs
        learned = tuple(outputs[agents.learner(config, name)] for name in config.modalities)
        return dataclasses.replace(
            models,
            look_values=outputs["look_values"],
            agent=make_agent(priced),
            q_networks=learned,
        )

    return jax.tree.map(lambda *x: jnp.stack(x), *map(train, costs))


class Curves:
    """Plays missions of policies in the same arenas."""

    def __init__(
        self,
        key: Key,
        config: Config,
        episodes: int,
        own: Mapping[str, Policy] = MappingProxyType({}),
        only: Collection[str] | None = None,
    ):
        """Missions of E arenas, with a program that is compiled once.

        Args:
          key: random key.
          config: all settings.
          episodes: E.
          own: more policies than those of the settings, by name.
          only: names of the policies that play, which makes compiling faster; all by default.
        """
        made = mission.make_mission(config, own)
        chosen = {name: x for name, x in made.policies.items() if only is None or name in only}
        self.scenario = dataclasses.replace(made, policies=chosen)
        threads = devices.cores() if jax.default_backend() == "cpu" else 1
        self._keys = jnp.split(jax.random.split(key, episodes), math.gcd(episodes, threads or 1))
        options = devices.compiler_options()  # compiling takes longer than playing
        start = jax.vmap(self._start, in_axes=(0, None, None, None))
        self._begin = jax.jit(start, compiler_options=options)
        self._go_on = jax.jit(self._play_on, compiler_options=options)
        self._measure = jax.jit(jax.vmap(self._result, in_axes=(None, None, 0)))

    def _with(self, config: Config) -> Mission:
        """The same mission with other numbers, which may be traced."""
        arenas = self.scenario.world.arena, self.scenario.free_arena
        made = mission.make_mission(config, arenas=arenas)
        return dataclasses.replace(made, policies=self.scenario.policies)

    def _start(self, key: Key, config: Config, models: Models, policy: jax.Array) -> MissionState:
        """A mission in which the policies `oracle` read the true classes."""
        state = mission.reset(key, self._with(config), models, policy)
        names = [*self.scenario.policies]
        knows = jnp.array([name.startswith("oracle") for name in names])[policy]
        of_class = jax.nn.one_hot(state.classes, state.log_posterior.shape[1])
        truth = jax.nn.log_softmax(100 * of_class)
        return dataclasses.replace(
            state, log_posterior=jnp.where(knows, truth, state.log_posterior)
        )

    def _play_on(
        self, keys: Key, config: Config, models: Models, states: MissionState
    ) -> MissionState:
        scenario = self._with(config)
        return mission.rollout_batch(keys, scenario, models, states, _CHUNK, 1)[0]

    def _result(self, config: Config, models: Models, state: MissionState) -> dict[str, jax.Array]:
        found = mission.measure(self._with(config), models, state)
        return {
            "accuracy": jnp.mean(found["is_right"].astype(jnp.float32)),
            "confidence": jnp.mean(found["confidence"]),
            "looks": found["observations_per_poi"],
            "time": found["time_s"],
        }

    def play(
        self, models: Models, policy: str, config: Config | None = None
    ) -> dict[str, np.ndarray]:
        """`accuracy`, `confidence`, `looks` per PoI and `time` of a policy, `[E]` each.

        Args:
          models: trained models.
          policy: its name.
          config: settings with other numbers; by default those of the missions.
        """
        config = self.scenario.config if config is None else config
        number = jnp.int32(self.scenario.policy(policy))
        states = [self._begin(keys, config, models, number) for keys in self._keys]

        def advance(part: int, chunk: int) -> None:
            keys = jax.vmap(lambda key: jax.random.fold_in(key, chunk))(self._keys[part])
            states[part] = self._go_on(keys, config, models, states[part])

        def finish(part: int) -> None:
            for chunk in itertools.count(2):
                if np.all(states[part].done):
                    return
                advance(part, chunk)

        # One after the other, so that the program is compiled once.
        for part in range(len(states)):
            advance(part, 1)
        devices.side_by_side(finish, len(states))
        return joined([self._measure(config, models, each) for each in states])


def play_all(curves: Curves, costs: tuple[float, ...], priced: Models, free: Models) -> Iterator:
    """The curve of every policy: its name, what varies along it, and its points.

    Args:
      curves: plays missions.
      costs: of a look.
      priced: models for each cost, `[K]`.
      free: models of the run.
    """
    each = [jax.tree.map(lambda x: x[i], priced) for i in range(len(costs))]  # noqa: B023
    for name in _BY_COST:
        yield name, {"look_cost": costs}, stacked([curves.play(m, name) for m in each])
    names = [name for name in curves.scenario.policies if name.startswith("naive")]
    yield "naive", {"looks": tuple(range(1, NAIVE + 1))}, _of(curves, free, names)
    names = [name for name in curves.scenario.policies if name.startswith("oracle")]
    if names:
        yield "oracle", {"probability": ORACLE}, _of(curves, free, names)
    yield "random", {"look_cost": (None,)}, _of(curves, free, ["random"])


def _of(curves: Curves, models: Models, names: list[str]) -> Points:
    return stacked([curves.play(models, name) for name in names])


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    config, models = studies.load(PROGRAM, arguments.run)
    reserve(PROGRAM, "json", arguments.json)
    train_key, play_key = jax.random.split(jax.random.key(arguments.seed))
    priced = of_costs(train_key, config, models, jnp.array(arguments.costs))
    own = {f"naive_{k}": Policy(policies.naive(k), is_unordered=True) for k in (4, NAIVE)}
    if config.arena.num_pois <= _MOST_POIS:
        own |= {f"oracle_{share}": oracle(share) for share in ORACLE}
    curves = Curves(play_key, config, arguments.episodes, own)
    blocks = [as_block(*curve) for curve in play_all(curves, arguments.costs, priced, models)]
    results = {**studies.origin(PROGRAM, arguments), "policies": blocks}
    studies.write(arguments.json, results)
    print(same_accuracy.table(results))
    if arguments.plot is not None:
        save(PROGRAM, "plot", arguments.plot, same_accuracy.draw(blocks))


if __name__ == "__main__":
    main()

"""Trains what all fusions share, and measures each of them."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from benchmarks.fusions.kinds import Audited, ExactNats, LogOdds, Mixture, ProbabilityAgent, Product
from benchmarks.fusions.table import Figures
from jaxsense import (
    PRESETS,
    Bank,
    Config,
    Fusion,
    Key,
    Models,
    learn,
    make_bayes,
    mission,
)
from jaxsense.config import PresetName
from jaxsense.dqn import episodes, policies
from jaxsense.dqn import training as dqn
from jaxsense.dqn.map_mdp import MapMdp
from jaxsense.dqn.policies import Known
from jaxsense.mission import Mission, MissionState
from jaxsense.models import make_models
from jaxsense.run import devices
from jaxsense.training import fusions, measures
from jaxsense.training.stage import Outputs, key_of
from jaxsense.vae import InPlace
from jaxsense.vae.bayes import Bayes

Each = Callable[[Callable[["Kind"], Figures], Iterable["Kind"]], Iterator[Figures]]
"""Like `map`."""

_HISTORIES = 12288  # of looks, for the NLL
_EPISODES = 4096  # of the map MDP, for the return
_CHUNK = 25  # control periods, after which missions may all be done


@dataclasses.dataclass(frozen=True)
class Kind:
    """A way of fusing.

    Attributes:
      numbers: `(classes, latent dimensions) -> numbers` of 4 bytes that hold a belief.
      make: `(config, outputs of a training) -> fusion`.
    """

    numbers: Callable[[int, int], int]
    make: Callable[[Config, Outputs], Fusion]


def _in_place(config: Config, outputs: Outputs) -> InPlace:
    del config
    return outputs["in_place"]


def _product(config: Config, outputs: Outputs) -> Product:
    base = _in_place(config, outputs)
    return Product(**{field.name: getattr(base, field.name) for field in dataclasses.fields(base)})


KINDS: Mapping[str, Kind] = {
    "class log-odds": Kind(lambda c, d: c - 1, lambda config, _: LogOdds(make_bayes(config))),
    "in place": Kind(lambda c, d: 2 * d, _in_place),
    "filter": Kind(lambda c, d: 2 * d, lambda _, outputs: outputs["fusion"]),
    "product of experts": Kind(lambda c, d: 2 * d, _product),
    "mixture of experts": Kind(lambda c, d: 2 * d + 1, lambda *x: Mixture(_in_place(*x))),
}
"""The ways of fusing by name, in the order of the table."""


def sizes(config: Config) -> dict[str, int]:
    """Bytes of a belief of each fusion."""
    number, latent_size = len(config.arena.classes), config.jmvae.latent_size
    return {name: 4 * kind.numbers(number, latent_size) for name, kind in KINDS.items()}


def settings(preset: PresetName) -> Config:
    """The settings of a preset that all fusions share.

    Args:
      preset: its name. Beliefs accumulate by a filter, looks are drawn from stored detections, and
        the Q-network learns from nats, as in the preset `noisy`.
    """
    config = PRESETS[preset]
    return dataclasses.replace(
        config,
        jmvae=dataclasses.replace(config.jmvae, fusion="filter"),
        mdp=dataclasses.replace(config.mdp, reward="nats"),
        dqn=dataclasses.replace(config.dqn, task="map", observe="bank"),
        evaluation=dataclasses.replace(
            config.evaluation, num_histories=min(_HISTORIES, config.evaluation.num_histories)
        ),
    )


class Study:
    """Trains and measures all fusions of one seed after another.

    Each program is compiled when first called, and serves all seeds. Several threads may share
    them afterwards.

    Attributes:
      config: all settings, from `settings`.
    """

    def __init__(self, config: Config, missions: int):
        """Prepares the programs; `missions` of each fusion and seed, 0 for the NLL alone."""
        scenario = mission.make_mission(config)
        scenario = dataclasses.replace(scenario, policies={"latent": policies.POLICIES["latent"]})
        quick = devices.compiler_options()  # compiling takes longer than playing
        self.config = config
        self._plays = missions > 0
        self._learn = jax.jit(functools.partial(_learned, config))
        self._optimal = jax.jit(functools.partial(_optimal, config))
        self._nll = jax.jit(functools.partial(_nll, config))
        self._judge = jax.jit(functools.partial(_judge, config))
        self._play = jax.jit(functools.partial(_play, scenario, missions), compiler_options=quick)

    def measure(self, seed: int, each: Each = map) -> dict[str, Figures]:
        """Figures of each fusion, and with missions of `optimal`, whose only figures are returns.

        Args:
          seed: of everything.
          each: measures the fusions one after another, or side by side.
        """
        key = jax.random.key(seed)
        outputs = self._learn(key)

        def of_kind(kind: Kind) -> Figures:
            fusion = kind.make(self.config, outputs)
            figures = self._nll(key, fusion, outputs)
            if self._plays:
                returns, q_networks = self._judge(key, fusion, outputs)
                models = _models(self.config, fusion, outputs, q_networks)
                figures = figures | returns | self._play(key, models)
            return _as_floats(figures)

        found = dict(zip(KINDS, each(of_kind, KINDS.values()), strict=True))
        if self._plays:
            found["optimal"] = _as_floats(self._optimal(key, outputs))
        return found


def _as_floats(figures: Mapping[str, jax.Array]) -> Figures:
    return {name: float(x) for name, x in figures.items()}


def _learned(config: Config, key: Key) -> Outputs:
    """What fusions share: detectors, detections, JMVAE, classes, two fusions, values of looks."""
    shared = [*(f"detector_{name}" for name in config.modalities), "detections", "best_jmvae"]
    shared += ["novelty", "class_beliefs", "fusion", "look_values"]
    outputs = learn(key, config, until="look_values").outputs
    in_place = fusions.fit_in_place(
        key_of(key, "in_place"),
        config,
        params=outputs["best_jmvae"],
        classes=outputs["class_beliefs"],
        detections=outputs["detections"],
    )
    return {"in_place": in_place, **{name: outputs[name] for name in shared}}


def _models(
    config: Config, fusion: Fusion, outputs: Outputs, q_networks: tuple[PyTree, ...]
) -> Models:
    made = make_models(
        config,
        detectors=tuple(outputs[f"detector_{name}"] for name in config.modalities),
        jmvae=outputs["best_jmvae"],
        fusion=fusion,
        novelty=outputs["novelty"],
        look_values=outputs["look_values"],
        q_networks=q_networks,
        tours=(),
    )
    return dataclasses.replace(made, agent=_agent(config, fusion))


def _agent(config: Config, fusion: Fusion) -> ProbabilityAgent:
    number, latent_size = config.arena.num_pois, config.jmvae.latent_size
    return ProbabilityAgent(config.dqn.discount, number, latent_size, config.dqn.hidden, fusion)


def _mdp(config: Config, fusion: Audited, features: tuple[jax.Array, ...]) -> MapMdp:
    """The map MDP with the reward in nats of the exact posterior."""
    reward = ExactNats(config.mdp.look_cost)
    return MapMdp(Bank(features), fusion, reward, config.mdp, config.arena.num_pois)


def _nll(config: Config, key: Key, fusion: Fusion, outputs: Outputs) -> dict[str, jax.Array]:
    """NLLs of a fusion, after the same looks for all fusions."""
    detections = outputs["detections"]
    found = measures.beliefs(key_of(key, "nll"), config, fusion=fusion, detections=detections)
    return {f"nll {1 + k}": nll for k, nll in enumerate(found["nll"])}


def _judge(
    config: Config, key: Key, fusion: Fusion, outputs: Outputs
) -> tuple[dict[str, jax.Array], tuple[PyTree, ...]]:
    """Returns of a fusion, and the Q-networks that learned with it."""
    detections = outputs["detections"]
    audited = Audited(fusion, make_bayes(config))
    agent = _agent(config, audited)
    mdp, held_out = (_mdp(config, audited, x) for x in (detections.bank, detections.held_out))

    def train(modality: jax.Array) -> tuple[jax.Array, PyTree]:
        environment = agent.environment(mdp, modality)
        q_network = dqn.train(key_of(key, "dqn"), environment, config.dqn)[0].params

        def act(_: Key, known: Known) -> jax.Array:
            observed = agent.observe(known.belief, known.team, known.robot)
            return policies.best(agent.values(q_network, observed))

        return _mean_return(key, held_out, act, modality, audited.bayes), q_network

    # One after the other, by one program.
    returns, q_networks = jax.lax.map(train, jnp.arange(len(config.modalities)))
    of_each = [jax.tree.map(lambda x: x[m], q_networks) for m in range(len(config.modalities))]  # noqa: B023
    return _by_modality(config, returns), tuple(of_each)


def _optimal(config: Config, key: Key, outputs: Outputs) -> dict[str, jax.Array]:
    """Returns of the optimal policy."""
    fusion = LogOdds(make_bayes(config))
    models = _models(config, fusion, outputs, ())
    mdp = _mdp(config, Audited(fusion, models.bayes), outputs["detections"].held_out)

    def act(key: Key, known: Known) -> jax.Array:
        return policies.best(policies.optimal(key, models, known))

    number = len(config.modalities)
    returns = jax.lax.map(
        lambda m: _mean_return(key, mdp, act, m, models.bayes), jnp.arange(number)
    )
    return _by_modality(config, returns)


def _mean_return(
    key: Key,
    mdp: MapMdp,
    act: Callable[[Key, Known], jax.Array],
    modality: jax.Array,
    exact: Bayes,
) -> jax.Array:
    """Mean total reward of a policy, with the same starts and looks for all policies."""

    def episode(key: Key) -> jax.Array:
        reset_key, play_key = jax.random.split(key)
        start = episodes.reset(reset_key, mdp, exact)
        return episodes.run_episode(play_key, mdp, exact, act, start, modality)[0]

    return jnp.mean(jax.vmap(episode)(jax.random.split(key_of(key, "episodes"), _EPISODES)))


def _by_modality(config: Config, returns: jax.Array) -> dict[str, jax.Array]:
    return {f"return {name}": x for name, x in zip(config.modalities, returns, strict=True)}


def _play(scenario: Mission, number: int, key: Key, models: Models) -> dict[str, jax.Array]:
    """Figures of missions, whose arenas depend on the key alone."""
    arena_key, play_key = jax.random.split(key_of(key, "mission"))
    keys = jax.random.split(arena_key, number)
    states = jax.vmap(lambda key: mission.reset(key, scenario, models))(keys)

    def go_on(carry: tuple[jax.Array, MissionState]) -> tuple[jax.Array, MissionState]:
        chunk, states = carry
        keys = jax.random.split(jax.random.fold_in(play_key, chunk), number)
        return chunk + 1, mission.rollout_batch(keys, scenario, models, states, _CHUNK, 1)[0]

    _, states = jax.lax.while_loop(
        lambda carry: ~jnp.all(carry[1].done), go_on, (jnp.int32(0), states)
    )
    found = jax.vmap(lambda state: mission.measure(scenario, models, state))(states)
    return {
        "accuracy": jnp.mean(found["is_right"]),
        "looks": jnp.mean(found["observations_per_poi"]),
        "seconds": jnp.mean(found["time_s"]),
        "late": jnp.mean(found["reason"] == mission.REASONS.index("time limit")),
    }

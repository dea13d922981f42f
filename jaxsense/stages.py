"""The whole training, written once: a list of stages, and their composition.

A stage is a value: a name and three pure functions, `begin`, `advance` and `finish`. `learn`
composes the list into one function, which you can `vmap` over seeds and settings. `jaxsense.run`
walks it from the host, and reports, saves and stops between two calls of `advance`. Both use the
same keys.
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jaxsense import examine, observe
from jaxsense.config import Config
from jaxsense.core import networks, supervised
from jaxsense.core.networks import Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key, pytree
from jaxsense.dqn import belief_mdp, optimum, policies, rules, team_mdp, tours
from jaxsense.dqn import training as dqn
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team_mdp import TeamMdp, TeamState
from jaxsense.dqn.tours import Trials
from jaxsense.dqn.training import DqnState
from jaxsense.models import Models, expected_gains, make_jmvae, readout
from jaxsense.observe import Bank
from jaxsense.sim import world as worlds
from jaxsense.sim.world import Scene, World
from jaxsense.vae import detectors, filtering, fusion, jmvae, peers
from jaxsense.vae.detectors import Detector
from jaxsense.vae.fusion import FILTER

_MOST_CHUNKS = 20
_MOST_LOOKS = 20  # at one PoI, in the values of looks


Examples = tuple[jax.Array, jax.Array]
"""Windows of a detector, and their labels."""


@pytree
class Progress:
    """Loss and metrics of some steps of a training.

    Attributes:
      loss: `[steps]`; NaN where an input or a parameter of the step is not finite.
      metrics: `[steps]` each; NaN where a step has none.
    """

    loss: jax.Array
    metrics: dict[str, jax.Array]


@dataclasses.dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a training.

    Attributes:
      name: determines the random keys of the stage.
      begin: `(key, config, *inputs) -> output`.
      inputs: names of the earlier stages whose outputs it takes.
      index: passed before the other inputs if given, as `[]` int32.
      program: name of the programs; stages that share it have the same functions and shapes.
      has_rows: the rows of inputs and output are independent, so that devices can share them.
      is_saved: a run saves the output, and does not repeat the stage when it resumes.
    """

    name: str
    begin: Callable[..., Any]
    inputs: tuple[str, ...] = ()
    index: int | None = None
    program: str = ""
    has_rows: bool = False
    is_saved: bool = False

    def key(self, key: Key) -> Key:
        """The key of `begin`, from the key of a training."""
        return jax.random.fold_in(_key_of(key, self.name), 0)

    def select(self, outputs: Mapping[str, Any]) -> tuple[Any, ...]:
        """The inputs, from the outputs of earlier stages."""
        index = () if self.index is None else (jnp.int32(self.index),)
        return *index, *(outputs[name] for name in self.inputs)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Steps(Stage):
    """A stage of many steps, in chunks; its `begin` returns the first state.

    Attributes:
      advance: `(key, config, state, *inputs) -> (state, Progress)`, one chunk.
      finish: `(config, state, *inputs) -> output`.
      steps: number of steps.
      chunks: calls of `advance`; the last one may have fewer steps.
      is_optional: a loss that is not finite ends this stage early, and no other.
      is_dense: small dense networks take nearly all of the time.
    """

    advance: Callable[..., tuple[Any, Progress]]
    finish: Callable[..., Any]
    steps: int
    chunks: int
    is_saved: bool = True
    is_optional: bool = False
    is_dense: bool = True

    def chunk_keys(self, key: Key) -> Key:
        """The `[chunks]` keys of `advance`, from the key of a training."""
        own = _key_of(key, self.name)
        return jax.vmap(lambda i: jax.random.fold_in(own, i))(1 + jnp.arange(self.chunks))


@pytree
class Surveys:
    """Every robot's look at every PoI of `[S]` scenes.

    Attributes:
      classes: `[S, N]` int32 true classes.
      scenes: `[S]` scenes.
      windows: for each modality `[S, N, F]` the input of its detector.
    """

    classes: jax.Array
    scenes: Scene
    windows: tuple[jax.Array, ...]


@pytree
class Detections:
    """Detections on surveys that no detector was trained on.

    Attributes:
      bank: for each modality `[C, S, D_m]` detections for training.
      held_out: the same from other scenes, to measure on.
      starts: classes, scenes and for each modality `[S, N, D_m]` features, where episodes start;
        empty with a bank.
      metrics: of each detector on the held-out looks, see `examine.detector`.
      windows: for each modality `[C, 1, F]` one held-out look at each class.
    """

    bank: Bank
    held_out: Bank
    starts: tuple[jax.Array, Scene, tuple[jax.Array, ...]]
    metrics: dict[str, dict[str, jax.Array]]
    windows: tuple[jax.Array, ...]


@pytree
class Learned:
    """The outputs of a training.

    Attributes:
      outputs: of every stage, by its name.
      progress: `[steps]` of every stage that has steps, by its name.
      is_finite: `[]` whether all losses and outputs are, except those of optional stages.
    """

    outputs: dict[str, Any]
    progress: dict[str, Progress]
    is_finite: jax.Array


def stages(config: Config, world: World | None = None) -> list[Stage]:
    """The stages of a training, each after its inputs.

    Args:
      config: all settings; its static fields determine the stages and all sizes.
      world: from `sim.make_world(config)`, to reuse one.
    """
    world = worlds.make_world(config) if world is None else world
    detector_names = tuple(f"detector_{name}" for name in config.modalities)
    restarts = tuple(f"jmvae_{i + 1}" for i in range(config.jmvae.restarts))
    with_filter = _filter_stages(config) if config.jmvae.fusion == "filter" else []
    params = with_filter[-1].name if with_filter else "jmvae"
    learned = "detections", params, *detector_names
    modalities = range(len(config.modalities))
    return [
        Stage("scenes", _draw_scenes),
        Stage("survey", functools.partial(_survey, world), ("scenes",), has_rows=True),
        Stage("examples", _examples, ("survey",)),
        *(_detector_stage(m, name, config) for m, name in enumerate(detector_names)),
        Stage("detections", _detect, ("survey", *detector_names)),
        *(_restart_stage(name, config) for name in restarts),
        Stage("jmvae", _best_jmvae, restarts, program="best_jmvae", is_saved=True),
        Stage("class_beliefs", _class_beliefs, ("jmvae", "detections"), is_saved=True),
        *with_filter,
        Stage("latent_space", _latent_space, (params, "class_beliefs", "detections")),
        Stage("look_values", _look_values, ("class_beliefs", "detections"), is_saved=True),
        Stage("beliefs", _measure_beliefs, (params, "class_beliefs", "detections")),
        Stage("starts", functools.partial(_starts, world), learned),
        *_agent_stages(world, config, learned),
        *([_tour_stage(config, params)] if config.dqn.task == "team" else []),
        *(_policies_stage(m, config, params) for m in modalities),
        *(
            _other_numbers_stage(m, config, params)
            for m in modalities
            if config.evaluation.num_pois
        ),
    ]


def learn(
    key: Key,
    config: Config,
    world: World | None = None,
    *,
    until: str | None = None,
) -> Learned:
    """The whole training as one pure function.

    Args:
      key: the only source of randomness.
      config: all settings. Fields declared `Traced` may be traced, so that `jax.vmap` varies them.
      world: from `sim.make_world(config)`, to reuse one.
      until: name of the last stage to compose; all by default.

    Returns:
      The outputs of the stages: the trained networks, see `models`, and all that a run measures
      except its missions.

    Raises:
      ValueError: if no stage has this name.
    """
    found = stages(config, world)
    names = [stage.name for stage in found]
    if until is not None and until not in names:
        raise ValueError(f"until = {until!r}: must be one of {', '.join(names)}")
    outputs: dict[str, Any] = {}
    progress: dict[str, Progress] = {}
    finite = [jnp.bool_(True)]
    for stage in found[: None if until is None else names.index(until) + 1]:
        inputs = stage.select(outputs)
        output = stage.begin(stage.key(key), config, *inputs)
        if isinstance(stage, Steps):
            output, progress[stage.name] = _run_steps(stage, key, config, output, inputs)
            # Of an optional stage nothing need be finite; `jmvae` chooses among them.
            finite += [] if stage.is_optional else [is_finite((output, progress[stage.name].loss))]
        else:
            finite.append(is_finite(output))
        outputs[stage.name] = output
    return Learned(outputs, progress, jnp.stack(finite).all())


def _run_steps(
    stage: Steps, key: Key, config: Config, state: Any, inputs: tuple[Any, ...]
) -> tuple[Any, Progress]:
    """All chunks of a stage: its output and `[steps]` of progress."""

    def advance(state: Any, key: Key) -> tuple[Any, Progress]:
        return stage.advance(key, config, state, *inputs)

    state, chunks = jax.lax.scan(advance, state, stage.chunk_keys(key))
    progress = jax.tree.map(lambda x: x.reshape(-1)[: stage.steps], chunks)
    return stage.finish(config, state, *inputs), progress


def models(outputs: Mapping[str, Any], config: Config) -> Models:
    """The networks among the outputs of all stages."""
    trained = {FILTER: outputs[FILTER]} if FILTER in outputs else {}
    return Models(
        detectors=tuple(outputs[f"detector_{name}"] for name in config.modalities),
        jmvae={**outputs["jmvae"], **trained},
        class_beliefs=outputs["class_beliefs"],
        moments_inverse=filtering.moments_inverse(outputs["class_beliefs"]),
        unseen=_unseen(config),
        look_values=outputs["look_values"],
        q_networks=tuple(outputs[agent(config, name)] for name in config.modalities),
        tours=outputs.get("tours"),
    )


def agent(config: Config, modality: str) -> str:
    """Name of the stage that trains the Q-network of a modality's robots."""
    return "dqn_team" if config.dqn.task == "team" else f"dqn_{modality}"


def mission_key(key: Key) -> Key:
    """The key of the missions that follow a training with this key."""
    return _key_of(key, "mission")


def _key_of(key: Key, name: str) -> Key:
    """The key of a name, independent of all other names."""
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


def is_finite(values: Any) -> jax.Array:
    """`[]` whether all real numbers in a pytree are finite."""
    leaves = [x for x in jax.tree.leaves(values) if jnp.issubdtype(jnp.result_type(x), jnp.inexact)]
    return jnp.stack([jnp.isfinite(x).all() for x in leaves] or [jnp.bool_(True)]).all()


def num_scenes(config: Config) -> tuple[int, int, int]:
    """Numbers of scenes to train the detectors, for the bank, and to measure."""
    num_pois, num_classes = config.arena.num_pois, len(config.arena.classes)
    num_bank = -(-config.jmvae.samples_per_class * num_classes // num_pois)
    num_held_out = -(-_held_out_per_class(config) * num_classes // num_pois)
    num_train = -(-config.detector.num_scans // num_pois)
    return num_train, max(num_bank, _num_scene_starts(config)), num_held_out


def make_mdp(
    world: World, config: Config, bank: Bank, params: Params, trained: tuple[Detector, ...]
) -> MapMdp | TeamMdp:
    """The MDP in which the Q-networks learn, see `config.dqn.task` and `config.dqn.observe`."""
    model = make_jmvae(config)
    if config.dqn.task == "team":
        return observe.team_mdp(config, bank, params, model)
    if config.dqn.observe == "live":
        return observe.live_mdp(config, worlds.with_config(world, config), trained, params, model)
    return observe.bank_mdp(config, bank, params, model)


def _held_out_per_class(config: Config) -> int:
    return -(-config.detector.num_held_out // len(config.arena.classes))


def _num_scene_starts(config: Config) -> int:
    """Surveyed scenes in which episodes start; none with a bank."""
    return config.dqn.num_starts if config.dqn.observe == "live" else 0


def _chunk_size(steps: int) -> int:
    """Steps of a chunk, for at most 20 chunks."""
    return -(-steps // _MOST_CHUNKS)


def _num_chunks(steps: int) -> int:
    return -(-steps // _chunk_size(steps))


def _draw_scenes(key: Key, config: Config) -> tuple[Key, jax.Array]:
    """`[S]` keys of all scenes, and `[S, N]` classes of their PoIs."""
    class_key, scene_key = jax.random.split(key)
    numbers = num_scenes(config)
    keys = jax.random.split(class_key, len(numbers))
    parts = [observe.balanced_classes(k, config, n) for k, n in zip(keys, numbers, strict=True)]
    return jax.random.split(scene_key, sum(numbers)), jnp.concatenate(parts)


def _survey(world: World, key: Key, config: Config, scenes: tuple[Key, jax.Array]) -> Surveys:
    """Surveys all scenes at once, as compiling takes longer than running."""
    del key
    scene_keys, classes = scenes
    found = observe.surveys(scene_keys, worlds.with_config(world, config), classes)
    return Surveys(classes, *found)


def _examples(key: Key, config: Config, surveys: Surveys) -> tuple[Examples, ...]:
    """What each detector is trained on: `[L, F]` windows and their `[L]` int32 labels."""
    del key
    num_train = num_scenes(config)[0]
    classes = surveys.classes[:num_train].reshape(-1)
    return tuple(
        (
            windows[:num_train].reshape(-1, windows.shape[-1]),
            jnp.array(config.label_of_class(name))[classes],
        )
        for name, windows in zip(config.modalities, surveys.windows, strict=True)
    )


def _detector_stage(modality: int, name: str, config: Config) -> Steps:
    """The training of one modality's detector."""
    size = _chunk_size(config.detector.steps)

    def split(examples: tuple[Examples, ...]) -> tuple[Examples, Examples]:
        """The looks to train on, and those to calibrate with."""
        windows, labels = examples[modality]
        number = config.detector.num_training(len(labels))
        return (windows[:number], labels[:number]), (windows[number:], labels[number:])

    def begin(
        key: Key, config: Config, examples: tuple[Examples, ...]
    ) -> tuple[Detector, FitState]:
        num_labels = len(config.labels(config.modalities[modality]))
        windows, _ = split(examples)[0]
        detector = detectors.init(key, windows, num_labels, config.detector)
        return detector, detectors.start(detector, config.detector)

    def advance(
        key: Key, config: Config, state: tuple[Detector, FitState], examples: tuple[Examples, ...]
    ) -> tuple[tuple[Detector, FitState], Progress]:
        detector, fit = state
        inputs = *split(examples)[0], config.detector, size
        fit, losses = detectors.train(key, fit, detector, *inputs)
        return (detector, fit), Progress(losses, {})

    def finish(
        config: Config, state: tuple[Detector, FitState], examples: tuple[Examples, ...]
    ) -> Detector:
        detector, fit = state
        trained = dataclasses.replace(detector, params=fit.params)
        windows, labels = split(examples)[1]
        return detectors.calibrate(trained, windows, labels) if len(labels) else trained

    return Steps(
        name,
        begin,
        ("examples",),
        advance=advance,
        finish=finish,
        steps=config.detector.steps,
        chunks=_num_chunks(config.detector.steps),
        program=name,
    )


def _detect(key: Key, config: Config, surveys: Surveys, *trained: Detector) -> Detections:
    """Applies the detectors to the surveys that none was trained on."""
    del key
    num_train, num_bank, _ = num_scenes(config)
    others = jax.tree.map(lambda x: x[num_train:], surveys)
    detect = jax.vmap(jax.vmap(detectors.detect, (None, 0)), (None, 0))
    features = tuple(detect(d, w) for d, w in zip(trained, others.windows, strict=True))

    def by_class(values: jax.Array, part: slice, number: int) -> jax.Array:
        return _by_class(values[part], others.classes[part], config, number)

    for_bank, for_measuring = slice(None, num_bank), slice(num_bank, None)
    held_out = tuple(by_class(f, for_measuring, _held_out_per_class(config)) for f in features)
    labels = [jnp.array(config.label_of_class(name)) for name in config.modalities]
    starts = others.classes, others.scenes, features
    return Detections(
        bank=tuple(by_class(f, for_bank, config.jmvae.samples_per_class) for f in features),
        held_out=held_out,
        starts=jax.tree.map(lambda x: x[: _num_scene_starts(config)], starts),
        metrics={
            name: examine.detector(looks, of_class)
            for name, looks, of_class in zip(config.modalities, held_out, labels, strict=True)
        },
        windows=tuple(by_class(w, for_measuring, 1) for w in others.windows),
    )


def _by_class(values: jax.Array, classes: jax.Array, config: Config, number: int) -> jax.Array:
    """`[C, number, ...]` looks by class, from `[S, N, ...]` with at least `number` of each."""
    flat, classes = values.reshape(-1, *values.shape[2:]), classes.reshape(-1)
    each = range(len(config.arena.classes))
    rows = jnp.stack([jnp.nonzero(classes == c, size=number)[0] for c in each])
    return flat[rows]


def _restart_stage(name: str, config: Config) -> Steps:
    """One training of the JMVAE."""
    return Steps(
        name,
        _begin_jmvae,
        ("detections",),
        advance=_advance_jmvae,
        finish=_finish_jmvae,
        steps=config.jmvae.steps,
        chunks=_num_chunks(config.jmvae.steps),
        program="jmvae",
        is_optional=config.jmvae.restarts > 1,
    )


def _begin_jmvae(key: Key, config: Config, detections: Detections) -> tuple[FitState, jax.Array]:
    """The state of a fit, and the `[]` mean loss of its last chunk."""
    del detections
    fit = jmvae.start(jmvae.init(key, make_jmvae(config)), config.jmvae)
    return fit, jnp.float32(jnp.inf)


def _advance_jmvae(
    key: Key, config: Config, state: tuple[FitState, jax.Array], detections: Detections
) -> tuple[tuple[FitState, jax.Array], Progress]:
    fit, _ = state
    settings = config.jmvae
    size = _chunk_size(settings.steps)
    inputs = make_jmvae(config), detections.bank, settings, size
    after, losses = jmvae.train(key, fit, *inputs)
    counts = fit.step + jnp.arange(size) < settings.steps
    return (after, jnp.mean(losses, where=counts)), Progress(losses, {})


def _finish_jmvae(
    config: Config, state: tuple[FitState, jax.Array], detections: Detections
) -> tuple[Params, jax.Array]:
    """The parameters, and their `[]` mean loss in the last chunk."""
    fit, loss = state
    return fit.params, loss


def _best_jmvae(key: Key, config: Config, *restarts: tuple[Params, jax.Array]) -> Params:
    """The restart with the lowest final loss; one that is not finite only if none is."""
    del key, config
    losses = jnp.stack([loss for _, loss in restarts])
    best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
    return jax.tree.map(lambda *x: jnp.stack(x)[best], *(params for params, _ in restarts))


def _latent_space(
    key: Key, config: Config, params: Params, classes: Belief, detections: Detections
) -> tuple[dict[str, Belief], dict[str, Any]]:
    """See `examine.latent_space`."""
    del key
    return examine.latent_space(params, classes.mean, detections.held_out, config)


def _class_beliefs(key: Key, config: Config, params: Params, detections: Detections) -> Belief:
    """See `examine.class_beliefs`."""
    del key
    return examine.class_beliefs(params, detections.bank, config)


def _unseen(config: Config) -> Belief:
    """`[D]` entry of an unseen PoI."""
    return fusion.unseen(make_jmvae(config), config.mdp.unseen_variance)


def _filter_stages(config: Config) -> list[Stage]:
    """The training of the filter, and its parameters among those of the JMVAE."""
    settings, model = config.filter, make_jmvae(config)
    size = _chunk_size(settings.steps)

    def begin(
        key: Key, config: Config, classes: Belief, detections: Detections
    ) -> tuple[Params, FitState]:
        params = filtering.init(key, model, classes, _unseen(config), config.filter)
        return params, filtering.start(params, config.filter)

    def advance(
        key: Key,
        config: Config,
        state: tuple[Params, FitState],
        classes: Belief,
        detections: Detections,
    ) -> tuple[tuple[Params, FitState], Progress]:
        params, fit = state
        fit, losses = filtering.train(key, fit, params, model, detections.bank, config.filter, size)
        return (params, fit), Progress(losses, {})

    def finish(config: Config, state: tuple[Params, FitState], *inputs: Any) -> Params:
        params, fit = state
        return {**params, "networks": fit.params}

    training = Steps(
        FILTER,
        begin,
        ("class_beliefs", "detections"),
        advance=advance,
        finish=finish,
        steps=settings.steps,
        chunks=_num_chunks(settings.steps),
    )
    return [training, Stage("fusion", _with_filter, ("jmvae", FILTER))]


def _with_filter(key: Key, config: Config, params: Params, trained: Params) -> Params:
    """The parameters that write looks into the map."""
    del key, config
    return {**params, FILTER: trained}


def _measure_beliefs(
    key: Key, config: Config, params: Params, classes: Belief, detections: Detections
) -> dict[str, jax.Array]:
    """See `examine.beliefs`."""
    return examine.beliefs(key, params, classes, detections.held_out, config)


def _look_values(
    key: Key, config: Config, classes: Belief, detections: Detections
) -> tuple[LookValues, ...]:
    """What a look with each modality is worth, from the detections for training."""
    del key
    settings = config.evaluation
    unseen = None  # in nats it is worth as much as any entry with equal probabilities
    if config.mdp.reward == "paper":
        unseen = belief_mdp.information(_unseen(config).std)

    def information(weights: jax.Array) -> jax.Array:
        if config.mdp.reward == "nats":
            return -filtering.entropy(weights)
        return belief_mdp.information(filtering.mixture(classes, weights).std)

    def of_modality(features: jax.Array, labels: tuple[int, ...]) -> LookValues:
        of_look = functools.partial(peers.log_likelihoods, label_of_class=jnp.array(labels))
        likelihoods = jax.vmap(jax.vmap(of_look))(features[:, : settings.value_looks])
        sizes = _MOST_LOOKS, settings.value_points
        return optimum.solve(likelihoods, information, config.mdp, *sizes, unseen)

    labels = [config.label_of_class(name) for name in config.modalities]
    return tuple(map(of_modality, detections.bank, labels))


def _starts(
    world: World,
    key: Key,
    config: Config,
    detections: Detections,
    params: Params,
    *trained: Detector,
) -> MapState:
    """`[num_starts]` first states of episodes."""
    mdp = make_mdp(world, config, detections.bank, params, trained)
    number = config.dqn.num_starts
    if config.dqn.observe == "bank" or isinstance(mdp, TeamMdp):
        return dqn.starts(key, mdp, config.dqn)

    def begin(key: Key, classes: jax.Array, scene: Scene, looks: tuple[jax.Array, ...]):
        seen_key, begin_key = jax.random.split(key)
        seen = belief_mdp.random_start(seen_key, mdp)[1]
        return belief_mdp.begin(begin_key, mdp, scene, classes, seen, looks)

    return jax.vmap(begin)(jax.random.split(key, number), *detections.starts)


def _agent_stages(world: World, config: Config, learned: tuple[str, ...]) -> list[Steps]:
    """The training of each modality's Q-network, or of the one of a team."""
    indices = {agent(config, name): m for m, name in enumerate(config.modalities)}
    return [_agent_stage(name, m, world, config, learned) for name, m in indices.items()]


def _agent_stage(
    name: str, modality: int, world: World, config: Config, learned: tuple[str, ...]
) -> Steps:
    return Steps(
        name,
        functools.partial(_begin_dqn, world),
        ("starts", *learned),
        modality,
        advance=functools.partial(_advance_dqn, world),
        finish=_finish_dqn,
        steps=config.dqn.epochs,
        chunks=config.dqn.epochs // config.dqn.chunk,
        program="dqn",
        is_dense=config.dqn.observe == "bank",
    )


def _begin_dqn(
    world: World,
    key: Key,
    config: Config,
    modality: jax.Array,
    starts: MapState,
    detections: Detections,
    params: Params,
    *trained: Detector,
) -> DqnState:
    del modality
    mdp = make_mdp(world, config, detections.bank, params, trained)
    return dqn.init(key, mdp, config.dqn, starts)


def _advance_dqn(
    world: World,
    key: Key,
    config: Config,
    state: DqnState,
    modality: jax.Array,
    starts: MapState,
    detections: Detections,
    params: Params,
    *trained: Detector,
) -> tuple[DqnState, Progress]:
    mdp = make_mdp(world, config, detections.bank, params, trained)

    def evaluate(key: Key, q_network: Params) -> jax.Array:
        return examine.greedy_return(key, modality, q_network, params, detections.held_out, config)

    state, info = dqn.train_chunk(key, mdp, modality, config.dqn, state, starts, evaluate)
    reward = jnp.where(info.episodes > 0, info.episode_return, jnp.nan)
    loss = jnp.where(info.is_finite, info.loss, jnp.nan)
    metrics = {"reward": reward, "greedy": info.greedy_return, "epsilon": info.epsilon}
    return state, Progress(loss, metrics)


def _finish_dqn(config: Config, state: DqnState, *inputs: Any) -> Params:
    return state.params


def _tour_stage(config: Config, params: str) -> Steps:
    """The training of the network that orders a team's looks, see `tours`."""
    return Steps(
        "tours",
        _begin_tours,
        ("look_values", "class_beliefs", params, "detections"),
        advance=_advance_tours,
        finish=lambda config, state, *_: state[0].params,
        steps=config.team.tours.steps,
        chunks=_num_chunks(config.team.tours.steps),
    )


def _begin_tours(key: Key, config: Config, *_: Any) -> tuple[FitState, Trials]:
    settings, num_pois = config.team.tours, config.team.num_pois[1]
    network = _tour_network(config)
    optimiser = supervised.adam(settings.learning_rate, settings.steps)
    fit = supervised.start(networks.init(key, network, network.features * num_pois), optimiser)
    number = _num_chunks(settings.steps) * _trials_of_chunk(config)
    return fit, tours.no_trials(network.features, num_pois, number)


def _advance_tours(
    key: Key,
    config: Config,
    state: tuple[FitState, Trials],
    look_values: tuple[LookValues, ...],
    classes: Belief,
    params: Params,
    detections: Detections,
) -> tuple[tuple[FitState, Trials], Progress]:
    """Adds trials, and learns from all so far."""
    fit, trials = state
    settings, latent_size = config.team.tours, config.jmvae.latent_size
    size, number = _chunk_size(settings.steps), _trials_of_chunk(config)
    try_key, draw_key = jax.random.split(key)
    mdp = observe.team_mdp(config, detections.bank, params, make_jmvae(config))
    read = readout(filtering.moments_inverse(classes), mdp.map.unseen)
    followed = _auction(config, read, look_values)
    found = tours.try_choices(try_key, mdp, followed, settings, number)
    trials = tours.write(trials, found, fit.step // size * number)
    rows = tours.sample(draw_key, trials, (size, settings.batch))
    network = _tour_network(config)

    def loss(params: Params, rows: jax.Array, step: jax.Array) -> jax.Array:
        del step
        batch = jax.tree.map(lambda x: x[:, rows], trials)
        return tours.loss(network, params, batch, latent_size)

    optimiser = supervised.adam(settings.learning_rate, settings.steps)
    fit, losses = supervised.fit(fit, loss, rows, optimiser, settings.steps)
    return (fit, trials), Progress(losses, {})


def _tour_network(config: Config) -> PoolingNetwork:
    return policies.team_network(config.jmvae.latent_size, len(config.modalities), config.dqn)


def _trials_of_chunk(config: Config) -> int:
    """States in which each chunk tries choices."""
    return -(-config.team.tours.states // _num_chunks(config.team.tours.steps))


def _auction(config: Config, read: Params, look_values: tuple[LookValues, ...]) -> tours.Policy:
    """The policy that robots follow in trials: the auction of gains less the price of the way."""

    def policy(state: TeamState) -> jax.Array:
        known = state.map.belief, jnp.any(state.map.seen, axis=-1)
        gains = expected_gains(read, look_values, *known)[state.team.modality]
        ways = team_mdp.ways(config.team.travel, state.team)
        worth = gains - config.team.second_cost * ways
        return rules.auction(worth, ways, state.team, state.agent)

    return policy


def _policies_stage(modality: int, config: Config, params: str) -> Stage:
    """The comparison of one modality's policies; `params` names the stage that the map needs."""
    name = config.modalities[modality]
    inputs = agent(config, name), params, "look_values", "detections"
    return Stage(f"policies_{name}", _play_policies, inputs, modality, program="policies")


def _other_numbers_stage(modality: int, config: Config, params: str) -> Stage:
    """The same with other numbers of PoIs, for the policy of a team."""
    name = config.modalities[modality]
    inputs = agent(config, name), params, "look_values", "detections"
    return Stage(f"numbers_{name}", _play_numbers, inputs, modality, program="numbers")


def _play_numbers(
    key: Key, config: Config, modality: jax.Array, *inputs: Any
) -> list[tuple[jax.Array, jax.Array]]:
    """For each of `evaluation.num_pois` the results of `examine.compare_policies`."""
    settings = config.evaluation
    fewer = dataclasses.replace(settings, num_states=1, num_repeats=-(-settings.num_repeats // 8))

    def play(number: int) -> tuple[jax.Array, jax.Array]:
        # The places of a scene play no part here, only their number.
        arena = dataclasses.replace(config.arena, num_pois=number, side=100.0)
        there = dataclasses.replace(config, arena=arena, evaluation=fewer)
        return _play_policies(jax.random.fold_in(key, number), there, modality, *inputs)

    return [play(number) for number in settings.num_pois]


def _play_policies(
    key: Key,
    config: Config,
    modality: jax.Array,
    q_network: Params,
    params: Params,
    look_values: tuple[LookValues, ...],
    detections: Detections,
) -> tuple[jax.Array, jax.Array]:
    """See `examine.compare_policies`."""
    trained = q_network, params, look_values
    return examine.compare_policies(key, modality, *trained, detections.held_out, config)

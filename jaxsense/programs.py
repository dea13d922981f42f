"""The compiled functions of a run.

All of them are known before the run begins. They are traced one after the other, in a thread, and
compiled as soon as they are traced, while the stages in `pipeline` run those that are ready.
"""

import dataclasses
import functools
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsense import examine, mission, observe
from jaxsense.compilation import Compiler, Program
from jaxsense.config import Config, JmvaeConfig
from jaxsense.devices import ALONE, Workers
from jaxsense.dqn import belief_mdp
from jaxsense.dqn import training as dqn
from jaxsense.dqn.belief_mdp import MapMdp, MapState
from jaxsense.models import Models, jmvae_shape, untrained
from jaxsense.networks import Params
from jaxsense.observe import Bank
from jaxsense.sim.world import Scene, World
from jaxsense.types import Key
from jaxsense.vae import detectors, jmvae
from jaxsense.vae.detectors import Detector

_MOST_CHUNKS = 20


@struct.dataclass
class Surveys:
    """Looks at every PoI of many scenes by every robot.

    Attributes:
      classes: `[S, N]` int32 true classes.
      scenes: `[S]` scenes.
      windows: for each modality `[S, N, F]` what its detector reads.
    """

    classes: jax.Array
    scenes: Scene
    windows: tuple[jax.Array, ...]


@dataclasses.dataclass(frozen=True)
class Programs:
    """The programs of each stage; for the detectors one for each modality.

    Attributes:
      simulate: `(key, rows [S']) -> Surveys` of those scenes, see `survey_rows`.
      begin_detectors: `(key, windows [S, F]) -> (detector, state)`.
      train_detectors: `(key, state, detector, windows, labels [S]) -> (state, losses)`, a chunk.
      detect: `(detectors, windows of each modality [S, N, F]) -> features of each [S, N, D_m]`.
      begin_jmvae: `(key) -> state`, of one restart.
      train_jmvae: `(key, state, bank) -> (state, losses)`, a chunk of one restart.
      examine_jmvae: `(params, bank) -> (posteriors, figures)`, see `examine.latent_space`.
      start_dqn: `(key, starts, *trained) -> [num_starts] states of the map MDP`; `trained` is the
        detectors, the JMVAE's parameters and the bank.
      begin_dqn: `(key, starts, *trained) -> DqnState`.
      train_dqn: `(key, modality, DqnState, starts, *trained) -> (DqnState, infos)`, a chunk.
      examine_dqn: see `examine.play`, without the config.
      player: of the missions.
    """

    simulate: Program
    begin_detectors: tuple[Program, ...]
    train_detectors: tuple[Program, ...]
    detect: Program
    begin_jmvae: Program
    train_jmvae: Program
    examine_jmvae: Program
    start_dqn: Program
    begin_dqn: Program
    train_dqn: Program
    examine_dqn: Program
    player: Future[mission.Player]

    def fail(self, error: BaseException) -> None:
        """Raises an error from whoever waits for a program, now or later."""
        for field in dataclasses.fields(self):
            waited_for = getattr(self, field.name)
            for each in waited_for if isinstance(waited_for, tuple) else (waited_for,):
                if isinstance(each, Program):
                    each.fail(error)
                elif not each.done():
                    each.set_exception(error)


def compile_programs(
    config: Config,
    world: World,
    compiler: Compiler,
    workers: Workers = ALONE,
    learner_mesh: Mesh | None = None,
) -> Programs:
    """Begins to trace and to compile; see `pipeline.compiled` for the arguments."""
    stages = [f"detector_{name}" for name in config.modalities]
    programs = Programs(
        simulate=Program(compiler, "simulate", "run"),
        begin_detectors=tuple(Program(compiler, stage, "begin") for stage in stages),
        train_detectors=tuple(Program(compiler, stage, "train") for stage in stages),
        detect=Program(compiler, "detect", "run"),
        begin_jmvae=Program(compiler, "jmvae", "begin"),
        train_jmvae=Program(compiler, "jmvae", "train"),
        examine_jmvae=Program(compiler, "evaluate_jmvae", "run"),
        start_dqn=Program(compiler, "dqn", "start"),
        begin_dqn=Program(compiler, "dqn", "begin"),
        train_dqn=Program(compiler, "dqn", "train"),
        examine_dqn=Program(compiler, "evaluate_dqn", "run"),
        player=Future(),
    )

    def trace_missions() -> None:
        batch = mission.batch_of(len(mission.POLICIES) * config.mission.episodes)
        team = mission.make_mission(config)
        programs.player.set_result(mission.Player(team, compiler, batch, workers))

    def trace() -> None:
        try:
            models = jax.eval_shape(lambda: untrained(jax.random.key(0), config))
            surveys = _trace_simulation(programs, config, world, workers)
            # Needed last, but on a CPU they take longest to compile. Beside an accelerator are
            # cores enough to compile, and what all wait for is tracing.
            if _on_cpu():
                trace_missions()
            _trace_detectors(programs, config, models, surveys)
            banks = _trace_jmvae(programs, config, models)
            _trace_dqn(programs, config, world, models, surveys, banks, learner_mesh)
            if not _on_cpu():
                trace_missions()
        except BaseException as error:
            programs.fail(error)

    thread = ThreadPoolExecutor(1)
    thread.submit(trace)
    thread.shutdown(wait=False)
    return programs


def keys_of(key: Key, number: int) -> list[Key]:
    """Different keys, as from `jax.random.split`, which would compile anew for each number."""
    return [jax.random.fold_in(key, i) for i in range(number)]


def chunks_of(steps: int) -> tuple[int, int]:
    """The number of chunks that steps are cut into, at most 20, and the steps of each.

    The last one may have less to do, see `training.fit`.
    """
    size = -(-steps // _MOST_CHUNKS)
    return -(-steps // size), size


def best_restart(losses: Any, settings: JmvaeConfig) -> Any:
    """`[]` the restart with the lowest mean loss at the end, of `[R, steps]` losses.

    One whose losses are not finite is the best only if all are like it.
    """
    last = losses[:, -max(settings.steps // _MOST_CHUNKS, 1) :].mean(axis=1)
    return jnp.argmin(jnp.where(jnp.isfinite(last), last, jnp.inf))


def num_scenes(config: Config) -> tuple[int, int, int]:
    """How many scenes are surveyed to train the detectors, for the bank, and to measure."""
    num_pois, num_classes = config.arena.num_pois, len(config.arena.classes)
    num_bank = -(-config.jmvae.samples_per_class * num_classes // num_pois)
    num_held_out = -(-num_held_out_per_class(config) * num_classes // num_pois)
    num_train = -(-config.detector.num_scans // num_pois)
    return num_train, max(num_bank, num_scene_starts(config)), num_held_out


def num_held_out_per_class(config: Config) -> int:
    """Detections of each class that are kept for measuring."""
    return -(-config.detector.num_held_out // len(config.arena.classes))


def num_scene_starts(config: Config) -> int:
    """Surveyed scenes in which episodes start; with a bank there are no scenes."""
    return config.dqn.num_starts if config.dqn.observe == "live" else 0


def _on_cpu() -> bool:
    """Whether the programs run on a CPU; accelerators train faster than they compile."""
    return jax.default_backend() == "cpu"


def survey_rows(config: Config, number: int = 1) -> np.ndarray:
    """`[S']` int32 all scenes to survey, some of them again so that `number` divides S'."""
    total = sum(num_scenes(config))
    return np.arange(-(-total // number) * number, dtype=np.int32) % total


def survey_scenes(key: Key, rows: jax.Array, config: Config, world: World) -> Surveys:
    """Surveys for all purposes: simulating takes longer to compile than to run.

    Args:
      key: random key of all scenes.
      rows: `[S']` int32 which of them.
      config: all settings.
      world: the simulation.
    """
    class_key, scene_key = jax.random.split(key)
    numbers = num_scenes(config)
    keys = jax.random.split(class_key, len(numbers))
    parts = [observe.balanced_classes(k, config, n) for k, n in zip(keys, numbers, strict=True)]
    classes = jnp.concatenate(parts)[rows]
    scene_keys = jax.random.split(scene_key, sum(numbers))[rows]
    return Surveys(classes, *observe.surveys(scene_keys, world, classes))


def _trace_simulation(
    programs: Programs, config: Config, world: World, workers: Workers
) -> Surveys:
    """The surveys; returns their shapes."""
    key, rows = jax.random.key(0), survey_rows(config, workers.number)
    shapes = programs.simulate.compile(
        lambda key, rows: survey_scenes(key, rows, config, world),
        key,
        jax.ShapeDtypeStruct(rows.shape, rows.dtype),
        workers=workers,
        whole=(0,),
    )
    total = sum(num_scenes(config))
    return jax.tree.map(lambda x: x.update(shape=(total, *x.shape[1:])), shapes)


def _trace_detectors(programs: Programs, config: Config, models: Models, surveys: Surveys) -> None:
    """Training and use of the detectors."""
    key, settings = jax.random.key(0), config.detector
    _, steps = chunks_of(settings.steps)
    num_train = num_scenes(config)[0]
    rows = num_train * config.arena.num_pois
    for m, windows in enumerate(surveys.windows):
        num_labels = models.detectors[m].num_labels

        def begin(key: Key, windows: jax.Array):
            detector = detectors.init(key, windows, num_labels, settings)  # noqa: B023
            return detector, detectors.start(detector, settings)

        def train(key: Key, state, detector, windows, labels):
            return detectors.train(key, state, detector, windows, labels, settings, steps)

        flat = jax.ShapeDtypeStruct((rows, windows.shape[-1]), windows.dtype)
        labels = jax.ShapeDtypeStruct((rows,), jnp.int32)
        detector, state = programs.begin_detectors[m].compile(begin, key, flat)
        inputs = key, state, detector, flat, labels
        programs.train_detectors[m].compile(train, *inputs, runs_long=_on_cpu())

    def detect(trained: tuple[Detector, ...], windows: tuple[jax.Array, ...]):
        each = jax.vmap(jax.vmap(detectors.detect, in_axes=(None, 0)), in_axes=(None, 0))
        return tuple(each(d, w) for d, w in zip(trained, windows, strict=True))

    others = tuple(
        jax.ShapeDtypeStruct((w.shape[0] - num_train, *w.shape[1:]), w.dtype)
        for w in surveys.windows
    )
    programs.detect.compile(detect, models.detectors, others)


def _trace_jmvae(programs: Programs, config: Config, models: Models) -> tuple[Bank, Bank]:
    """The JMVAE; returns the shapes of the banks for training and for measuring."""
    key, settings, model = jax.random.key(0), config.jmvae, jmvae_shape(config)
    num_classes, (_, steps) = len(config.arena.classes), chunks_of(settings.steps)

    def bank(number: int) -> Any:
        shapes = [(num_classes, number, size) for size in model.feature_sizes]
        return tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)

    def begin(key: Key):
        return jmvae.start(jmvae.init(key, model), settings)

    def train(key: Key, state, bank: Bank):
        return jmvae.train(key, state, model, bank, settings, steps)

    banks = bank(settings.samples_per_class), bank(num_held_out_per_class(config))
    state = programs.begin_jmvae.compile(begin, key)
    programs.train_jmvae.compile(train, key, state, banks[0], runs_long=_on_cpu())
    programs.examine_jmvae.compile(
        lambda params, bank: examine.latent_space(params, bank, config), models.jmvae, banks[1]
    )
    return banks


def make_map_mdp(
    config: Config, world: World, trained: tuple[Detector, ...], params: Params, bank: Bank
) -> MapMdp:
    """The map MDP in which the Q-networks learn."""
    model = jmvae_shape(config)
    if config.dqn.observe == "live":
        return observe.live_mdp(config, world, trained, params, model)
    return observe.bank_mdp(config, bank, params, model)


def episode_starts(
    key: Key,
    mdp: MapMdp,
    config: Config,
    starts: tuple[jax.Array, Scene, tuple[jax.Array, ...]],
) -> MapState:
    """`[num_starts]` states in which episodes start; in `starts`, see `Detections`, if live."""
    number = config.dqn.num_starts
    if config.dqn.observe == "bank":
        return dqn.starts(key, mdp, number)

    def begin(key: Key, classes: jax.Array, scene: Scene, looks: tuple[jax.Array, ...]):
        seen_key, begin_key = jax.random.split(key)
        seen = belief_mdp.random_start(seen_key, mdp)[1]
        return belief_mdp.begin(begin_key, mdp, scene, classes, seen, looks)

    return jax.vmap(begin)(jax.random.split(key, number), *starts)


def _trace_dqn(
    programs: Programs,
    config: Config,
    world: World,
    models: Models,
    surveys: Surveys,
    banks: tuple[Bank, Bank],
    mesh: Mesh | None,
) -> None:
    """Q-learning and the policies' examination; one program serves all modalities."""
    key, settings, model = jax.random.key(0), config.dqn, jmvae_shape(config)

    def make_mdp(*trained: Any) -> MapMdp:
        return make_map_mdp(config, world, *trained)

    def start(key: Key, starts, *trained: Any) -> MapState:
        return episode_starts(key, make_mdp(*trained), config, starts)

    def train(key: Key, modality: jax.Array, state: dqn.DqnState, starts, *trained: Any):
        return dqn.train_chunk(key, make_mdp(*trained), modality, settings, state, starts, mesh)

    trained = models.detectors, models.jmvae, banks[0]
    modality = jax.ShapeDtypeStruct((), jnp.int32)
    number, num_pois = num_scene_starts(config), config.arena.num_pois
    looks = [(number, num_pois, size) for size in model.feature_sizes]
    scene_starts = (
        *jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((number, *x.shape[1:]), x.dtype),
            (surveys.classes, surveys.scenes),
        ),
        tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in looks),
    )
    starts = programs.start_dqn.compile(start, key, scene_starts, *trained)
    state = programs.begin_dqn.compile(
        lambda key, starts, *trained: dqn.init(key, make_mdp(*trained), settings, starts),
        *(key, starts, *trained),
    )
    inputs = key, modality, state, starts, *trained
    shardings: Any = {}
    if mesh is not None:
        whole = NamedSharding(mesh, PartitionSpec())
        split = jax.tree.map(lambda spec: NamedSharding(mesh, spec), dqn.state_specs())
        shardings["in_shardings"] = whole, whole, split, *[whole] * (len(inputs) - 3)
        shardings["out_shardings"] = split, whole
    # With live observations most of the time goes into looking.
    runs_long = settings.observe == "bank" and _on_cpu()
    programs.train_dqn.compile(train, *inputs, runs_long=runs_long, **shardings)
    programs.examine_dqn.compile(
        functools.partial(examine.play, config=config),
        *(key, modality, models.q_networks[0], models.jmvae, banks[1]),
    )

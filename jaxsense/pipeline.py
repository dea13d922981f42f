"""The stages of a run, one after the other: each takes a key, inputs and settings.

Stages run on the host and call jitted functions; between two chunks of work they report to a
`Monitor`, so that nothing calls back from inside a compiled loop.
"""

import concurrent.futures
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxsense import observe
from jaxsense.config import MODALITIES, Config
from jaxsense.dqn import evaluation, policies
from jaxsense.dqn import training as dqn
from jaxsense.dqn.belief_mdp import MapMdp, random_start, reset
from jaxsense.mission import BATCH as MISSION_BATCH
from jaxsense.mission import POLICIES, Player, cases, make_mission, summary
from jaxsense.models import Models, jmvae_shape
from jaxsense.monitor import Monitor
from jaxsense.observe import Bank
from jaxsense.sim.world import World, make_world
from jaxsense.training import Params
from jaxsense.types import Belief, Key
from jaxsense.vae import detectors, fusion, jmvae, metrics
from jaxsense.vae.detectors import Detector
from jaxsense.vae.jmvae import Jmvae

_MOST_CHUNKS = 20
_EXPECTATION_DRAWS = 1024


@struct.dataclass
class Banks:
    """Detections for training and for measuring, of looks that the detectors were not trained on.

    Attributes:
      train: for each modality `[C, S, D_m]`.
      held_out: for each modality `[C, S', D_m]`.
    """

    train: Bank
    held_out: Bank


@dataclasses.dataclass(frozen=True)
class RunResult:
    """What a run leaves.

    Attributes:
      models: the trained networks.
      windows: for each modality `[C, 1, F]` one look at each class.
      posteriors: for each set of modalities, `[C, S', D]` beliefs of held-out detections.
      rewards: for each modality `[epochs]` mean total reward of the episodes that ended; NaN where
        none did.
      summary: the blocks `detectors`, `jmvae`, `dqn` and `mission` of `summary.json`.
    """

    models: Models
    windows: dict[str, np.ndarray]
    posteriors: dict[str, Belief]
    rewards: dict[str, np.ndarray]
    summary: dict[str, Any]


def run(
    key: Key,
    config: Config,
    monitor: Monitor,
    keep: Callable[[str, Any], None] = lambda name, tree: None,
) -> RunResult:
    """All stages.

    Args:
      key: the only source of randomness.
      config: all settings.
      monitor: is told of time and progress.
      keep: `(stage, parameters)`, called as soon as a stage has been trained.

    Returns:
      The trained networks and their figures.

    Raises:
      StageError: if a loss is not finite.
    """
    world = make_world(config)
    num_robots = len(config.modalities)
    detector_key, jmvae_key, mission_key, *dqn_keys = jax.random.split(key, 3 + num_robots)
    # Compiling the mission takes long and needs no trained network.
    background = concurrent.futures.ThreadPoolExecutor(1)
    player = background.submit(_compile_missions, config, monitor)
    background.shutdown(wait=False)
    trained, banks, windows, accuracy = train_detectors(detector_key, world, monitor)
    keep("detectors", trained)

    params = train_jmvae(jmvae_key, banks.train, config, monitor)
    keep("jmvae", params)
    posteriors, jmvae_figures = examine_jmvae(params, banks.held_out, config, monitor)
    class_beliefs = jax.tree.map(lambda x: jnp.mean(x, axis=1), posteriors["joint"])
    keep("class_beliefs", class_beliefs)

    q_networks, rewards, dqn_figures = [], {}, {}
    for m, (name, dqn_key) in enumerate(zip(config.modalities, dqn_keys, strict=True)):
        train_key, examine_key = jax.random.split(dqn_key)
        q_network, rewards[name], speed = train_dqn(
            train_key, m, world, trained, params, banks.train, monitor
        )
        keep(f"dqn_{name}", q_network)
        figures = examine_dqn(examine_key, m, q_network, params, banks.held_out, config, monitor)
        q_networks.append(q_network)
        dqn_figures[name] = {**figures, **speed}

    models = Models(trained, params, class_beliefs, tuple(q_networks))
    policies = {name: case for name, case in cases(config).items() if name in POLICIES}
    missions = summary(mission_key, player.result(), models, policies, config.mission.episodes)
    return RunResult(
        models=models,
        windows=windows,
        posteriors=posteriors,
        rewards=rewards,
        summary={
            "detectors": {m: {"accuracy": a} for m, a in accuracy.items()},
            "jmvae": jmvae_figures,
            "dqn": dqn_figures,
            "mission": missions,
        },
    )


def _compile_missions(config: Config, monitor: Monitor) -> Player:
    batch = min(len(POLICIES) * config.mission.episodes, MISSION_BATCH)
    return Player(make_mission(config), monitor, batch)


def train_detectors(
    key: Key, world: World, monitor: Monitor
) -> tuple[tuple[Detector, ...], Banks, dict[str, np.ndarray], dict[str, float]]:
    """Simulates looks, trains the detectors on some and applies them to the others.

    Returns:
      The detectors, the banks of detections, one look at each class for each modality, and the
      accuracy on the held-out looks for each modality.
    """
    results = [
        _train_detector(modality_key, m, world, monitor)
        for m, modality_key in enumerate(jax.random.split(key, len(world.sensors)))
    ]
    trained, train_banks, held_out_banks, windows, accuracy = zip(*results, strict=True)
    names = world.config.modalities
    banks = Banks(train_banks, held_out_banks)
    by_name = dict(zip(names, windows, strict=True))
    return trained, banks, by_name, dict(zip(names, accuracy, strict=True))


def _train_detector(key: Key, modality: int, world: World, monitor: Monitor):
    config = world.config
    name, settings = config.modalities[modality], config.detector
    attribute = MODALITIES[name]
    num_classes = len(config.arena.classes)
    num_labels = len(config.arena.labels(attribute))
    look_key, init_key, *chunk_keys = jax.random.split(key, 2 + num_chunks(settings.steps))

    # One simulation for all purposes: it takes far longer to compile than to run.
    num_train = -(-settings.num_scans // num_classes)
    num_bank = config.jmvae.samples_per_class
    num_held_out = -(-settings.num_held_out // num_classes)
    per_class = num_train + num_bank + num_held_out
    windows = monitor.run(
        f"simulate_{name}", lambda k: observe.first_looks(k, world, modality, per_class), look_key
    )
    for_training, for_bank, held_out = jnp.split(windows, [num_train, num_train + num_bank], axis=1)
    labels = jnp.array(config.arena.label_of_class(attribute))
    flat = for_training.reshape(-1, for_training.shape[-1])
    flat_labels = jnp.repeat(labels, num_train)

    stage = f"detector_{name}"
    detector = detectors.init(init_key, flat, num_labels, settings)
    state = detectors.start(detector, settings)
    steps = settings.steps // len(chunk_keys)

    def chunk(key: Key, state, detector, windows, labels):
        return detectors.train(key, state, detector, windows, labels, settings, steps)

    inputs = detector, flat, flat_labels
    train = monitor.compile(stage, chunk, chunk_keys[0], state, *inputs)
    for i, chunk_key in enumerate(chunk_keys):
        state, losses = train(chunk_key, state, *inputs)
        monitor.report(stage, (i + 1) * steps, settings.steps, np.asarray(losses))
    detector = dataclasses.replace(detector, params=state.params)

    monitor.check_finite(stage, detector.params)

    detect = jax.vmap(jax.vmap(detectors.detect, in_axes=(None, 0)), in_axes=(None, 0))
    looks = jnp.concatenate([for_bank, held_out], axis=1)
    features = monitor.run(f"detect_{name}", detect, detector, looks)
    bank, held_out_bank = jnp.split(features, [num_bank], axis=1)
    is_right = jnp.argmax(held_out_bank, axis=-1) == labels[:, None]
    return detector, bank, held_out_bank, np.asarray(windows[:, :1]), float(is_right.mean())


def train_jmvae(key: Key, bank: Bank, config: Config, monitor: Monitor) -> Params:
    """Trains JMVAEs on a bank of detections and keeps the one with the lowest loss at the end."""
    settings, model = config.jmvae, jmvae_shape(config)
    init_key, *chunk_keys = jax.random.split(key, 1 + num_chunks(settings.steps))
    init_keys = jax.random.split(init_key, settings.restarts)
    states = jax.vmap(lambda k: jmvae.start(jmvae.init(k, model), settings))(init_keys)
    steps = settings.steps // len(chunk_keys)

    def chunk(key: Key, states, bank: Bank):
        def train(key: Key, state):
            return jmvae.train(key, state, model, bank, settings, steps)

        states, losses = jax.vmap(train)(jax.random.split(key, settings.restarts), states)
        return states, losses

    train = monitor.compile("jmvae", chunk, chunk_keys[0], states, bank)
    losses = jnp.zeros((settings.restarts, steps))
    for i, chunk_key in enumerate(chunk_keys):
        states, losses = train(chunk_key, states, bank)
        # The worst loss, so that a restart that fails does not go unnoticed.
        worst = np.asarray(losses.max(axis=0))
        monitor.report("jmvae", (i + 1) * steps, settings.steps, worst)
    best = jnp.argmin(losses.mean(axis=1))
    params = jax.tree.map(lambda x: x[best], states.params)
    monitor.check_finite("jmvae", params)
    return params


def examine_jmvae(
    params: Params, bank: Bank, config: Config, monitor: Monitor
) -> tuple[dict[str, Belief], dict[str, Any]]:
    """Encodes detections, alone and together, and measures the latent space.

    Args:
      params: of the JMVAE.
      bank: for each modality `[C, S, D_m]` held-out detections; the s-th of a class in one modality
        goes with the s-th in another.
      config: all settings.
      monitor: is told of time.

    Returns:
      `[C, S, D]` beliefs for `joint` and for each modality, and the block `jmvae` of the summary.
    """
    model = jmvae_shape(config)
    labels = [config.arena.label_of_class(MODALITIES[m]) for m in config.modalities]
    posteriors, figures = monitor.run(
        "evaluate_jmvae",
        lambda params, bank: _latent_figures(params, model, bank, labels),
        params,
        bank,
    )
    lists = jax.tree.map(lambda x: x.tolist(), figures)
    lists["unambiguous"] = {
        name: [share > 0.9 for share in shares] for name, shares in lists["unambiguous"].items()
    }
    return posteriors, lists


def _latent_figures(params: Params, model: Jmvae, bank: Bank, labels):
    num_modalities, num_classes = len(bank), bank[0].shape[0]

    def encode_all(*keep: bool) -> Belief:
        def encode(*features: jax.Array) -> Belief:
            kept = tuple(f if k else None for f, k in zip(features, keep, strict=True))
            return jmvae.posterior(params, model, kept)

        return jax.vmap(jax.vmap(encode))(*bank)

    joint = encode_all(*[True] * num_modalities)
    alone = [encode_all(*(i == m for i in range(num_modalities))) for m in range(num_modalities)]
    posteriors = {"joint": joint, **dict(zip(model.modalities, alone, strict=True))}
    class_means = joint.mean.mean(axis=1)
    classes = jnp.arange(num_classes)

    is_unambiguous = jax.vmap(
        jax.vmap(metrics.unambiguous, in_axes=(0, None, None)), in_axes=(0, None, 0)
    )
    errors = []
    for belief, label_of_class in zip(alone, labels, strict=True):
        for c, consistent in enumerate(metrics.consistent_classes(label_of_class)):
            members = jnp.array(np.flatnonzero(consistent))
            parts = jax.tree.map(lambda x: x[members].reshape(-1, x.shape[-1]), joint)  # noqa: B023
            of_class = jax.tree.map(lambda x: x[c], belief)  # noqa: B023
            error = jax.vmap(metrics.moment_matching_error, in_axes=(0, None))(of_class, parts)
            errors.append(error.mean())

    is_right, distances = [], []
    for first in range(num_modalities):
        seen = jnp.arange(num_modalities) == first
        for second in set(range(num_modalities)) - {first}:
            write = lambda old, new: fusion.write(params, model, old, seen, new, second)  # noqa: B023, E731
            fused = jax.vmap(jax.vmap(write))(alone[first], bank[second])
            both = encode_all(*(m in (first, second) for m in range(num_modalities)))
            nearest = jax.vmap(jax.vmap(lambda b: metrics.nearest_class(b, class_means)))(fused)
            is_right.append(nearest == classes[:, None])
            offset = (fused.mean - both.mean) / both.std
            distances.append(jnp.linalg.norm(offset, axis=-1))

    figures = {
        "active_units": metrics.active_units(joint.mean.reshape(-1, joint.mean.shape[-1])),
        "sigma_norm": {n: metrics.sigma_norm(b.std).mean(axis=1) for n, b in posteriors.items()},
        "unambiguous": {
            n: is_unambiguous(b, class_means, classes).mean(axis=1) for n, b in posteriors.items()
        },
        "moment_matching_error": jnp.mean(jnp.array(errors)),
        # With one modality there is nothing to fuse.
        "fusion": {
            "accuracy": jnp.mean(jnp.array(is_right)) if is_right else None,
            "mean_error": jnp.mean(jnp.array(distances)) if distances else None,
        },
    }
    return posteriors, figures


def train_dqn(
    key: Key,
    modality: int,
    world: World,
    trained: tuple[Detector, ...],
    params: Params,
    bank: Bank,
    monitor: Monitor,
) -> tuple[Params, np.ndarray, dict[str, float]]:
    """Trains the Q-network of one modality.

    Returns:
      Its parameters, the `[epochs]` mean total reward of the episodes that ended, NaN where none
      did, and the figures `env_steps` and `env_steps_per_s`.
    """
    config = world.config
    settings, model = config.dqn, jmvae_shape(config)
    stage = f"dqn_{config.modalities[modality]}"

    def make_mdp(trained: tuple[Detector, ...], params: Params, bank: Bank) -> MapMdp:
        if settings.observe == "live":
            return observe.live_mdp(config, world, trained, params, model)
        return observe.bank_mdp(config, bank, params, model)

    def chunk(key: Key, state: dqn.DqnState, *models: Any):
        return dqn.train_chunk(key, make_mdp(*models), modality, settings, state)

    init_key, *chunk_keys = jax.random.split(key, 1 + settings.epochs // settings.chunk)
    models = trained, params, bank
    state = dqn.init(init_key, make_mdp(*models), settings)
    train = monitor.compile(stage, chunk, chunk_keys[0], state, *models)
    rewards = []
    before = monitor.seconds[stage]["run_s"]
    for i, chunk_key in enumerate(chunk_keys):
        state, info = train(chunk_key, state, *models)
        episodes, ended = np.asarray(info.episodes), np.asarray(info.episode_return)
        rewards.append(np.where(episodes > 0, ended, np.nan))
        monitor.report(
            stage,
            (i + 1) * settings.chunk,
            settings.epochs,
            np.asarray(info.loss),
            reward=float(np.average(ended, weights=np.maximum(episodes, 1e-9))),
            epsilon=float(info.epsilon[-1]),
        )
    monitor.check_finite(stage, state.params)
    env_steps = settings.epochs * settings.num_envs
    seconds = monitor.seconds[stage]["run_s"] - before
    speed = {"env_steps": env_steps, "env_steps_per_s": env_steps / seconds}
    return state.params, np.concatenate(rewards), speed


def examine_dqn(
    key: Key,
    modality: int,
    q_network: Params,
    params: Params,
    bank: Bank,
    config: Config,
    monitor: Monitor,
) -> dict[str, Any]:
    """Plays whole episodes with a trained policy and those to compare it with.

    All policies see the same held-out detections from the same starts.

    Returns:
      The block of one modality in the summary's `dqn`, without the speed.
    """
    settings, model = config.evaluation, jmvae_shape(config)
    start_key, play_key = jax.random.split(key)
    mdp = observe.bank_mdp(config, bank, params, model)
    start_keys = jax.random.split(start_key, settings.num_starts)
    random_starts = jax.vmap(lambda k: random_start(k, mdp))(start_keys)
    every_state = evaluation.every_state(mdp)
    classes, seen = (
        jnp.concatenate([jnp.asarray(x), y])
        for x, y in zip(every_state, random_starts, strict=True)
    )

    labels = jnp.array([config.arena.label_of_class(MODALITIES[m]) for m in config.modalities])

    def play_all(key: Key, q_network: Params, params: Params, bank: Bank, classes, seen):
        mdp = observe.bank_mdp(config, bank, params, model)
        table_key, key = jax.random.split(key)
        expected = policies.expected_rewards(table_key, mdp, modality, _EXPECTATION_DRAWS)
        compared = {
            "return": policies.greedy(mdp, q_network, config.dqn.hidden),
            "optimal": policies.optimal(mdp, expected, labels),
            "naive": policies.naive(mdp, modality),
            "random": policies.uniform(mdp),
        }

        def play(key: Key, classes: jax.Array, seen: jax.Array):
            reset_key, play_key = jax.random.split(key)
            start = reset(reset_key, mdp, classes, seen)
            return {
                name: evaluation.play(play_key, mdp, policy, start, modality)
                for name, policy in compared.items()
            }

        def repeat(key: Key):
            return jax.vmap(play)(jax.random.split(key, len(classes)), classes, seen)

        rewards = jax.lax.map(repeat, jax.random.split(key, settings.num_repeats))
        return jax.tree.map(lambda x: x.mean(axis=0), rewards)

    stage = f"evaluate_{config.modalities[modality]}"
    rewards = monitor.run(stage, play_all, play_key, q_network, params, bank, classes, seen)
    num_states = len(every_state[0])
    whole = {name: float(total[num_states:].mean()) for name, (total, _) in rewards.items()}
    one_step = {name: float(first[num_states:].mean()) for name, (_, first) in rewards.items()}
    missed = rewards["optimal"][0][:num_states] - rewards["return"][0][:num_states]
    return {
        **whole,
        # Where no look pays, no policy has anything to reach.
        "fraction_of_optimal": whole["return"] / whole["optimal"] if whole["optimal"] else None,
        "one_step": {
            "policy": one_step["return"],
            "optimal": one_step["optimal"],
            "random": one_step["random"],
        },
        "optimal_states": int(np.sum(np.asarray(missed) <= 0.01)),
        "num_states": num_states,
    }


def num_chunks(steps: int) -> int:
    """The most chunks, up to 20, into which steps can be cut evenly."""
    return max(n for n in range(1, _MOST_CHUNKS + 1) if steps % n == 0)

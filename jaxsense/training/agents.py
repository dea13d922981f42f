"""Stages of agents: values of looks, and Q-learning."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxsense.config import Config
from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief, Fusion, Key
from jaxsense.dqn import episodes, optimum, rewards
from jaxsense.dqn import training as dqn
from jaxsense.dqn.agent import Environment, Underway
from jaxsense.dqn.episodes import Start
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.training import DqnState
from jaxsense.looks import Bank, Live, make_mdp, mdp_of_one
from jaxsense.models import make_agent, make_bayes, make_models, make_prior
from jaxsense.sim.world import make_world
from jaxsense.training import comparison
from jaxsense.training.detections import Detections
from jaxsense.training.stage import Drive, Output, Progress, Stage
from jaxsense.vae import readout
from jaxsense.vae.detectors import Detector

_MAX_LOOKS = 20  # at one PoI, in the values of looks


def look_values(
    key: Key, config: Config, *, classes: Belief, detections: Detections
) -> tuple[LookValues, ...]:
    """Values of looks with each modality, from features for training."""
    del key
    settings, bayes = config.evaluation, make_bayes(config)
    reward, prior = rewards.make(config.mdp), make_prior(config)
    solve = functools.partial(
        optimum.value_iteration,
        reward=reward,
        prior=prior,
        config=config.mdp,
        horizon=_MAX_LOOKS,
        max_points=settings.value_points,
    )

    def of_classes(m: int) -> LookValues:
        features = detections.bank[m][:, : settings.value_looks]
        likelihoods = jax.vmap(jax.vmap(lambda x: bayes.log_likelihoods(x, m)))(features)
        return solve(likelihoods, mixture=lambda p: readout.mixture(classes, p))

    def of_labels(m: int) -> LookValues:
        bank, labels = detections.bank[m], np.array(config.label_of_class(config.modalities[m]))
        number = len(config.labels(config.modalities[m]))
        of_each = np.eye(number, dtype=np.float32)[labels]
        size = min(settings.value_looks, bank.shape[1])

        def looks(label: int) -> jax.Array:
            """Likelihoods of the labels in as many looks at each class with this one."""
            at_classes = jnp.swapaxes(bank[np.flatnonzero(labels == label)], 0, 1)
            firsts = [np.flatnonzero(labels == each)[0] for each in range(number)]
            of_look = lambda x: bayes.log_likelihoods(x, m)[np.array(firsts)]  # noqa: E731
            return jax.vmap(of_look)(at_classes.reshape(-1, number)[:size])

        likelihoods = jnp.stack([looks(label) for label in range(number)])
        # The reward does not depend on the belief.
        found = solve(likelihoods, mixture=lambda p: prior, start=jnp.asarray(of_each.mean(axis=0)))
        return dataclasses.replace(found, labels=jnp.asarray(of_each))

    of_modality = of_labels if reward.is_of_labels else of_classes
    return tuple(map(of_modality, range(len(config.modalities))))


def train(
    drive: Drive,
    config: Config,
    *,
    detections: Output,
    fusion: Output,
    detectors: tuple[Output, ...],
    novelty: Output,
) -> tuple[dict[str, Output], Output]:
    """Trains the Q-networks, returned by the names of their stages, and the starts of episodes."""
    given = {"fusion": fusion, "detectors": detectors, "novelty": novelty}
    starts = drive(Stage("starts", _starts), detections=detections, **given)
    networks: dict[str, Output] = {}
    # A team's one network is evaluated with the first sensor.
    for m, network in enumerate(learners(config)):
        stage = Stage(
            network,
            _begin,
            _advance,
            lambda config, state, **_: state.params,
            steps=config.dqn.epochs,
            chunks=config.dqn.epochs // config.dqn.chunk,
            shares="dqn",
        )
        of_sensor = {"modality": jnp.int32(m), "starts": starts, "detections": detections}
        networks[network] = drive(stage, **of_sensor, **given)
    return networks, starts


def _environment(
    config: Config,
    modality: Int[Array, ""],
    detections: Detections,
    *,
    fusion: Fusion,
    detectors: tuple[Detector, ...],
    novelty: Novelty,
) -> Environment:
    """What an agent learns in."""
    is_live, bank = config.dqn.observe == "live", detections.by_distance or Bank(detections.bank)
    looks = Live(make_world(config), detectors) if is_live else bank
    models = make_models(config, fusion=fusion, novelty=novelty)
    mdp = make_mdp(config, models, looks)
    return Environment(make_agent(config), mdp.of(modality) if mdp.teams is None else mdp)


def _starts(
    key: Key, config: Config, *, detections: Detections, **given: Any
) -> tuple[Underway, Start]:
    """First states of episodes, `[num_starts]` to learn from, and those of all evaluations."""
    learn_key, held_out_key = jax.random.split(key)
    learning = _environment(config, jnp.int32(0), detections, **given)
    held_out = mdp_of_one(config, given["fusion"], Bank(detections.held_out), jnp.int32(0))
    prepared = dqn.starts(learn_key, learning, config.dqn)
    reset = jax.vmap(lambda key: episodes.reset(key, held_out, make_bayes(config)))
    return prepared, reset(jax.random.split(held_out_key, config.evaluation.num_starts))


def _begin(
    key: Key,
    config: Config,
    *,
    modality: Int[Array, ""],
    starts: tuple[Underway, Start],
    detections: Detections,
    **given: Any,
) -> DqnState:
    learning = _environment(config, modality, detections, **given)
    return dqn.init(key, learning, config.dqn, starts[0])


def _advance(
    key: Key,
    config: Config,
    state: DqnState,
    *,
    modality: Int[Array, ""],
    starts: tuple[Underway, Start],
    detections: Detections,
    **given: Any,
) -> tuple[DqnState, Progress]:
    mdp = mdp_of_one(config, given["fusion"], Bank(detections.held_out), modality)
    evaluate = comparison.evaluation(mdp, config, starts[1])
    learning = _environment(config, modality, detections, **given)
    state, info = dqn.train_chunk(key, learning, config.dqn, state, starts[0], evaluate)
    reward = jnp.where(info.episodes > 0, info.episode_return, jnp.nan)
    loss = jnp.where(info.is_finite, info.loss, jnp.nan)
    metrics = {"reward": reward, "evaluation": info.evaluation_return, "epsilon": info.epsilon}
    return state, Progress(loss, metrics)


def learner(config: Config, modality: str) -> str:
    """Name of the stage that trains the Q-network of a modality's robots."""
    return "dqn_team" if config.dqn.task == "team" else f"dqn_{modality}"


def learners(config: Config) -> tuple[str, ...]:
    """Names of all stages that train Q-networks, in the order of `Models.q_networks`."""
    return tuple(dict.fromkeys(learner(config, modality) for modality in config.modalities))

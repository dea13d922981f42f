"""Stages of agents: the values of looks, and Q-learning."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import detections
from tiny import KEY, TINY, inputs_of, stage_of
from untrained import untrained

from jaxsense.config import MdpConfig
from jaxsense.core.types import Belief
from jaxsense.dqn import training as dqn
from jaxsense.training import comparison

BANK = dataclasses.replace(TINY, dqn=dataclasses.replace(TINY.dqn, observe="bank"))


def test_values_of_looks_are_of_detections_for_training_and_of_the_mdps_reward():
    mdp = MdpConfig(reward="nats", look_cost=0.125, min_increase=0.01)
    fusion = dataclasses.replace(TINY.jmvae, fusion="filter", latent_size=1)
    config = dataclasses.replace(TINY, jmvae=fusion, mdp=mdp)
    # The camera is sure, red or green; the LiDAR knows nothing: two cylinders to one cube.
    camera, lidar = jnp.array([[0, 1], [1, 0], [1, 0]]), jnp.full((3, 2), 1 / 3).at[:, 0].set(2 / 3)
    bank = tuple(jnp.repeat(x[:, None].astype(jnp.float32), 4, axis=1) for x in (camera, lidar))
    # Classes in one dimension of deviation 1, at 0, 3 and 3 + sqrt(12).
    mean = jnp.array([[0.0], [3.0], [3.0 + 12**0.5]])
    classes = Belief(mean, jnp.ones((3, 1)))
    stage = stage_of("look_values", config)
    camera, lidar = jax.jit(stage.begin)(KEY, config, classes=classes, detections=detections(bank))
    even = jnp.full(3, 1 / 3)
    # ln 3 before; nothing after a green one, and ln 2 after each of two red ones.
    expected = [np.log(3) - np.log(2) * 2 / 3 - 0.125, -0.125]
    found = [values.of_next(even, True) for values in (camera, lidar)]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    np.testing.assert_allclose([camera.one_step_unseen, lidar.one_step_unseen], expected, atol=1e-4)
    # A second look of the camera adds nothing, and so costs more than it pays.
    np.testing.assert_allclose(camera.of_all(even, True), expected[0], atol=1e-4)
    np.testing.assert_allclose(camera.q_unseen, expected[0], atol=1e-4)


@pytest.mark.parametrize("name", ["dqn_camera", "dqn_lidar"])
def test_an_agent_learns_on_the_bank_and_its_evaluation_is_on_held_out_looks(monkeypatch, name):
    models = untrained(BANK)
    bank, held_out = (tuple(jnp.full((3, 4, 2), x) for _ in range(2)) for x in (0.5, 0.25))
    used = {}

    def train_chunk(key, learning, config, state, starts, evaluate):
        used["learning"], used["modality"] = learning.mdp.looks.features, learning.mdp.robots[0]
        used["starts"] = starts
        evaluate(key, "network")
        return state, SimpleNamespace(
            episodes=jnp.array([2, 0]), episode_return=jnp.array([1.5, 9.0]),
            is_finite=jnp.array([True, False]), loss=jnp.array([0.5, 0.25]),
            evaluation_return=jnp.array([jnp.nan, 3.0]), epsilon=jnp.ones(2),
        )  # fmt: skip

    def evaluation(mdp, config, starts):
        def evaluate(key, q_network):
            used["evaluation"], used["of"] = mdp.looks.features, (int(mdp.robots[0]), q_network)
            used["evaluated"] = starts

        return evaluate

    monkeypatch.setattr(dqn, "train_chunk", train_chunk)
    monkeypatch.setattr(comparison, "evaluation", evaluation)
    stage = stage_of(name, BANK)
    found = {
        "starts": ("to learn from", "to evaluate"),
        "novelty": models.novelty,
        "fusion": models.fusion,
        "detections": detections(bank, held_out),
        **dict(zip(("detector_camera", "detector_lidar"), models.detectors, strict=True)),
    }
    inputs = inputs_of(name, BANK, found)
    _, progress = stage.advance(KEY, BANK, "state", **inputs)
    number = int(name == "dqn_lidar")
    assert used["of"] == (number, "network")
    assert used["modality"] == number
    assert (used["starts"], used["evaluated"]) == ("to learn from", "to evaluate")
    for each, expected in (("learning", bank), ("evaluation", held_out)):
        np.testing.assert_array_equal(used[each], expected)
    # No episode ended in the second epoch, and its loss is not finite.
    np.testing.assert_array_equal(progress.loss, [0.5, np.nan])
    np.testing.assert_array_equal(progress.metrics["reward"], [1.5, np.nan])
    np.testing.assert_array_equal(progress.metrics["evaluation"], [np.nan, 3.0])

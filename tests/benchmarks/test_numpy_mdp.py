"""The peer's MDP in NumPy is ours, number for number, when both see the same detections."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.dqn import untrained_task
from benchmarks.peers.numpy_mdp import NumpyMdp
from jaxsense.config import DqnConfig
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts

pytestmark = pytest.mark.slow
TOLERANCE = 1e-5  # latent units, over a few float32 layers


@pytest.fixture(scope="module")
def task():
    # One detection of each class, so that there is nothing to draw.
    return untrained_task(DqnConfig(task="map", observe="bank"), samples=1)


@pytest.mark.parametrize("modality", [0, 1])
def test_every_step_equals_ours(task, modality):
    mdp = task.mdp
    step = jax.jit(lambda key, state, a: mdps.step(key, mdp.of(modality), state, a))
    reset = jax.jit(lambda key, classes, seen: starts.reset(key, mdp, classes, seen))
    observed = jax.jit(lambda belief: mdp.features(belief, None, None, 0).reshape(-1))  # pyright: ignore
    theirs = NumpyMdp(task.config, task.models.jmvae, task.bank, modality)
    rng = np.random.default_rng(0)
    for episode in range(10):
        classes = rng.integers(3, size=3)
        seen = np.zeros((3, 2), bool)
        state = reset(jax.random.key(episode), classes, seen)
        their_state = theirs.reset(rng, classes, seen.copy())
        for action in [*rng.integers(3, size=7), 3]:
            seen_by_them = theirs.observation(their_state)
            np.testing.assert_allclose(seen_by_them, observed(state.belief), atol=TOLERANCE)
            state, outcome = step(jax.random.key(1), state, jnp.int32(action))
            reward, terminated, truncated = theirs.step(rng, their_state, int(action))
            np.testing.assert_allclose(reward, outcome.reward, atol=TOLERANCE)
            assert (terminated, truncated) == (bool(outcome.terminated), bool(outcome.truncated))
            np.testing.assert_array_equal(their_state.seen, state.seen)

"""Restarts of the JMVAE, the best of them, and beliefs of classes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import KEY, TINY, stage_of

from jaxsense import models
from jaxsense.core.types import Belief
from jaxsense.training import jmvaes
from jaxsense.training.detections import Detections
from jaxsense.vae import jmvae


def bank_of(bank) -> Detections:
    """Detections for training, without any to measure on."""
    nothing: Any = ()
    return Detections(bank, nothing, nothing, nothing)


@pytest.mark.slow
def test_the_loss_of_a_restart_is_the_mean_of_its_last_chunk(monkeypatch):
    # 41 steps are 14 chunks of 3, the last of which has 2. The loss of a step is its number.
    monkeypatch.setattr(jmvae.Fitting, "loss", lambda self, params, drawn, step: step + 1.0)
    stage, detections = stage_of("jmvae_1"), bank_of((jnp.ones((3, 4, 2)),) * 2)

    @jax.jit
    def advance(state):
        state, progress = stage.advance(KEY, TINY, state, detections=detections)
        return state, progress, stage.finish(TINY, state, detections=detections)[1]

    state, seen = jax.jit(lambda: stage.begin(KEY, TINY, detections=detections))(), []
    for _ in range(stage.chunks):
        state, progress, loss = advance(state)
        seen.append(float(loss))
        assert len(progress.loss) == 3
    assert seen[0] == 2.0  # of 1, 2, 3
    assert seen[-1] == 40.5  # of 40 and 41


# The camera tells class 0 from the others, the LiDAR class 2. Classes in the same place cannot be
# read from a belief.
CORNER = Belief(jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]), jnp.full((3, 2), 0.3))
PLACE = Belief(jnp.ones((3, 2)), jnp.full((3, 2), 0.3))


@jax.jit
def kept(losses, classes):
    """The restart that is kept, by losses and beliefs of the classes."""
    restarts = tuple((jnp.int32(i), losses[i]) for i in range(len(losses)))
    of_restart = lambda *_, params, detections: jax.tree.map(lambda x: x[params], classes)  # noqa: E731
    camera = np.float32([[0.1, 0.9], [0.9, 0.1], [0.9, 0.1]])[:, None]
    given = {
        "restarts": restarts,
        "detections": bank_of((jnp.asarray(camera), jnp.asarray(camera[::-1]))),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jmvaes, "class_beliefs", of_restart)
        return stage_of("best_jmvae").begin(KEY, TINY, **given)


def best_of(losses, classes):
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *classes)
    return int(kept(np.float32(losses), stacked))


@pytest.mark.slow
def test_the_exact_restart_with_the_lowest_loss_is_kept():
    nan, inf = jnp.nan, jnp.inf
    for losses, expected in {(1, 0.5, 0.9): 1, (1, nan, 0.9): 2, (nan, inf): 0, (nan,): 0}.items():
        assert best_of(losses, [CORNER] * len(losses)) == expected
    # From equal places no class can be read, whatever the loss.
    assert best_of((1, 0.5, 0.9), [CORNER, PLACE, CORNER]) == 2
    assert best_of((nan, 0.5, 0.9), [CORNER, PLACE, PLACE]) == 1


def test_of_inexact_restarts_the_most_exact_is_kept():
    line = Belief(jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    assert best_of((0.5, 0.9, 0.5), [PLACE, line, PLACE]) == 1


def test_beliefs_of_classes_are_of_detections_for_training():
    # Nothing else can be encoded.
    params = jax.jit(lambda: jmvae.init(KEY, models.make_jmvae(TINY)))()
    bank = tuple(jnp.full((3, 4, 2), 0.5) for _ in range(2))
    stage = stage_of("class_beliefs")
    found = jax.jit(stage.begin)(KEY, TINY, params=params, detections=bank_of(bank))
    posterior = jax.jit(jmvae.posterior, static_argnums=1)
    expected = posterior(params, models.make_jmvae(TINY), tuple(x[0, 0] for x in bank))
    np.testing.assert_allclose(found.mean, jnp.tile(expected.mean, (3, 1)), rtol=1e-5)

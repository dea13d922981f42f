"""Restarts of the JMVAE, the best of them, and beliefs of classes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import detections
from tiny import KEY, TINY, stage_of

from jaxsense.core.types import Belief
from jaxsense.training import jmvaes

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
        "detections": detections((jnp.asarray(camera), jnp.asarray(camera[::-1]))),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jmvaes, "class_beliefs", of_restart)
        return stage_of("best_jmvae").begin(KEY, TINY, **given)


def best_of(losses, classes):
    stacked = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *classes)
    return int(kept(np.float32(losses), stacked))


def test_the_exact_restart_with_the_lowest_loss_is_kept_or_the_most_exact():
    nan = jnp.nan
    assert best_of((1, nan, 0.9), [CORNER] * 3) == 2
    # From equal places no class can be read, whatever the loss.
    assert best_of((1, 0.5, 0.9), [CORNER, PLACE, CORNER]) == 2
    assert best_of((nan, 0.5, 0.9), [CORNER, PLACE, PLACE]) == 1
    line = Belief(jnp.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0]]), jnp.full((3, 2), 0.3))
    assert best_of((0.5, 0.9, 0.5), [PLACE, line, PLACE]) == 1

"""A mission that was never played: what an animation needs of it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import PRESETS
from jaxsense.core.types import Belief, pytree
from jaxsense.mission.state import DRIVING, ENDED, FACING, Record
from jaxsense.run.missions import Recording

CONFIG = PRESETS["smoke"]
CLASS_BELIEFS = Belief(
    np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]], np.float32), np.full((3, 2), 0.4, np.float32)
)


@pytree
class StubFusion:
    """What an animation needs of the fusion: the nearer a class in sigma, the more likely."""

    classes: Belief
    prior: Belief

    def class_probabilities(self, belief):
        apart = (belief.mean[None] - self.classes.mean) / belief.std[None]
        return jax.nn.softmax(-jnp.sum(apart**2, axis=-1))


FUSION = StubFusion(
    CLASS_BELIEFS, Belief(np.zeros(2, np.float32), np.full(2, np.sqrt(20.0), np.float32))
)


def recording(steps: int = 60) -> Recording:
    """The camera robot drives to PoI 2, looks at it in period 40, and ends; the other one rests."""
    rows = steps + 5
    i = np.arange(rows)
    poses = np.zeros((rows, 2, 3), np.float32)
    poses[:, 0, 0] = np.minimum(i, 40) / 40
    poses[:, 0, 2] = np.where(i < 20, 3.1, -3.1)
    poses[:, 1, :2] = -1.0
    phase = np.full((rows, 2), ENDED, np.int32)
    phase[:40, 0] = np.where(i[:40] < 30, DRIVING, FACING)
    target = np.full((rows, 2), 3, np.int32)
    target[:40, 0] = 1
    seen = np.zeros((rows, 3, 2), bool)
    seen[40:, 1, 0] = True
    scanned = np.zeros((rows, 2), bool)
    scanned[40, 0] = True
    std = np.full((rows, 3, 2), np.sqrt(20.0), np.float32)
    std[40:, 1] = 0.4
    mean = np.zeros((rows, 3, 2), np.float32)
    mean[40:, 1] = CLASS_BELIEFS.mean[1]
    records = Record(
        time=np.minimum(0.1 * (i + 1), 0.1 * steps).astype(np.float32),
        poses=poses,
        command=np.zeros((rows, 2, 2)),
        phase=phase,
        target=target,
        scanned=scanned,
        detected=scanned,
        belief=Belief(mean, std),
        seen=seen,
    )
    layout = SimpleNamespace(
        position=np.array([[-1.0, 1.0], [1.0, 0.4], [0.0, -1.0]]),
        yaw=np.zeros(3),
        shape=np.array([0, 0, 1]),
    )
    end = SimpleNamespace(
        scene=SimpleNamespace(layout=layout),
        classes=np.array([0, 1, 2]),
        faults=SimpleNamespace(blind_at=np.full(2, np.inf)),
        steps=np.int32(steps),
    )
    return Recording(end, records)

"""What a JMVAE is trained on: which detections are drawn from a bank."""

import jax
import numpy as np
import pytest

from jaxsense.config import JmvaeConfig
from jaxsense.vae import jmvae

MODEL = jmvae.Jmvae(("camera", "lidar"), (1, 2), 2, (3,))
SETTINGS = JmvaeConfig(batch=64, steps=40)
# Class c and row r as 10 c + r; the two modalities have different numbers of rows.
CLASSES, ROWS = np.float32(10) * np.arange(4)[:, None, None], np.arange(5)[None, :, None]
CAMERA = CLASSES + ROWS[:, :3]
LIDAR = np.tile(CLASSES + ROWS, (1, 1, 2))


@pytest.fixture(scope="module")
def drawn():
    return jmvae.Fitting(SETTINGS, (CAMERA, LIDAR), MODEL).draw(jax.random.key(0), 20)


def test_every_class_and_every_row_of_a_bank_is_drawn(drawn):
    noise, (camera, lidar) = drawn
    assert noise.shape == (20, 2, 64)
    assert (camera.shape, lidar.shape) == ((20, 1, 64), (20, 2, 64))
    # 1,280 draws: each of 20 is missed with a chance of (19/20)^1280, below 1e-28.
    assert set(np.unique(camera)) == set(np.asarray(CAMERA).ravel().tolist())
    assert set(np.unique(lidar)) == set(np.asarray(LIDAR).ravel().tolist())


def test_a_pair_is_of_one_class_and_otherwise_independent(drawn):
    _, (camera, lidar) = drawn
    camera, first, second = np.asarray(camera[:, 0]), *np.moveaxis(np.asarray(lidar), 1, 0)
    np.testing.assert_array_equal(camera // 10, first // 10)
    np.testing.assert_array_equal(first, second)
    pairs = set(zip((camera % 10).ravel().tolist(), (first % 10).ravel().tolist(), strict=True))
    assert len(pairs) == 3 * 5
    assert not np.array_equal(camera[0], camera[1])

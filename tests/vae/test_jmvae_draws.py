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


@pytest.mark.parametrize(
    ("bank", "expected"),
    [
        ((CAMERA, LIDAR[:3]), "lidar has 3 classes or rows: must be 4, as many as of camera"),
        ((CAMERA, LIDAR[..., :1]), r"lidar has the shape \(4, 5, 1\): must be \[C, S, 2\]; give"),
        (
            (CAMERA[:, 0], LIDAR),
            r"camera has the shape \(4, 1\): .*; give \[N, 1\] as x\[:, None\]",
        ),
        ((CAMERA, LIDAR[:, :0]), r"lidar has the shape \(4, 0, 2\): must hold one row or more"),
        ((CAMERA, None), "lidar = None: must be an array; leave out rows without it"),
    ],
)
@pytest.mark.parametrize("is_traced", [False, True])
def test_a_bank_of_the_wrong_shape_is_named(bank, expected, is_traced):
    train = jax.jit(jmvae.train, static_argnums=2) if is_traced else jmvae.train
    with pytest.raises(ValueError, match=f"^bank of {expected}"):
        train(jax.random.key(0), {}, MODEL, bank, SETTINGS)


def test_a_bank_with_a_gap_is_named():
    gap = LIDAR.copy()
    gap[2, 3] = np.nan
    with pytest.raises(ValueError, match="bank of lidar = nan: must be finite"):
        jmvae.train(jax.random.key(0), {}, MODEL, (CAMERA, gap), SETTINGS)

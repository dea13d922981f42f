"""From where robots look: shares of new evidence by hand, and ranges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import where
from jaxsense import PRESETS, init
from jaxsense.config import ConfigError
from jaxsense.vae.novelty import Novelty

LEARNED = Novelty(jnp.array([2.0, 0.1]), jnp.array([0.5, 0.5]))


def novelty(share):
    return where.FromWhere(LEARNED.strength, LEARNED.length, jnp.float32(share))


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.75])
def test_at_the_distance_just_the_share_is_new(share):
    found = novelty(share)
    way = found.to_go(jnp.zeros(1), 0)
    if way > 0:
        assert found.weight(way[None], 0) == pytest.approx(share, abs=1e-5)
    else:
        assert found.weight(jnp.zeros(1), 0) >= share
    # Of a look by the other sensor, .83 is new even from the same place.
    assert found.to_go(jnp.zeros(1), 1) == pytest.approx(0.0)


def test_half_is_the_rule_of_missions():
    for modality in range(2):
        usual = LEARNED.to_go(jnp.zeros(2), modality)
        assert novelty(0.5).to_go(jnp.zeros(2), modality) == pytest.approx(usual)


def test_without_a_share_robots_stay():
    assert novelty(0.0).to_go(jnp.zeros(2), 0) == 0


def test_the_share_changes_choices_and_not_the_weights():
    models = init(jax.random.key(0), PRESETS["smoke"])
    changed = where.with_share(models, 0.9).novelty
    np.testing.assert_array_equal(changed.strength, models.novelty.strength)
    assert changed.share == pytest.approx(0.9)


def test_shorter_ranges_drop_the_viewpoints_beyond():
    config = where.within(PRESETS["noisy"], 0.6)
    assert (config.navigation.view_range, config.navigation.view_distances) == (0.6, (0.5,))
    with pytest.raises(ConfigError, match="view_distances"):
        where.within(PRESETS["noisy"], 0.2)


def test_differences_are_paired_by_arena():
    noise = np.random.default_rng(0).normal(size=50)
    usual = {key: noise for key in ("accuracy", "confidence", "looks", "time")}
    found = {key: noise + 1 for key in usual}
    for mean, less, width in where.compare(found, usual).values():
        assert mean == pytest.approx(noise.mean() + 1)
        assert (less, width) == pytest.approx((1.0, 0.0), abs=1e-9)


def test_a_rule_is_compared_with_the_usual_one():
    assert where.as_cell([0.9876, 0.0, 0.0], 3) == "0.988"
    assert where.as_cell([40.0, -1.26, 0.5], 1) == "40.0, -1.3 ± 0.5"
    origin = {
        "command": "python -m benchmarks.where RUN", "device": "cpu", "cores": 2,
        "commit": "0123456789abcdef", "date": "2026-11-26", "versions": {"jax": "0.10.2"},
    }  # fmt: skip
    figures = {"accuracy": [0.99, 0, 0], "confidence": [0.98, 0, 0], "looks": [2.5, 0, 0]}
    row = {"policy": "latent", "rule": "share 0.5", **figures, "time": [40.0, 0, 0]}
    *_, found, _, _ = where.table({**origin, "rows": [row]}).splitlines()
    assert found == "| `latent` | share 0.5 | 0.990 | 0.980 | 2.50 | 40.0 |"

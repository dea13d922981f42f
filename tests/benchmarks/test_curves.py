"""Policies at the same accuracy, from made-up missions, and the oracle's tours by hand."""

import types
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import curves, same_accuracy
from jaxsense import PRESETS, init
from jaxsense.dqn import team_mdp
from jaxsense.dqn.policies import Known


def points(accuracies, looks):
    """A curve whose figures are the same in ten arenas."""
    of = lambda values: np.repeat(np.array(values, float)[:, None], 10, axis=1)  # noqa: E731
    return {"accuracy": of(accuracies), "looks": of(looks), "time": 10 * of(looks)}


def test_needs_are_interpolated_between_points():
    # Half way between .94 and .96.
    found = same_accuracy.at_accuracy(points([0.94, 0.96], [2.0, 3.0]), 0.95, "looks")
    assert found == pytest.approx({"mean": 2.5, "low": 2.5, "high": 2.5})
    # A point of more looks and less accuracy is of no use; nor is one that needs more for less.
    found = same_accuracy.at_accuracy(points([0.97, 0.94, 0.99], [3.0, 5.0, 4.0]), 0.96, "time")
    assert found["mean"] == pytest.approx(30.0)
    assert same_accuracy.at_accuracy(points([0.9, 0.94], [1.0, 2.0]), 0.95, "looks") is None


def test_intervals_are_of_arenas():
    found = points([0.96], [2.0])
    found["looks"] = np.linspace(1.0, 3.0, 10)[None]
    need = same_accuracy.at_accuracy(found, 0.95, "looks")
    assert need["mean"] == pytest.approx(2.0)
    # Two standard errors of ten numbers of deviation .64: .40, of which a bootstrap has .38.
    assert need["low"] == pytest.approx(1.62, abs=0.06)
    assert need["high"] == pytest.approx(2.38, abs=0.06)


def test_a_table_has_a_row_for_each_policy():
    blocks = [
        same_accuracy.as_block("latent", {"look_cost": (0.1,)}, points([0.96], [2.0])),
        same_accuracy.as_block("naive", {"looks": (1,)}, points([0.9], [1.0])),
    ]
    *_, first, second = same_accuracy.as_table(blocks).splitlines()
    assert first.startswith("| `latent` | 2.00 (2.00 to 2.00) | - | - | 20.0 (20.0 to 20.0) |")
    assert second == "| `naive` | - | - | - | - | - | - |"
    labels = same_accuracy.draw(blocks).axes[0].get_legend_handles_labels()[1]
    assert labels == ["latent", "naive"]


@pytest.mark.slow
def test_the_oracle_takes_the_shortest_tour_of_what_its_sensor_has_to_tell():
    config = PRESETS["smoke"]
    models = init(jax.random.key(0), config)
    alone = team_mdp.alone(3, 0)
    # PoIs 1 m ahead, 2 m ahead and 1.5 m behind: behind first would be 1.5 + 2.5 + 1 = 5 m, ahead
    # first 2 + 3.5 = 5.5 m.
    positions = jnp.array([[1.0, 0.0], [2.0, 0.0], [-1.5, 0.0]])
    shares = jnp.full((3, 3), 1 / 3)
    fusion = types.SimpleNamespace(class_probabilities=lambda belief: belief)
    seen = replace(models, fusion=fusion)

    def choose(on_map, truth):
        known = Known(
            belief=on_map,
            looks=jnp.zeros((3, 2), jnp.int32),
            log_posterior=jnp.log(jax.nn.one_hot(jnp.array(truth), 3) + 1e-9),
            team=replace(alone, positions=positions),
            times=jnp.ones((1, 3)),
            robot=jnp.int32(0),
        )
        values = curves.oracle(0.9).values(jax.random.key(0), seen, known)
        return int(jnp.argmax(values))

    assert choose(shares, [0, 1, 2]) == 2
    # The camera's label of the PoI behind, red, is known: classes 1 and 2 are both red.
    red = shares.at[2].set(jnp.array([0.02, 0.49, 0.49]))
    assert choose(red, [0, 1, 2]) == 0
    # If it is green after all, the map is wrong, and there is something to tell.
    assert choose(red, [0, 1, 0]) == 2
    assert choose(jnp.eye(3), [0, 1, 2]) == 3

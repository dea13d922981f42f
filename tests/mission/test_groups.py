"""Work that only some missions of a batch need."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.mission.groups import where_due

CALLS = []


def draw(given):
    key, row = given
    jax.debug.callback(lambda _: CALLS.append(1), row["x"])
    return {"drawn": row["x"] + jax.random.uniform(key)}


@pytest.mark.parametrize(("total", "parts"), [(1, 1), (5, 1), (40, 1), (300, 1), (40, 2)])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_rows_that_are_due_are_worked_out_and_the_others_stay(total, parts, share):
    rng = np.random.default_rng(total)
    due = rng.random(total) < share
    before, x = rng.normal(size=(2, total)).astype(np.float32)
    keys = jax.random.split(jax.random.key(total), total)
    find = jax.jit(
        lambda due, before, keys, x: where_due(
            due, draw, {"drawn": before}, (keys, {"x": x}), parts=parts
        )
    )
    CALLS.clear()
    found = find(due, before, keys, x)["drawn"]
    jax.effects_barrier()
    expected = np.where(due, x + jax.vmap(jax.random.uniform)(keys), before)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # In groups of 8, or a sixteenth of them all; parts wait for the one with the most.
    share_of_part = total // parts
    size = min(share_of_part, max(8, share_of_part // 16))
    most = due.reshape(parts, -1).sum(axis=1).max()
    assert len(CALLS) == parts * size * -(-most // size)


def test_under_vmap_each_batch_has_its_own_rows():
    due = np.array([[True, False, False], [False, False, False], [True, True, True]])
    x = jnp.arange(9.0).reshape(3, 3)
    found = jax.vmap(lambda due, x: where_due(due, lambda x: -x, x, x))(due, x)
    np.testing.assert_array_equal(found, np.where(due, -x, x))

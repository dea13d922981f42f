"""Work that only some missions of a batch need."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.mission.groups import where_due

CALLS = []


def draw(given, kind):
    keys, rows = given
    jax.debug.callback(lambda kind: CALLS.append(int(kind)), kind)
    return {"drawn": rows["x"] + jax.vmap(jax.random.uniform)(keys)}


@pytest.mark.parametrize("total", [1, 5, 40, 300])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_rows_that_are_due_are_worked_out_and_the_others_stay(total, share):
    rng = np.random.default_rng(total)
    due = rng.random(total) < share
    before, x = rng.normal(size=(2, total)).astype(np.float32)
    keys = jax.random.split(jax.random.key(total), total)
    find = jax.jit(
        lambda due, before, keys, x: where_due(due, draw, {"drawn": before}, (keys, {"x": x}))
    )
    CALLS.clear()
    found = find(due, before, keys, x)["drawn"]
    jax.effects_barrier()
    expected = np.where(due, x + jax.vmap(jax.random.uniform)(keys), before)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    size = min(total, max(8, total // 16))  # of a group
    assert [0] * -(-due.sum() // size) == CALLS


def test_the_rows_of_a_group_are_of_one_kind():
    rng = np.random.default_rng(0)
    kinds, x = rng.integers(0, 5, 60), rng.normal(size=60).astype(np.float32)
    due = (rng.random(60) < 0.7) & (kinds != 3)
    CALLS.clear()

    def times_kind(rows, kind):
        jax.debug.callback(lambda kind: CALLS.append(int(kind)), kind)
        branches = [lambda rows, k=k: k * rows for k in range(5)]
        return jax.lax.switch(kind, branches, rows)

    find = jax.jit(lambda due, x, kinds: where_due(due, times_kind, x, x, kinds))
    found = find(due, x, kinds.astype(np.int32))
    jax.effects_barrier()
    np.testing.assert_allclose(found, np.where(due, kinds * x, x))
    # In order, each in groups of 8; none of a kind of which no row is due.
    numbers = [np.sum(due & (kinds == k)) for k in range(5)]
    assert [k for k in range(5) for _ in range(-(-numbers[k] // 8))] == CALLS


def test_under_vmap_each_batch_has_its_own_rows():
    due = np.array([[True, False, False], [False, False, False], [True, True, True]])
    x = jnp.arange(9.0).reshape(3, 3)
    found = jax.vmap(lambda due, x: where_due(due, lambda x, _: -x, x, x))(due, x)
    np.testing.assert_array_equal(found, np.where(due, -x, x))

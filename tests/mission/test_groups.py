"""Work that is due in some missions only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.mission.groups import where_due


@pytest.mark.parametrize("total", [1, 5, 40, 300])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_rows_that_are_due_are_worked_out_and_the_others_stay(total, share):
    rng = np.random.default_rng(total)
    due = rng.random(total) < share
    before, x = rng.normal(size=(2, total, 2))
    calls = []

    def double(x):
        jax.debug.callback(lambda _: calls.append(1), x)
        return {"twice": 2 * x}

    found = jax.jit(lambda due, before, x: where_due(due, double, {"twice": before}, x))(
        *map(jnp.asarray, (due, before, x))
    )
    np.testing.assert_allclose(found["twice"], np.where(due[:, None], 2 * x, before), rtol=1e-6)
    # In groups of 8, or a sixteenth of them all, and so never for many that are not due.
    size = min(total, max(8, total // 16))
    jax.effects_barrier()
    assert len(calls) == size * -(-due.sum() // size)

"""The replay ring against a deque."""

import collections

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.dqn import replay

EXAMPLE = {"s": jnp.zeros(2), "a": jnp.int32(0)}


def items(numbers):
    """Items that can be told apart: s is (i, -i) and a is i."""
    numbers = np.asarray(numbers)
    s = jnp.array(np.stack([numbers, -numbers], axis=-1), jnp.float32)
    return {"s": s, "a": jnp.array(numbers, jnp.int32)}


@pytest.mark.parametrize("size", [1, 3, 4, 12])
def test_the_ring_holds_what_a_deque_would(size):
    capacity, ring, deque = 12, replay.init(EXAMPLE, 12), collections.deque(maxlen=12)
    add = jax.jit(replay.add)
    numbers = np.random.default_rng(size).permutation(1000)
    for i in range(2 * capacity // size + 2):
        batch = numbers[i * size : (i + 1) * size]
        ring = add(ring, items(batch))
        deque.extend(batch)
        filled = min(int(ring.count), capacity)
        held = np.asarray(ring.items["a"])[:filled]
        assert ring.count == (i + 1) * size
        # Rolled so that the oldest comes first.
        oldest = int(ring.count) % capacity if filled == capacity else 0
        np.testing.assert_array_equal(np.roll(held, -oldest), deque)
        np.testing.assert_array_equal(ring.items["s"][:filled], items(held)["s"])


def test_sample_draws_uniformly_from_the_filled_part_alone():
    ring = replay.add(replay.init(EXAMPLE, 12), items([7, 8, 9, 10]))
    drawn = replay.sample(jax.random.key(0), ring, 4000)
    np.testing.assert_array_equal(drawn["s"][:, 0], drawn["a"])  # rows stay together
    counts = np.bincount(drawn["a"], minlength=12)
    assert counts.sum() == counts[7:11].sum() == 4000
    np.testing.assert_allclose(counts[7:11], 1000, atol=4 * np.sqrt(4000 * 3 / 16))


def test_sample_draws_uniformly_from_a_ring_that_has_gone_round():
    ring = replay.init(EXAMPLE, 4)
    for start in (0, 2, 4):
        ring = replay.add(ring, items([start, start + 1]))
    drawn = replay.sample(jax.random.key(0), ring, 4000)
    counts = np.bincount(drawn["a"], minlength=6)
    assert counts[:2].sum() == 0
    np.testing.assert_allclose(counts[2:], 1000, atol=4 * np.sqrt(4000 * 3 / 16))


def test_a_batch_that_does_not_divide_the_capacity_raises():
    with pytest.raises(ValueError, match=r"batch of 5 items: must divide .* 12"):
        replay.add(replay.init(EXAMPLE, 12), items(range(5)))
    with pytest.raises(ValueError, match="batch of 24 items"):
        replay.add(replay.init(EXAMPLE, 12), items(range(24)))


def test_items_of_another_type_raise():
    with pytest.raises(AssertionError):
        replay.add(
            replay.init(EXAMPLE, 12), {"s": jnp.zeros((3, 2)), "a": jnp.zeros(3, jnp.float32)}
        )


def test_add_takes_a_donated_state_and_is_traced_once():
    add = jax.jit(chex.assert_max_traces(replay.add, n=1), donate_argnums=0)
    ring = replay.init(EXAMPLE, 4)
    for i in range(4):
        before, ring = ring, add(ring, items([i, i + 10]))
        assert before.items["s"].is_deleted()
    np.testing.assert_array_equal(ring.items["a"], [2, 12, 3, 13])

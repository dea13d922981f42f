"""The replay ring against a deque, and that draws are uniform."""

import collections

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.dqn import replay

EXAMPLE = {"s": jnp.zeros(2), "a": jnp.int32(0)}
ROUNDS, NUM_ENVS = 4, 3


def items(numbers):
    """Items that can be told apart: s is (i, -i) and a is i."""
    numbers = np.asarray(numbers)
    s = jnp.array(np.stack([numbers, -numbers], axis=-1), jnp.float32)
    return {"s": s, "a": jnp.array(numbers, jnp.int32)}


def test_the_ring_holds_what_a_deque_would():
    ring, deque = replay.init(EXAMPLE, ROUNDS, NUM_ENVS), collections.deque(maxlen=ROUNDS)
    add = jax.jit(replay.add)
    numbers = np.random.default_rng(0).permutation(30).reshape(-1, NUM_ENVS)
    for i, batch in enumerate(numbers):
        ring = add(ring, items(batch))
        deque.append(batch)
        filled = min(i + 1, ROUNDS)
        held = np.asarray(ring.items["a"])[:filled]
        assert ring.count == i + 1
        # Rolled so that the oldest comes first.
        oldest = (i + 1) % ROUNDS if filled == ROUNDS else 0
        np.testing.assert_array_equal(np.roll(held, -oldest, axis=0), deque)
        np.testing.assert_array_equal(ring.items["s"][:filled], items(held)["s"])


@pytest.mark.parametrize("rounds", [1, 3, 7])
def test_every_item_that_is_there_is_drawn_with_the_same_chance(rounds):
    ring = replay.init(EXAMPLE, ROUNDS, NUM_ENVS)
    for i in range(rounds):
        ring = replay.add(ring, items(NUM_ENVS * i + np.arange(NUM_ENVS)))
    drawn = replay.sample(jax.random.uniform(jax.random.key(0), (4000, 2)), ring)
    np.testing.assert_array_equal(drawn["s"][:, 0], drawn["a"])  # rows stay together
    counts = np.bincount(drawn["a"], minlength=NUM_ENVS * rounds)
    there = counts[NUM_ENVS * max(0, rounds - ROUNDS) :]
    assert counts.sum() == there.sum() == 4000
    chance = 1 / len(there)
    np.testing.assert_allclose(there, 4000 * chance, atol=4 * np.sqrt(4000 * chance))


def test_draws_are_tied_to_environments_in_order():
    ring = replay.add(replay.init(EXAMPLE, ROUNDS, 8), items(np.arange(8)))
    # 4 draws of 8 environments: the first takes 0 or 1, by the half of [0, 1) that it is in.
    draws = jnp.array([[0.9, 0.4], [0.0, 0.6], [0.5, 0.0], [0.2, 0.99]])
    np.testing.assert_array_equal(replay.sample(draws, ring)["a"], [0, 3, 4, 7])
    # 8 draws of 4 environments: two of each, wherever in [0, 1) they are.
    ring = replay.add(replay.init(EXAMPLE, ROUNDS, 4), items(np.arange(4)))
    draws = jax.random.uniform(jax.random.key(0), (8, 2))
    np.testing.assert_array_equal(replay.sample(draws, ring)["a"], [0, 0, 1, 1, 2, 2, 3, 3])


def test_the_largest_number_below_one_draws_what_is_there():
    ring = replay.add(replay.init(EXAMPLE, ROUNDS, 512), items(np.arange(512)))
    last = replay.sample(jnp.full((512, 2), np.nextafter(np.float32(1), np.float32(0))), ring)
    assert last["a"][-1] == 511


def test_a_round_that_does_not_fit_raises():
    ring = replay.init(EXAMPLE, ROUNDS, NUM_ENVS)
    with pytest.raises(AssertionError):
        replay.add(ring, items(range(NUM_ENVS + 1)))
    with pytest.raises(AssertionError):
        replay.add(ring, {"s": jnp.zeros((3, 2)), "a": jnp.zeros(3, jnp.float32)})
    with pytest.raises(AssertionError, match="draws"):
        replay.sample(jnp.zeros(3), ring)


def test_add_takes_a_donated_state_and_is_traced_once():
    add = jax.jit(chex.assert_max_traces(replay.add, n=1), donate_argnums=0)
    ring = replay.init(EXAMPLE, 2, 2)
    for i in range(3):
        before, ring = ring, add(ring, items([i, i + 10]))
        assert before.items["s"].is_deleted()
    np.testing.assert_array_equal(ring.items["a"], [[2, 12], [1, 11]])

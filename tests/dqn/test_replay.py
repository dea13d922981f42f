"""The replay ring against a deque, and that draws are uniform."""

import collections

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core.types import Transition
from jaxsense.dqn import replay

ROUNDS, BLOCKS, WIDTH = 4, 3, 2
NUM_ENVS = BLOCKS * WIDTH


def transitions(numbers):
    """Transitions that can be told apart: each part is a multiple of i."""
    i = np.array(numbers, np.float32)
    return Transition(
        s_tm1=np.stack([i, -i]),
        a_tm1=i.astype(np.int32),
        r_t=2 * i,
        discount_t=3 * i,
        s_t=np.stack([4 * i, -4 * i]),
    )


add, sample = jax.jit(replay.add), jax.jit(replay.sample)


@jax.jit
def of_rounds(ring, rounds):
    draws = jnp.stack([(jnp.arange(ROUNDS) + 0.5) / rounds, jnp.zeros(ROUNDS)], axis=-1)
    # A draw for each block takes that block.
    return jax.vmap(lambda draw: replay.sample(jnp.tile(draw, (BLOCKS, 1)), ring))(draws)


def everything(ring, rounds):
    """All that is in the first rounds of a ring, by drawing each of its blocks."""
    return jax.tree.map(lambda x: np.asarray(x)[:rounds], of_rounds(ring, rounds))


def test_the_ring_holds_what_a_deque_would():
    ring, deque = replay.init(2, ROUNDS, BLOCKS, WIDTH), collections.deque(maxlen=ROUNDS)
    numbers = np.random.default_rng(0).permutation(60).reshape(-1, NUM_ENVS)
    for i, batch in enumerate(numbers):
        ring = add(ring, transitions(batch))
        deque.append(batch)
        filled = min(i + 1, ROUNDS)
        held = everything(ring, filled)
        assert ring.count == i + 1
        # Rolled so that the oldest comes first.
        oldest = (i + 1) % ROUNDS if filled == ROUNDS else 0
        np.testing.assert_array_equal(np.roll(held.a_tm1, -oldest, axis=0), deque)
        for row in range(filled):
            expected = transitions(held.a_tm1[row])
            chex.assert_trees_all_equal(jax.tree.map(lambda x: x[row], held), expected)  # noqa: B023


@pytest.mark.parametrize("rounds", [1, 3, 7])
def test_every_transition_that_is_there_is_drawn_with_the_same_chance(rounds):
    ring = replay.init(2, ROUNDS, BLOCKS, WIDTH)
    for i in range(rounds):
        ring = add(ring, transitions(NUM_ENVS * i + np.arange(NUM_ENVS)))
    drawn = sample(jax.random.uniform(jax.random.key(0), (6000, 2)), ring)
    chex.assert_trees_all_equal(drawn, transitions(drawn.a_tm1))  # what belongs together stays so
    counts = np.bincount(drawn.a_tm1, minlength=NUM_ENVS * rounds)
    there = counts[NUM_ENVS * max(0, rounds - ROUNDS) :]
    assert counts.sum() == there.sum() == 6000 * WIDTH
    expected = counts.sum() / len(there)
    np.testing.assert_allclose(there, expected, atol=4 * np.sqrt(expected))


def test_draws_are_tied_to_blocks_in_order():
    ring = add(replay.init(2, ROUNDS, 8, 1), transitions(np.arange(8)))
    # 4 draws of 8 blocks: the first takes 0 or 1, by the half of [0, 1) that it is in.
    draws = jnp.array([[0.9, 0.4], [0.0, 0.6], [0.5, 0.0], [0.2, 0.99]])
    np.testing.assert_array_equal(sample(draws, ring).a_tm1, [0, 3, 4, 7])
    # 8 draws of 4 blocks of 2: two of each, wherever in [0, 1) they are.
    ring = add(replay.init(2, ROUNDS, 4, 2), transitions(np.arange(8)))
    draws = jax.random.uniform(jax.random.key(0), (8, 2))
    blocks = [0, 1, 0, 1, 2, 3, 2, 3, 4, 5, 4, 5, 6, 7, 6, 7]
    np.testing.assert_array_equal(sample(draws, ring).a_tm1, blocks)


def test_add_takes_a_donated_state_and_is_traced_once():
    add = jax.jit(chex.assert_max_traces(replay.add, n=1), donate_argnums=0)
    ring = replay.init(2, 2, 1, 2)
    for i in range(3):
        before, ring = ring, add(ring, transitions([i, i + 10]))
        assert before.columns.is_deleted()
    both = replay.sample(jnp.array([[0.0, 0.0], [0.9, 0.0]]), ring)
    np.testing.assert_array_equal(both.a_tm1, [2, 12, 1, 11])

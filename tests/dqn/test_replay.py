"""The replay ring against a deque, and that draws are uniform."""

import collections
import dataclasses
from dataclasses import astuple

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


def test_the_largest_number_below_one_draws_what_is_there():
    ring = add(replay.init(2, ROUNDS, 512, 1), transitions(np.arange(512)))
    below = np.nextafter(np.float32(1), np.float32(0))
    last = sample(jnp.full((512, 2), below), ring)
    assert last.a_tm1[-1] == 511
    # Of any number of rounds that are there, the last one: products round to below it.
    assert sample(jnp.array([[below, 0.0]]), ring).a_tm1[0] == 0
    counts = np.arange(1, 2**20, dtype=np.float32)
    assert np.all((below * counts).astype(np.int32) == counts - 1)


def test_what_does_not_fit_raises():
    ring = replay.init(2, ROUNDS, BLOCKS, WIDTH)
    with pytest.raises(ValueError, match="transitions"):
        replay.add(ring, transitions(range(NUM_ENVS + 1)))
    with pytest.raises(ValueError, match="transitions"):
        replay.add(replay.init(3, ROUNDS, BLOCKS, WIDTH), transitions(range(NUM_ENVS)))
    with pytest.raises(ValueError, match="draws"):
        replay.sample(jnp.zeros(3), ring)


def test_add_takes_a_donated_state_and_is_traced_once():
    add = jax.jit(chex.assert_max_traces(replay.add, n=1), donate_argnums=0)
    ring = replay.init(2, 2, 1, 2)
    for i in range(3):
        before, ring = ring, add(ring, transitions([i, i + 10]))
        assert before.columns.is_deleted()
    both = replay.sample(jnp.array([[0.0, 0.0], [0.9, 0.0]]), ring)
    np.testing.assert_array_equal(both.a_tm1, [2, 12, 1, 11])


def test_parts_of_a_transition_have_the_dtypes_they_were_added_with():
    ring = add(replay.init(2, ROUNDS, BLOCKS, WIDTH), transitions(range(NUM_ENVS)))
    drawn = sample(jnp.zeros((BLOCKS, 2)), ring)
    kinds = [x.dtype for x in astuple(drawn)]
    assert kinds == [x.dtype for x in astuple(transitions(range(NUM_ENVS)))]


def test_transitions_of_16_bits_keep_their_actions():
    ring = replay.init(2, ROUNDS, BLOCKS, WIDTH)
    given = transitions(np.arange(NUM_ENVS))
    halved = dataclasses.replace(
        jax.tree.map(lambda x: jnp.asarray(x, jnp.bfloat16), given),
        # 16 bits would round 257 to 256.
        a_tm1=jnp.arange(257, 257 + NUM_ENVS),
    )
    held = everything(replay.add(ring, halved), 1)
    np.testing.assert_array_equal(held.a_tm1[0], halved.a_tm1)
    np.testing.assert_array_equal(held.s_t[0], given.s_t)
    assert held.r_t.dtype == np.float32


def test_draws_of_16_bits_would_not_reach_every_round():
    ring = add(replay.init(2, ROUNDS, BLOCKS, WIDTH), transitions(np.arange(NUM_ENVS)))
    for dtype in (jnp.bfloat16, jnp.float16):
        with pytest.raises(
            ValueError, match=rf"draws of dtype {jnp.dtype(dtype)}: must be float32"
        ):
            replay.sample(jnp.zeros((3, 2), dtype), ring)

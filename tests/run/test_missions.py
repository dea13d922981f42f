"""How many missions play side by side, and in which slots."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsense.run import devices, missions
from jaxsense.run.devices import Workers
from jaxsense.run.missions import Ledger

GIB = 2**30
TWO = lambda: Workers(threads=2)  # noqa: E731
MESH = lambda: Workers(mesh=devices.make_mesh(2))  # noqa: E731


@pytest.mark.parametrize(
    ("memory", "total", "workers", "expected"),
    [
        # On a CPU at most a third at once, and what the caches of each thread hold.
        (None, 10_000, Workers, 192),
        (None, 10_000, TWO, 384),
        (None, 30, TWO, 10),
        (None, 1, Workers, 1),
        (80 * GIB, 100, Workers, 100),  # all
        (80 * GIB, 32_768, Workers, 16_384),  # sqrt(8192 * 32,768)
        (80 * GIB, 10**6, Workers, 32_768),  # no more pay
        (8 * GIB, 10**6, Workers, 8_120),  # of 1 MiB each and 9 KiB of paths
        (80 * GIB, 10**7, MESH, 65_536),
        (80 * GIB, 32_768, MESH, 23_170),  # sqrt(8192 * 32,768 * 2)
    ],
)
def test_as_many_missions_play_side_by_side_as_pay_and_fit(
    memory, total, workers, expected, monkeypatch
):
    monkeypatch.setattr(devices, "memory", lambda: memory)
    assert missions.batch_of(total, 3, workers()) == expected


def test_fewer_missions_of_many_pois_fit(monkeypatch):
    monkeypatch.setattr(devices, "memory", lambda: 8 * GIB)
    assert missions.batch_of(10**6, 32) == 4_096  # of 1 MiB each and as much of paths


def test_missions_take_the_slots_of_those_that_are_done():
    ledger = Ledger([np.arange(7)], 3)
    assert ledger.needs_reserve
    np.testing.assert_array_equal(ledger.reserve(), [0, 1, 2])
    np.testing.assert_array_equal(ledger.fill(), [0, 1, 2])
    np.testing.assert_array_equal(ledger.playing, [0, 1, 2])
    assert ledger.needs_reserve
    np.testing.assert_array_equal(ledger.reserve(), [3, 4, 5])
    np.testing.assert_array_equal(ledger.fill(), [-1, -1, -1])
    np.testing.assert_array_equal(ledger.end(np.array([True, False, True])), [0, 2])
    np.testing.assert_array_equal(ledger.fill(), [0, -1, 1])
    np.testing.assert_array_equal(ledger.playing, [3, 1, 4])
    assert not ledger.needs_reserve
    np.testing.assert_array_equal(ledger.end(np.array([True, True, False])), [0, 1])
    np.testing.assert_array_equal(ledger.fill(), [2, -1, -1])  # one slot waits for the reserve
    np.testing.assert_array_equal(ledger.playing, [5, -1, 4])
    np.testing.assert_array_equal(ledger.reserve(), [6, 0, 0])
    np.testing.assert_array_equal(ledger.fill(), [-1, 0, -1])
    np.testing.assert_array_equal(ledger.playing, [5, 6, 4])
    assert not ledger.needs_reserve
    np.testing.assert_array_equal(ledger.end(np.ones(3, bool)), [0, 1, 2])
    assert ledger.is_over


def test_a_part_begins_again_what_it_has_left_when_another_one_needs_a_reserve():
    ledger = Ledger([np.arange(0, 8, 2), np.arange(1, 8, 2)], 2)
    np.testing.assert_array_equal(ledger.reserve(), [0, 2, 1, 3])
    ledger.fill()
    np.testing.assert_array_equal(ledger.reserve(), [4, 6, 5, 7])
    ledger.end(np.array([True, True, True, False]))
    np.testing.assert_array_equal(ledger.fill(), [0, 1, 0, -1])
    np.testing.assert_array_equal(ledger.playing, [4, 6, 5, 3])
    assert not ledger.needs_reserve  # the first part has no more missions
    ledger.end(np.array([False, False, False, True]))
    np.testing.assert_array_equal(ledger.fill(), [-1, -1, -1, 1])
    np.testing.assert_array_equal(ledger.playing, [4, 6, 5, 7])


@settings(deadline=None, max_examples=50)
@given(
    total=st.integers(1, 40),
    parts=st.integers(1, 3),
    slots=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_mission_is_played_once(total, parts, slots, seed):
    random = np.random.default_rng(seed)
    of_parts = [np.arange(total)[part::parts] for part in range(parts)]
    ledger, ended = Ledger(of_parts, slots), []
    reserved = shown = np.full(parts * slots, -1)
    while not ledger.is_over:
        if ledger.needs_reserve:
            reserved = ledger.reserve()
        taken, part = ledger.fill(), np.arange(parts * slots) // slots
        shown = np.where(taken < 0, shown, reserved[part * slots + np.maximum(taken, 0)])
        plays = ledger.playing >= 0
        np.testing.assert_array_equal(ledger.playing[plays], shown[plays])
        playing = ledger.playing.copy()
        ended += playing[ledger.end(random.random(len(playing)) < 0.4)].tolist()
    assert sorted(ended) == [*range(total)]

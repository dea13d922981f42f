"""A map of objects in slots: which candidate is of which, and what a map is worth."""

from dataclasses import replace
from itertools import permutations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from untrained import blank

from jaxsense import Config
from jaxsense.exploration import Candidates
from jaxsense.exploration import slots as maps

MODELS = blank(Config())
RADIUS, DETECTION, CLUTTER = 0.1, 0.9, 0.005


def at(*places, std=0.03):
    """Up to six candidates."""
    position = jnp.zeros((6, 2)).at[: len(places)].set(jnp.array(places, jnp.float32))
    covariance = jnp.tile(std**2 * jnp.eye(2), (6, 1, 1))
    return Candidates(jnp.zeros(6), jnp.zeros(6), position, covariance, jnp.arange(6) < len(places))


def one_scan(slots, candidates, expected):
    """The map after a scan in which the slots that are expected were in view."""
    which = maps.associate(slots, candidates, RADIUS)
    slots = maps.with_candidates(slots, candidates, which, DETECTION, CLUTTER)
    slots = maps.with_misses(MODELS, slots, expected & ~which.is_seen, DETECTION)
    return maps.merged(MODELS, slots, RADIUS), which


after = jax.jit(chex.assert_max_traces(one_scan, n=1))


def mapped(*places, scans=1):
    slots = maps.empty(MODELS, 4)
    for _ in range(scans):
        slots, _ = after(slots, at(*places), slots.is_used)
    return slots


def test_an_update_as_worked_by_hand():
    slots, seen = mapped((1, 2)), at((1.02, 1.96), std=0.02)
    known = jnp.diag(jnp.array([0.00039, 0.00119]))
    slots = replace(slots, covariance=slots.covariance.at[0].set(known))
    which = maps.associate(slots, seen, RADIUS)
    found = maps.with_candidates(slots, seen, which, DETECTION, 50)
    assert which.slot.tolist() == [0, -1, -1, -1, -1, -1]
    # With the drift .0004 and .0012 m2, so gains of .5 and .75.
    assert found.position[0] == pytest.approx(np.array([1.01, 1.97]), abs=1e-5)
    assert found.covariance[0] == pytest.approx(np.diag([2e-4, 3e-4]), abs=1e-9)
    # The squared distance is .0004 / .0008 + .0016 / .0016 = 1.5.
    density = np.exp(-0.75) / (2 * np.pi * np.sqrt(8e-4 * 1.6e-3))
    assert found.existence[0] == pytest.approx(-2 + np.log(0.1 + 0.9 * density / 50), rel=1e-4)


def test_probabilities_are_shares_of_missions():
    """Slots seen once are objects in 2 of 100 cases, the surest ones in 99.5 (seed 100, 1,024)."""
    slots = replace(maps.empty(MODELS, 2), existence=jnp.array([-2.0, 10.0]))
    found = maps.probability(slots)
    assert found[0] == pytest.approx(1 / (1 + np.exp(5.7)), rel=1e-4)
    np.testing.assert_allclose(found, [0.019, 0.9954], atol=0.02)


def test_an_object_is_taken_away_and_its_slot_is_empty():
    slots = mapped((1, 0), (0, 1), scans=3)
    assert maps.found(slots).tolist() == [True, True, False, False]
    slots = replace(slots, log_posterior=slots.log_posterior + 1, times_seen=slots.times_seen + 2)
    for _ in range(6):  # 10 - 6 * 2.3 < -3
        assert slots.is_used[0]
        slots, _ = after(slots, at((0, 1)), slots.is_used)
    assert slots.is_used.tolist() == [False, True, False, False]
    row = lambda x: jax.tree.map(lambda x: x[:1] if x.ndim else x, x)  # noqa: E731
    chex.assert_trees_all_equal(row(slots), row(maps.empty(MODELS, 4)))


def test_an_unknown_object_beside_a_known_one_is_its_own():
    slots = mapped((0, 0), scans=5)
    of = lambda slots, *places: maps.associate(slots, at(*places), RADIUS).slot.tolist()  # noqa: E731
    found, _ = after(slots, at((0.01, 0), (0.25, 0)), slots.is_used)
    assert found.is_used.tolist() == [True, True, False, False]
    # Within the gate of a vague slot, which a better one takes; alone, it is of that slot.
    vague = replace(slots, covariance=slots.covariance.at[0].set(0.1 * jnp.eye(2)))
    assert of(vague, (0.01, 0), (0.25, 0))[:2] == [0, 4]
    assert of(vague, (0.25, 0))[0] == 0
    # A sharp slot is likelier than a vague one at less of its deviations.
    places, wide = found.position.at[1, 0].set(-0.06), found.covariance.at[0].set(0.1 * jnp.eye(2))
    assert of(replace(found, position=places, covariance=wide), (0, 0))[0] == 1
    # Nearer than two bodies can be, both are of it, and two halves of a new one are one.
    assert of(slots, (0.12, 0), (0.01, 0))[:2] == [0, 0]
    assert of(slots, (0.12, 0))[0] == 0  # although outside of the gate
    assert of(slots, (2, 0), (2.1, 0), (3, 0)) == [4, -1, 4, -1, -1, -1]


def test_more_objects_than_slots_are_counted():
    slots = mapped(*[(x, y) for x in range(2) for y in range(3)])
    assert slots.overflow == 2
    assert slots.position.tolist() == [[0, 0], [0, 1], [0, 2], [1, 0]]


def test_two_slots_of_one_object_unite():
    slots = mapped((0, 0), (0.4, 0), (3, 0))
    evidence = jnp.log(jnp.array([[0.5, 0.25, 0.25], [0.6, 0.2, 0.2]]))
    places = slots.looked_from.at[0, 0, 0].set(5).at[1, 0, :2].set(jnp.array([[6], [7]]))
    slots = replace(
        slots,
        position=slots.position.at[1, 0].set(0.06),
        covariance=slots.covariance.at[1].mul(2),
        log_posterior=slots.log_posterior.at[:2].set(evidence),
        times_seen=slots.times_seen.at[:2, 0].set(jnp.array([1, 2])),
        looked_from=places,
        belief=jax.tree.map(lambda x: x + jnp.arange(4.0)[:, None], slots.belief),
    )
    three = slots.position.at[:3, 0].set(jnp.array([0, 0.06, 0.11]))
    assert maps.merged(MODELS, replace(slots, position=three), RADIUS).is_used.sum() == 2
    one = maps.merged(MODELS, slots, RADIUS)
    assert one.is_used.tolist() == [False, True, True, False]
    assert one.position[1, 0] == pytest.approx(0.02, abs=3e-4)  # their variances are 1 : 2
    assert one.belief.mean[1, 0] == 1
    assert jnp.exp(one.log_posterior[1]) == pytest.approx(np.array([0.75, 0.125, 0.125]))
    assert one.times_seen[1, 0] == 3
    assert one.looked_from[1, 0, :4, 0].tolist() == [6, 7, 5, np.inf]


def test_assignments_are_as_good_as_those_of_scipy():
    draws, auction = np.random.default_rng(0), jax.jit(maps.auction, static_argnums=1)
    for _ in range(200):
        profit = np.where(draws.random((7, 5)) < 0.6, draws.normal(4, 4, (7, 5)), -np.inf)
        own = np.asarray(auction(jnp.float32(profit), 0.01))
        assert np.bincount(own, minlength=6)[:5].max() <= 1
        padded = np.append(profit.clip(min=0), np.zeros((7, 7)), axis=1)
        best = padded[linear_sum_assignment(-padded)].sum()
        assert profit[own < 5, own[own < 5]].sum() == pytest.approx(best, abs=0.07)


@pytest.mark.parametrize("p", [1, 2])
def test_gospa_by_brute_force(p):
    draws, gospa = np.random.default_rng(p), jax.jit(maps.gospa, static_argnames="p")
    for _ in range(40):
        slots, truth = draws.uniform(0, 0.8, (2, 4, 2))
        is_found, is_present = draws.random((2, 4)) < 0.75
        found = gospa(slots, is_found, truth, is_present, p=p)
        few, many = sorted([slots[is_found], truth[is_present]], key=len)
        apart = np.linalg.norm(few[:, None] - many[None], axis=-1).clip(max=0.3) ** p
        orders = [np.array(x, int) for x in permutations(range(len(many)), len(few))]
        best = min(apart[np.arange(len(few)), order].sum() for order in orders)
        expected = best + (len(many) - len(few)) * 0.3**p / 2
        assert found.localisation + found.missed + found.false == pytest.approx(expected, abs=1e-3)
        assert float(found.total) ** p == pytest.approx(expected, abs=1e-3)


def test_gospa_counts_duplicates_apart():
    slots, is_found = jnp.array([[0.1, 0], [0, 0.2], [2, 0], [0, 0]]), jnp.arange(4) < 3
    truth, is_present = jnp.array([[0.0, 0], [1, 0], [2, 0]]), jnp.arange(3) < 2
    found = dict(vars(maps.gospa(slots, is_found, truth, is_present)))
    np.testing.assert_array_equal(found.pop("slot"), [0, 4, 4])
    # One found at .1 m, one missed, and two false of half the cutoff each.
    expected = {"total": 0.55, "localisation": 0.1, "missed": 0.15, "false": 0.3}
    expected = {**expected, "duplicates": 1, "position_error": 0.1}
    assert {name: x.item() for name, x in found.items()} == pytest.approx(expected)


def test_a_map_grows_out_of_noisy_scans_of_a_walk():
    def scan(state, key):
        slots, robot, truth = state
        keys = jax.random.split(key, 5)
        robot = jnp.clip(robot + 0.6 * jax.random.normal(keys[0], (2,)), -4, 4)
        std = jax.random.uniform(keys[1], (12,), minval=0.01, maxval=0.05)
        places = jnp.append(truth, jax.random.uniform(keys[2], (4, 2), minval=-4, maxval=4), axis=0)
        places = places + std[:, None] * jax.random.normal(keys[3], (12, 2))
        in_view = lambda x: jnp.linalg.norm(x - robot[None], axis=-1) < 4  # noqa: E731
        # False ones on 64 m2, in four rows.
        chance = jnp.append(jnp.full(8, DETECTION), jnp.full(4, 16 * CLUTTER))
        seen = in_view(places) & (jax.random.uniform(keys[4], (12,)) < chance)
        candidates = Candidates(std, std, places, std[:, None, None] ** 2 * jnp.eye(2)[None], seen)
        slots, _ = one_scan(slots, candidates, in_view(slots.position))
        return (slots, robot, truth), in_view(truth)

    def walk(key):
        keys = jax.random.split(key)
        places = jnp.stack(jnp.meshgrid(*[jnp.arange(-3.5, 4, 0.5)] * 2), axis=-1).reshape(-1, 2)
        truth = jax.random.choice(keys[0], places, (8,), replace=False)
        start = maps.empty(MODELS, 16), jnp.zeros(2), truth
        (slots, *_), views = jax.lax.scan(scan, start, jax.random.split(keys[1], 60))
        score = maps.gospa(slots.position, maps.found(slots), truth, jnp.ones(8, bool))
        return score, jnp.sum(jnp.sum(views, axis=0) < 6)

    keys = jax.random.split(jax.random.key(0), 64)
    scores, rarely_seen = jax.jit(jax.vmap(walk))(keys)
    assert jnp.all(scores.missed <= 0.15 * rarely_seen + 1e-6)
    assert jnp.sum(scores.duplicates) == 0
    assert jnp.sum(scores.false) / 0.15 <= 0.01 * 8 * 64
    assert jnp.mean(scores.position_error) < 0.012
    one = jax.jit(walk)(keys[3])[0]
    chex.assert_trees_all_close(one, jax.tree.map(lambda x: x[3], scores), atol=1e-4)

"""Whole missions of the naive policy, which needs no training, with and without failures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import CONFIG

from jaxsense import mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.mission import act
from jaxsense.mission.act import where_due
from jaxsense.mission.outcome import REASONS, reason
from jaxsense.mission.rollout import rollout_batch
from jaxsense.mission.state import ENDED, FAILED, Faults
from jaxsense.sim import amiro

NAIVE = 1
STEPS, CHUNK = 280, 40
NUM_POIS = CONFIG.arena.num_pois
PERIOD = CONTROL_PERIOD
FAULT_TIME = 4.0  # s
NEVER = (np.inf, np.inf)
# For each case: when robots stop and go blind, and the number of its arenas.
CASES = {
    "healthy": (NEVER, NEVER, 4),
    "0 stops": ((FAULT_TIME, np.inf), NEVER, 2),
    "1 stops": ((np.inf, FAULT_TIME), NEVER, 2),
    "0 blind": (NEVER, (FAULT_TIME, np.inf), 2),
    "1 blind": (NEVER, (np.inf, FAULT_TIME), 2),
    "nobody": ((0.0, 0.0), NEVER, 1),
}
NUM_ARENAS = CASES["healthy"][2]
TOGETHER = sum(number for _, _, number in CASES.values())


@pytest.fixture(scope="module")
def team(team):
    """With the policies that play, since every other one takes long to compile."""
    policies = {name: team.policies[name] for name in ("latent", "naive")}
    return dataclasses.replace(team, policies=policies)


@pytest.fixture(scope="module")
def go_on(team, models):
    """One control period after another, in arenas side by side."""

    return jax.jit(lambda keys, states: rollout_batch(keys, team, models, states, CHUNK))


@pytest.fixture(scope="module")
def reset(team, models):
    """Missions side by side, each of its own key, policy and faults; as many as are played."""

    @jax.jit
    @jax.vmap
    def of_each(key, policy, faults):
        return mission.reset(key, team, models, policy, faults)

    def begin(keys, policies, faults=None):
        if faults is None:
            faults = Faults(*np.full((2, TOGETHER, 2), np.inf, np.float32))
        return of_each(keys, np.broadcast_to(np.int32(policies), TOGETHER), faults)

    return begin


@pytest.fixture(scope="module")
def played(reset, go_on, as_numpy):
    """For each case: states before, states after and records; and all states after 4 s."""
    stops_at, blind_at = (
        np.array([case[i] for case in CASES.values() for _ in range(case[2])], np.float32)
        for i in (0, 1)
    )
    keys = jax.random.split(jax.random.key(4), TOGETHER)
    start = reset(keys, NAIVE, Faults(stops_at, blind_at))
    states, records = [start], []
    for i in range(STEPS // CHUNK):
        keys = jax.random.split(jax.random.key(1 + i), TOGETHER)
        state, record = go_on(keys, states[-1])
        states.append(state)
        records.append(record)
    record = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *records)
    whole, first, found = as_numpy((start, states[-1], record)), 0, {}
    for name, (_, _, size) in CASES.items():
        found[name] = jax.tree.map(lambda x: x[first : first + size], whole)  # noqa: B023
        first += size
    return found, states[1]


@pytest.mark.slow  # compiles a mission once more
def test_a_batch_is_its_members_one_by_one(team, models, played):
    # Thirteen, more than decide or scan at once.
    states = played[1]
    keys = jax.random.split(jax.random.key(9), len(states.steps))
    together = jax.jit(lambda k, s: rollout_batch(k, team, models, s, CHUNK))
    alone = jax.jit(lambda k, s: mission.rollout(k, team, models, s, CHUNK))
    ends, records = together(keys, states)
    assert np.sum(records.scanned) > 10
    for b in range(len(keys)):
        end, record = alone(keys[b], jax.tree.map(lambda x: x[b], states))  # noqa: B023
        for name in ("phase", "target", "scanned", "detected", "seen"):
            np.testing.assert_array_equal(getattr(records, name)[b], getattr(record, name))
        np.testing.assert_allclose(records.poses[b], record.poses, atol=1e-3)
        np.testing.assert_array_equal(ends.steps[b], end.steps)


@pytest.fixture(scope="module")
def healthy(played):
    return played[0]["healthy"]


def reasons(state):
    return [REASONS[code] for code in jax.vmap(reason)(state)]


def test_every_robot_visits_every_poi_once_and_ends(healthy):
    _, end, record = healthy
    assert reasons(end) == ["finished"] * NUM_ARENAS
    assert np.all(end.robots.phase == ENDED)
    assert np.all(end.seen)
    np.testing.assert_array_equal(record.detected.sum(axis=1), NUM_POIS)
    assert np.all(end.robots.looks >= NUM_POIS)


def test_limits_of_speed_and_acceleration_hold(healthy):
    _, _, record = healthy
    assert np.all(np.abs(record.command[..., 0]) <= amiro.MAX_SPEED + 1e-6)
    assert np.all(np.abs(record.command[..., 1]) <= amiro.MAX_TURN_RATE + 1e-6)
    change = np.abs(np.diff(record.command, axis=1)) / PERIOD
    assert np.all(change[..., 0] <= amiro.MAX_ACCELERATION + 1e-4)
    assert np.all(change[..., 1] <= amiro.MAX_TURN_ACCELERATION + 1e-4)
    # And the robots really move no faster than that: the wheels reach what they are told.
    moved = np.linalg.norm(np.diff(record.poses[..., :2], axis=1), axis=-1) / PERIOD
    turned = np.abs(np.diff(record.poses[..., 2], axis=1)) / PERIOD
    assert np.max(moved) <= 1.01 * amiro.MAX_SPEED
    assert np.max(turned) <= 1.01 * amiro.MAX_TURN_RATE
    assert np.max(moved) > 0.99 * amiro.MAX_SPEED


def test_scans_are_taken_in_range_and_facing_the_poi(healthy):
    start, _, record = healthy
    new = record.seen[:, 1:] & ~record.seen[:, :-1]
    arena, step, target, robot = np.nonzero(new)
    pose = record.poses[arena, step, robot]  # at the end of the period before
    to_poi = start.scene.layout.position[arena, target] - pose[:, :2]
    distance = np.linalg.norm(to_poi, axis=-1)
    bearing = np.arctan2(to_poi[:, 1], to_poi[:, 0]) - pose[:, 2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    # Some were taken in the very first period.
    assert len(distance) >= 0.9 * 2 * NUM_POIS * NUM_ARENAS
    assert np.all(distance >= CONFIG.viewpoint.min_distance)
    assert np.all(distance <= CONFIG.navigation.view_range + 1e-3)
    assert np.max(np.abs(bearing)) <= np.radians(act.GOAL_ANGLE) + 1e-3


def test_the_map_changes_where_something_was_detected_and_nowhere_else(healthy):
    _, end, record = healthy
    wrote = record.detected.any(axis=-1)
    changed = np.any(np.diff(record.belief.mean, axis=1) != 0, axis=(-1, -2))
    np.testing.assert_array_equal(changed, wrote[:, 1:])
    np.testing.assert_array_equal(end.times_seen.sum(axis=(1, 2)), record.detected.sum(axis=(1, 2)))
    assert np.all(np.diff(record.seen.astype(int), axis=1) >= 0)


def test_a_mission_that_is_over_stays_as_it_is(healthy):
    _, end, record = healthy
    last = end.steps - 1
    assert np.all(end.steps < STEPS)
    for arena in range(NUM_ARENAS):
        after = record.poses[arena, last[arena] :]
        np.testing.assert_array_equal(after, np.broadcast_to(after[0], after.shape))
        assert np.all(record.time[arena, last[arena] :] == record.time[arena, -1])


@pytest.mark.parametrize("robot", [0, 1])
def test_a_robot_that_stops_leaves_the_other_one_working(played, robot):
    _, end, record = played[0][f"{robot} stops"]
    assert np.all(end.robots.phase[:, robot] == FAILED)
    assert np.all(end.robots.phase[:, 1 - robot] == ENDED)
    assert np.all(end.robots.target == NUM_POIS)
    after = record.time[0] > FAULT_TIME + 0.5
    assert not record.detected[:, after, robot].any()
    assert np.all(record.command[:, after, robot] == 0)
    moved = np.ptp(record.poses[:, after, robot], axis=1)
    assert np.max(np.abs(moved)) < 1e-3
    assert np.all(end.seen[:, :, 1 - robot])
    assert np.all(end.contacts == 0)
    assert np.all(np.isfinite(end.belief.mean))
    assert np.all(end.belief.std > 0)


@pytest.mark.parametrize("robot", [0, 1])
def test_a_robot_that_goes_blind_detects_nothing_more_and_the_mission_says_so(played, robot):
    _, end, record = played[0][f"{robot} blind"]
    after = record.time[0] > FAULT_TIME + 0.2
    assert record.scanned[:, after, robot].any()
    assert not record.detected[:, after, robot].any()
    missed = ~end.seen[:, :, robot]
    assert missed.any()
    np.testing.assert_array_equal(end.robots.undetected[:, robot], missed)
    assert np.all(end.seen[:, :, 1 - robot])
    expected = ["undetected" if m else "finished" for m in missed.any(axis=1)]
    assert reasons(end) == expected


def test_without_any_robot_the_mission_ends_at_once(played):
    _, end, _ = played[0]["nobody"]
    assert reasons(end) == ["no robot left"]
    assert np.all(end.steps == 1)
    assert np.all(end.robots.looks == 0)


CALLS = []


def draw(given, kind):
    keys, rows = given
    jax.debug.callback(lambda kind: CALLS.append(int(kind)), kind)
    return {"drawn": rows["x"] + jax.vmap(jax.random.uniform)(keys)}


@pytest.mark.parametrize(("total", "share"), [(1, 1.0), (5, 0.0), (40, 0.6), (300, 0.1)])
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

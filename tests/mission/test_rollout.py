"""Whole missions of the naive policy, which needs no training, with and without failures."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from teams import CONFIG

from jaxsense import mission
from jaxsense.config import CONTROL_PERIOD
from jaxsense.mission import act, navigation
from jaxsense.mission.state import DRIVING, ENDED, FACING, FAILED, Faults
from jaxsense.sim import amiro
from jaxsense.sim import arena as arenas

LATENT, NAIVE = 0, 1
STEPS, CHUNK = 240, 40
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

    return jax.jit(lambda keys, states: mission.rollout_batch(keys, team, models, states, CHUNK))


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
    together = jax.jit(lambda k, s: mission.rollout_batch(k, team, models, s, CHUNK))
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
    return [mission.REASONS[code] for code in jax.vmap(mission.reason)(state)]


def test_the_smallest_clearance_is_that_of_the_records_until_the_end(healthy):
    _, end, record = healthy
    is_over = np.arange(STEPS) >= end.steps[:, None]
    assert is_over.any(axis=1).all()
    until_end = np.where(is_over, np.inf, record.clearance)
    np.testing.assert_array_equal(until_end.min(axis=1), end.min_clearance)


def test_every_robot_visits_every_poi_once_and_ends(healthy):
    _, end, record = healthy
    assert reasons(end) == ["finished"] * NUM_ARENAS
    assert np.all(end.robots.phase == ENDED)
    assert np.all(end.seen)
    np.testing.assert_array_equal(record.detected.sum(axis=1), NUM_POIS)
    assert np.all(end.robots.looks >= NUM_POIS)


def test_nobody_touches_anything(healthy):
    _, end, record = healthy
    assert np.all(end.contacts == 0)
    assert np.min(end.min_clearance) > 0.03
    moving = record.time > 0
    np.testing.assert_allclose(
        np.where(moving, record.clearance, np.inf).min(axis=1), end.min_clearance, rtol=1e-6
    )


def test_limits_of_speed_and_acceleration_hold(healthy):
    _, _, record = healthy
    for commands in (record.command, record.wanted):
        assert np.all(np.abs(commands[..., 0]) <= amiro.MAX_SPEED + 1e-6)
        assert np.all(np.abs(commands[..., 1]) <= amiro.MAX_TURN_RATE + 1e-6)
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
    np.testing.assert_array_equal(end.version, record.detected.sum(axis=(1, 2)))
    assert np.all(np.diff(record.seen.astype(int), axis=1) >= 0)


def test_one_robot_drives_while_another_one_scans(healthy):
    _, _, record = healthy
    phases = record.phase
    apart = (phases[..., 0] == DRIVING) & (phases[..., 1] == FACING)
    assert np.mean(apart.any(axis=1)) > 0.5


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


def test_same_keys_give_the_same_mission_and_the_policy_does_not_change_the_arena(reset):
    keys, others = (jax.random.split(jax.random.key(n), TOGETHER) for n in (3, 4))
    first, again = (reset(keys, NAIVE) for _ in range(2))
    latent, other = reset(keys, LATENT), reset(others, 0)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    jax.tree.map(np.testing.assert_array_equal, first.scene, latent.scene)
    assert not np.any(first.scene.poses[:, 0] == other.scene.poses[:, 0])


@pytest.fixture(scope="module")
def driven(team, played, as_numpy):
    """Physics of eight missions from 4 s on, with commands that go on towards the hardest.

    The states, MuJoCo's data before the first step, and `[E, T, ...]` positions, velocities and
    wheel speeds.
    """
    arena = team.world.arena
    hardest = jnp.array([[amiro.MAX_SPEED, amiro.MAX_TURN_RATE], [-0.1, -amiro.MAX_TURN_RATE]])
    recorded = jax.tree.map(lambda x: x[:8], played[1])

    def drive(state):
        data = arenas.place(arena, state.scene.layout, state.scene.poses)
        data = data.replace(qvel=state.velocity.reshape(-1), qacc_warmstart=state.warmstart)

        def substep(carry, _):
            data, command = carry
            command = navigation.ramp(command, hardest, arenas.TIMESTEP)
            speeds = navigation.wheel_speeds(command)
            data = arenas.drive(arena, data, speeds)
            return (data, command), (data.qpos, data.qvel, speeds)

        return data, jax.lax.scan(substep, (data, state.robots.command), length=20)[1]

    before, after = jax.jit(jax.vmap(drive))(recorded)
    return as_numpy((recorded, before, *after))


@pytest.mark.slow
def test_a_physics_step_from_recorded_states_is_that_of_c_mujoco(team, driven):
    arena = team.world.arena
    recorded, before, qpos, qvel, speeds = driven
    assert np.max(np.abs(recorded.velocity)) > 0.1  # some of them are driving
    for e in range(8):
        native = mujoco.MjData(arena.mj_model)
        native.mocap_pos[:], native.mocap_quat[:] = before.mocap_pos[e], before.mocap_quat[e]
        native.qpos[:], native.qvel[:] = before.qpos[e], before.qvel[e]
        native.ctrl[:] = arenas.as_control(speeds[e, 0])
        mujoco.mj_step(arena.mj_model, native)
        np.testing.assert_allclose(qpos[e, 0], native.qpos, atol=1e-5)
        np.testing.assert_allclose(qvel[e, 0], native.qvel, atol=1e-4)


@pytest.mark.slow  # `ramp` and `drive` alone keep to them in other tests
def test_limits_hold_at_every_physics_step(driven):
    *_, qpos, qvel, speeds = driven
    assert np.max(np.abs(speeds)) <= amiro.MAX_WHEEL_SPEED + 1e-4
    velocity, yaw = qvel.reshape(8, 20, 2, 3), qpos.reshape(8, 20, 2, 3)[..., 2]
    forward = velocity[..., 0] * np.cos(yaw) + velocity[..., 1] * np.sin(yaw)
    change = np.abs(np.diff(forward, axis=1)) / arenas.TIMESTEP
    turning = np.abs(np.diff(velocity[..., 2], axis=1)) / arenas.TIMESTEP
    # A servo that follows a ramp changes no faster than the ramp; one part in fifty for Euler.
    assert np.max(change) <= 1.02 * amiro.MAX_ACCELERATION
    assert np.max(turning) <= 1.02 * amiro.MAX_TURN_ACCELERATION
    assert np.max(change) > 0.5 * amiro.MAX_ACCELERATION

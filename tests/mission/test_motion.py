"""Physics of a control period, against C MuJoCo and with contacts always computed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from teams import CONFIG, FAST_TO_COMPILE, alone

from jaxsense import mission
from jaxsense.mission import motion
from jaxsense.sim import amiro, navigation
from jaxsense.sim import arena as arenas

POSITIONS = [[0.8, 0.0], [-1.0, 1.0], [-1.0, -1.0]]


@pytest.fixture(scope="module")
def recorded(team, models):
    """States of eight missions after 4 s."""
    reset = jax.jit(jax.vmap(lambda k: mission.reset(k, team, mission.NAIVE)))
    roll = jax.jit(
        jax.vmap(lambda k, s: mission.rollout(k, team, models, s, 40)[0]),
        compiler_options=FAST_TO_COMPILE,
    )
    keys = jax.random.split(jax.random.key(0), 8)
    return roll(keys, reset(keys))


def test_a_physics_step_from_recorded_states_is_that_of_c_mujoco(team, recorded):
    arena = team.world.arena

    def step(state):
        data = arenas.place(arena, state.scene.layout, state.scene.poses)
        data = data.replace(qvel=state.velocity.reshape(-1), qacc_warmstart=state.warmstart)
        speeds = navigation.wheel_speeds(state.robots.wanted)
        return data, speeds, arenas.drive(arena, data, speeds)

    before, speeds, after = jax.jit(jax.vmap(step))(recorded)
    assert np.max(np.abs(recorded.velocity)) > 0.1  # some of them are driving
    for e in range(8):
        native = mujoco.MjData(arena.mj_model)
        native.mocap_pos[:], native.mocap_quat[:] = before.mocap_pos[e], before.mocap_quat[e]
        native.qpos[:], native.qvel[:] = before.qpos[e], before.qvel[e]
        native.ctrl[:] = arenas.as_control(speeds[e])
        mujoco.mj_step(arena.mj_model, native)
        np.testing.assert_allclose(after.qpos[e], native.qpos, atol=1e-5)
        np.testing.assert_allclose(after.qvel[e], native.qvel, atol=1e-4)


def test_limits_hold_at_every_physics_step(team, recorded):
    arena = team.world.arena
    hardest = jnp.array([[amiro.MAX_SPEED, amiro.MAX_TURN_RATE], [-0.1, -amiro.MAX_TURN_RATE]])

    def drive(state):
        data = arenas.place(arena, state.scene.layout, state.scene.poses)
        data = data.replace(qvel=state.velocity.reshape(-1), qacc_warmstart=state.warmstart)

        def substep(carry, _):
            data, command = carry
            command = navigation.ramp(command, hardest, arenas.TIMESTEP)
            speeds = navigation.wheel_speeds(command)
            data = arenas.drive(arena, data, speeds)
            return (data, command), (data.qpos, data.qvel, speeds)

        return jax.lax.scan(substep, (data, state.robots.command), length=20)[1]

    qpos, qvel, speeds = map(np.asarray, jax.jit(jax.vmap(drive))(recorded))
    assert np.max(np.abs(speeds)) <= amiro.MAX_WHEEL_SPEED + 1e-4
    velocity, yaw = qvel.reshape(8, 20, 2, 3), qpos.reshape(8, 20, 2, 3)[..., 2]
    forward = velocity[..., 0] * np.cos(yaw) + velocity[..., 1] * np.sin(yaw)
    change = np.abs(np.diff(forward, axis=1)) / arenas.TIMESTEP
    turning = np.abs(np.diff(velocity[..., 2], axis=1)) / arenas.TIMESTEP
    # A servo that follows a ramp changes no faster than the ramp; one part in fifty for Euler.
    assert np.max(change) <= 1.02 * amiro.MAX_ACCELERATION
    assert np.max(turning) <= 1.02 * amiro.MAX_TURN_ACCELERATION
    assert np.max(change) > 0.5 * amiro.MAX_ACCELERATION


@pytest.mark.slow  # a minute, mostly compiling; before a release
def test_missions_with_contacts_always_and_never_computed_take_the_same_decisions(team, models):
    never = mission.make_mission(CONFIG, contacts=False)
    always = mission.Mission(team.world, team.world.arena)
    keys = jax.random.split(jax.random.key(2), 6)
    records = []
    for each in (never, always):
        reset = jax.jit(jax.vmap(lambda k, m=each: mission.reset(k, m, mission.NAIVE)))
        roll = jax.jit(
            jax.vmap(lambda k, s, m=each: mission.rollout(k, m, models, s, 150)[1]),
            compiler_options=FAST_TO_COMPILE,
        )
        records.append(roll(keys, reset(keys)))
    for name in ("phase", "target", "scanned", "detected", "seen"):
        np.testing.assert_array_equal(*(getattr(record, name) for record in records))
    np.testing.assert_allclose(*(record.poses for record in records), atol=1e-3)


@pytest.fixture(scope="module")
def pushing(arena_of, set_robot):
    """The camera robot drives at a cylinder of which it stands `gap` metres away."""

    def make(gap):
        x = 0.8 - CONFIG.arena.poi_radius - amiro.BODY_RADIUS - gap
        state = arena_of(POSITIONS, [[x, 0.0, 0.0], [0.0, 1.2, 0.0]], classes=(0, 1, 2))
        speed = jnp.array([amiro.MAX_SPEED, 0.0])
        return set_robot(state, 0, command=speed, wanted=speed)

    return make


def test_contacts_hold_a_robot_back_where_there_are_any(team, pushing):
    free = mission.make_mission(CONFIG, contacts=False)
    ends = {}
    for name, each in (("contacts", team), ("free", free)):
        move = jax.jit(alone(lambda state, m=each: motion.move(m, state)))
        state = pushing(0.002)
        for _ in range(5):
            state, _ = move(state)
        ends[name] = float(state.scene.poses[0, 0] - pushing(0.0).scene.poses[0, 0])
        assert state.contacts > 0
        assert state.least_clearance < 0
    # In half a second it drives 10 cm, but for the time it takes to start.
    assert ends["free"] > 0.08
    assert ends["contacts"] < 0.01


def test_a_batch_moves_like_its_members(team, pushing):
    gaps = jnp.array([0.002, 0.5, 0.03])
    states = [pushing(float(gap)) for gap in gaps]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *states)
    together, clearance = jax.jit(lambda s: motion.move(team, s))(batch)
    move = jax.jit(alone(lambda s: motion.move(team, s)))
    for i, state in enumerate(states):
        single, expected = move(state)
        np.testing.assert_allclose(together.scene.poses[i], single.scene.poses, atol=1e-6)
        np.testing.assert_allclose(clearance[i], expected, atol=1e-6)


def test_where_nothing_can_be_touched_the_empty_arena_gives_the_same_motion(team, pushing):
    always = mission.Mission(team.world, team.world.arena)
    empty, _ = jax.jit(alone(lambda s: motion.move(team, s)))(pushing(0.05))
    full, _ = jax.jit(alone(lambda s: motion.move(always, s)))(pushing(0.05))
    np.testing.assert_allclose(empty.scene.poses, full.scene.poses, atol=1e-6)
    # And it is used there, and nowhere else: with wheels that do not pull, a robot stays.
    model = team.free_arena.model
    idle = replace(
        team.free_arena, model=model.replace(actuator_gainprm=0 * model.actuator_gainprm)
    )
    move = jax.jit(alone(lambda s: motion.move(mission.Mission(team.world, idle), s)))

    def way(start):
        return move(start)[0].scene.poses[0, 0] - start.scene.poses[0, 0]

    assert way(pushing(0.05)) < 1e-3
    assert way(pushing(0.04)) > 1e-2

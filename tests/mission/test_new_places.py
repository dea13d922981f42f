"""From where a robot looks again: only a place from which much of a look is new."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import LATENT, POSES, POSITIONS, with_values

from jaxsense.core.novelty import Novelty
from jaxsense.mission import act
from jaxsense.mission.decide import RECOVERY_TIME
from jaxsense.mission.state import BACKING, DRIVING, ENDED, FACING, IDLE

# Half of a look is new at .5 sqrt(2 ln(.83 / .414)) = .59 m.
STAYS_OLD = Novelty(strength=jnp.full(2, 2 * (np.sqrt(2.0) - 1)), length=jnp.full(2, 0.5))


def looked_from(place, poi=0, modality=0):
    """A sensor has looked at a PoI from a place."""
    return lambda state: replace(
        state, looked_from=state.looked_from.at[poi, modality, 2].set(jnp.array(place))
    )


def test_a_robot_looks_again_from_where_the_look_is_new(decides, models, arena_of):
    values = with_values(models, [1.0, 0.0, 0.0, 0.0], [0.0] * 4)
    state = looked_from([0.1, 0.0])(arena_of(POSITIONS, POSES, policy=LATENT))
    here = state.roadmap.viewpoints.shape[1]
    # All of a look counts from anywhere: it stays.
    assert decides(values, state).robots.view[0] == here
    found = decides(replace(values, novelty=STAYS_OLD), state)
    assert found.robots.phase[0] == DRIVING
    chosen = state.roadmap.viewpoints[0, found.robots.view[0]]
    assert np.hypot(chosen[0] - 0.1, chosen[1]) >= 0.588
    # What another sensor has looked at, or the own one elsewhere, does not count.
    for other in (looked_from([0.1, 0.0], modality=1), looked_from([0.1, 0.0], poi=1)):
        there = other(arena_of(POSITIONS, POSES, policy=LATENT))
        assert decides(replace(values, novelty=STAYS_OLD), there).robots.view[0] == here


def test_a_robot_leaves_a_poi_at_which_no_look_is_new(decides, models, arena_of):
    values = with_values(models, [1.0, -0.1, 0.5, 0.0], [0.0] * 4)
    # No place is as far as 50 m from where the sensor has looked at PoI 0.
    far = Novelty(strength=jnp.full(2, 100.0), length=jnp.full(2, 15.0))
    values = replace(values, novelty=far)
    state = arena_of(POSITIONS, POSES, policy=LATENT)
    assert decides(values, state).robots.target[0] == 0
    after = decides(values, looked_from([0.1, 0.0])(state))
    assert (after.robots.phase[0], after.robots.goals[0]) == (IDLE, 0)
    np.testing.assert_array_equal(after.robots.exhausted[0], [True, False, False])
    assert not after.robots.exhausted[1:].any()
    assert not after.robots.unreachable.any()
    # It takes the next best, and nothing if no look there is new either.
    assert decides(values, after).robots.target[0] == 2
    nowhere = decides(values, looked_from([0.1, 0.0], poi=2)(after))
    assert decides(values, nowhere).robots.phase[0] == ENDED


def test_where_all_new_viewpoints_are_taken_a_robot_makes_room_and_tries_again(
    decides, models, arena_of, set_robot
):
    values = with_values(models, [1.0, 0.0, 0.0, 0.0], [0.0] * 4)
    values = replace(values, novelty=STAYS_OLD)
    state = looked_from([0.1, 0.0])(arena_of(POSITIONS, POSES, policy=LATENT))
    first = decides(values, state).robots.view[0]
    apart = np.hypot(*(np.asarray(state.roadmap.viewpoints[0]) - [0.1, 0.0]).T)
    is_new = jnp.append(apart >= 0.6, False)
    assert is_new[first]

    def decided(excluded, attempts=0, other=POSES[1]):
        there = set_robot(state, 0, target=0, excluded=excluded, attempts=attempts)
        poses = there.scene.poses.at[1].set(jnp.array(other))
        return decides(values, replace(there, scene=replace(there.scene, poses=poses))).robots

    # One that is occupied is a detour.
    aside = decided(jnp.zeros_like(is_new), other=[*state.roadmap.viewpoints[0, first], 0.0])
    assert (aside.phase[0], is_new[aside.view[0]]) == (DRIVING, True)
    assert aside.view[0] != first
    # Of the new ones one is left; then none, but no robot is there: looks have shown nothing.
    assert decided(is_new.at[first].set(False)).view[0] == first
    again = decided(is_new, 1)
    assert (again.phase[0], again.view[0], again.attempts[0]) == (DRIVING, first, 1)
    assert not again.excluded[0].any()
    occupied = [*np.asarray(state.roadmap.viewpoints[0, first]), 0.0]
    waits = decided(is_new, other=occupied)
    assert (waits.phase[0], waits.attempts[0]) == (BACKING, 1)
    np.testing.assert_allclose(waits.backs_off_until[0], RECOVERY_TIME)
    assert not waits.unreachable.any()
    # After three failures it gives the PoI up, and may try once more in the end.
    left = decided(is_new, 2, occupied)
    assert (left.phase[0], left.goals[0]) == (IDLE, 1)
    np.testing.assert_array_equal(left.unreachable[0], [True, False, False])
    for robots in (again, waits, left):
        assert not robots.exhausted.any()
        assert not robots.excluded[0].any()


@pytest.mark.parametrize(
    ("apart", "looked", "phase"),
    [(0.15, False, FACING), (0.15, True, DRIVING), (0.04, True, FACING)],
)
def test_near_a_viewpoint_a_robot_stops_only_where_a_look_is_new(
    team, models, arena_of, set_robot, apart, looked, phase
):
    learned = Novelty(strength=jnp.full(2, 1.0), length=jnp.full(2, 0.03))
    roadmap = arena_of(POSITIONS, POSES).roadmap
    view = int(np.argmax(roadmap.is_free[0]))
    viewpoint = roadmap.viewpoints[0, view]
    to_poi = jnp.array(POSITIONS[0]) - viewpoint
    place = viewpoint + apart * to_poi / jnp.linalg.norm(to_poi)
    state = arena_of(POSITIONS, [[*place, 0.0], [-1.2, 0.2, 0.0]])
    state = looked_from(place)(state) if looked else state
    under_way = set_robot(state, 0, phase=DRIVING, target=0, view=view, path_left=0.2)
    approach = jax.jit(lambda models, state: act.approach(team, models, state, 0)[0])
    after = approach(replace(models, novelty=learned), under_way)
    assert after.robots.phase[0] == phase

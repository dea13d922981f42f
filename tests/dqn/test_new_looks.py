"""Looks of a team that repeat earlier ones from nearby, by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import PLACES, TRAVEL, Certain, Fixed, Toy, make_mdp, team_mdp_of

from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts

CAMERA, LIDAR = range(2)
# Two looks of the camera from one place are worth 1 + 1 / 4; those of the LiDAR are all new.
NOVELTY = Novelty(jnp.array([1.0, 0.0]), jnp.array([0.5, 1.0]))
# To where half of a look is new: (1 + exp(-d^2 / (2 * .5^2)))^-2 = 1 / 2.
AWAY = 0.5 * math.sqrt(-2 * math.log(math.sqrt(2) - 1))


@pytree
class Far(Certain):
    """A look shows how far it is from its PoI."""

    def observe(self, key, scene, poi, modality, distance):
        return jnp.reshape(jnp.float32(distance), 1), scene


@pytree
class Weighing(Toy):
    """A look adds to the information what of it is new, and writes what it shows."""

    def update(self, belief, seen, features, modality, weight=1.0):
        return Belief(features, 1.0 / (1.0 / belief.std + weight))


def team_of(*robots, **given):
    mapped = make_mdp(Far(), Weighing(Belief(*jnp.ones((2, 1))), 3), 3, min_increase=0.0)
    places = Fixed(PLACES, jnp.zeros((len(robots), 3)))
    given = {"partly_seen": 0.0, "novelty": NOVELTY, "num_pois": (3, 3), **given}
    return team_mdp_of(mapped, places, robots=robots, **given)


def play(mdp, *actions):
    """States and outcomes after each of some actions."""
    step = jax.jit(lambda state, action: mdps.step(jax.random.key(1), mdp, state, action))
    state, found = jax.jit(starts.reset)(jax.random.key(0), mdp), []
    for action in actions:
        state, outcome = step(state, jnp.int32(action))
        found.append((state, outcome))
    return found


@pytest.mark.parametrize(("sensor", "away", "new"), [(CAMERA, AWAY, 0.5), (LIDAR, 0.0, 1.0)])
def test_a_robot_goes_round_a_poi_to_where_its_look_is_new(sensor, away, new):
    (first, once), (second, twice) = play(team_of(sensor, is_random=False), 0, 0)
    np.testing.assert_allclose([once.seconds, once.reward], [5 + 1, 1.0], rtol=1e-5)
    np.testing.assert_allclose(first.team.poses[0], [1.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose([twice.seconds, twice.reward], [away / 0.2 + 1, new], rtol=1e-4)
    # From 1 m a chord of the circle around the PoI, which it faces.
    angle = 2 * math.asin(away / 2 / 0.9)
    place = [1.9 - 0.9 * math.cos(angle), -0.9 * math.sin(angle)]
    np.testing.assert_allclose(second.team.poses[0], [*place, angle], atol=1e-4)
    np.testing.assert_allclose([second.belief.mean[0, 0], twice.distance], 0.9, rtol=1e-4)
    here = second.looked_from[0, sensor, :2]
    np.testing.assert_allclose(here, [place, [1.0, 0.0]], atol=1e-4)


def test_it_goes_away_from_the_nearest_earlier_look():
    mdp = team_of(CAMERA, is_random=False)
    ((state, _),) = play(mdp, 0)
    # South-west of the PoI at (1.9, 0), .9 m from it, and a bit to the right of there.
    place, right = jnp.array([1.36, -0.72]), jnp.array([0.8, -0.6])

    @jax.jit
    def look_again(side):
        team = state.team.replace(poses=jnp.append(place, 0.0)[None])
        seen_from = state.looked_from.at[0, CAMERA, 0].set(place + side * right)
        before = state.replace(looked_from=seen_from, team=team)
        return mdps.step(jax.random.key(1), mdp, before, jnp.int32(0))

    for side in (0.1, -0.1):
        moved, outcome = look_again(side)
        assert np.sign((moved.team.poses[0, :2] - place) @ right) == -np.sign(side)
        assert outcome.reward > 0.49  # the way is not quite straight


@pytest.mark.parametrize(
    ("to_go", "seconds", "expected"),
    [
        (0.9, 5 + 2.25, (-0.675, -0.45 * math.sin(math.pi / 3), math.pi / 6)),
        (0.9, 5 + 4.5, (-0.45, -0.9 * math.sin(math.pi / 3), math.pi / 3)),
        (-0.9, 99.0, (-0.45, 0.9 * math.sin(math.pi / 3), -math.pi / 3)),
        (9.0, 99.0, (0.9, 0.0, math.pi)),  # no farther than the other side
    ],
)
def test_the_pose_on_the_way_round_as_worked_by_hand(to_go, seconds, expected):
    start, place = jnp.array([-1.9, 0.0, 0.0]), jnp.zeros(2)
    found = TRAVEL.move(start, place, jnp.float32(seconds), jnp.float32(to_go))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    whole = TRAVEL.seconds(start, place, jnp.float32(to_go))
    np.testing.assert_allclose(whole, 5 + abs(to_go) / 0.2 + 1, rtol=1e-5)


def test_looks_of_a_robot_alone_are_all_new():
    found = play(team_of(CAMERA, LIDAR, alone=1.0), 0, 0, 0)
    np.testing.assert_allclose([outcome.reward for _, outcome in found], 1.0, rtol=1e-5)
    np.testing.assert_allclose([outcome.seconds for _, outcome in found], 1.0, rtol=1e-5)
    assert (found[-1][0].belief.mean[0, 0], found[-1][1].distance) == (0.0, 0.0)  # from anywhere


def test_looks_before_the_start_were_in_view_of_their_pois():
    seen = jnp.array([[True, False], [False, False], [True, True]])
    given = team_of(CAMERA, LIDAR, alone=0.0), np.zeros(3, np.int32), seen
    reset = jax.jit(jax.vmap(starts.reset, (0, None, None, None)))
    state = reset(jax.random.split(jax.random.key(3), 100), *given)
    away = np.asarray(state.looked_from - PLACES[None, :, None, None])
    apart = np.linalg.norm(away, axis=-1)
    np.testing.assert_allclose(apart[..., 0][:, seen], 0.9, rtol=1e-5)
    np.testing.assert_allclose(state.belief.mean[:, [0, 2], 0], 0.9, rtol=1e-5)
    assert (apart[..., 1:] > 1e5).all()
    assert (apart[..., 0][:, ~seen] > 1e5).all()
    # From all around: a mean of 300 has a deviation of .9 / sqrt(600) = .037.
    assert np.abs(away[..., 0, :][:, seen].mean(axis=(0, 1))).max() < 0.15

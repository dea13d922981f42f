"""What a robot of a team knows when it chooses."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import PLACES, TRAVEL

from jaxsense.core import networks
from jaxsense.core.types import Belief
from jaxsense.dqn import pooling
from jaxsense.dqn.pooling import PoolingNetwork
from jaxsense.dqn.team import Team, num_features, surroundings

NOP, CAMERA, LIDAR = 3, 0, 1
BELIEF = Belief(jnp.array([[3.0], [-1.0], [0.5]]), jnp.array([[0.3], [2.0], [1.0]]))


def team_of_three(**changed):
    """A camera and a LiDAR at the origin, which heads for PoI 1, and a camera that has ended."""
    team = Team(
        positions=PLACES,
        present=jnp.ones(3, bool),
        poses=jnp.array([[0, 0, 0], [0, 0, math.pi / 2], [1.9, 0, 0]]),
        modality=jnp.array([CAMERA, LIDAR, CAMERA]),
        works=jnp.array([True, True, False]),
        target=jnp.array([NOP, 1, 0]),
    )
    return replace(team, **changed)


@jax.jit
def observe(team, agent, belief=BELIEF):
    times = TRAVEL.times(team, jnp.zeros(team.heads.shape))
    return surroundings(belief, team, times, agent, 2)


def test_what_a_robot_knows_as_worked_by_hand():
    turn, half = math.pi / 2, math.pi
    # Seconds to PoIs 0, 1 and 2: 5, 10 and 15 of driving, 1 of looking, and the turns.
    camera = np.array([6, 11 + turn, 16 + half]) / 10
    lidar = np.exp(-np.array([6 + turn, 11, 16 + turn]) / 10)
    # The camera that has ended stands at PoI 0 and counts nowhere.
    expected = [
        [3, -1, 0.5],
        [0.3, 2, 1],
        camera,
        [0, 0, 0],  # no other camera heads for anything
        [0, lidar[1], 0],
        [0, 0, 0],  # nor could be anywhere
        lidar,
        [1, 1, 1],  # its own sensor is a camera
        [0, 0, 0],
        [1, 1, 1],
        *np.asarray(PLACES).T,
    ]
    found = observe(team_of_three(), jnp.int32(0))
    assert found.shape == (num_features(1, 2), 3)
    np.testing.assert_allclose(found, np.array(expected), atol=1e-5)
    # For the LiDAR the camera is the other one; it heads for PoI 2 now.
    heading = team_of_three(target=jnp.array([2, 1, 0]))
    found = observe(heading, jnp.int32(1))
    np.testing.assert_allclose(found[3], [0, 0, np.exp(-camera[2])], atol=1e-5)
    np.testing.assert_array_equal(found[4], 0)
    np.testing.assert_allclose(found[5], np.exp(-camera), atol=1e-5)
    np.testing.assert_array_equal(found[6], 0)
    np.testing.assert_array_equal(found[7:9], [[0] * 3, [1] * 3])


@pytest.mark.parametrize("agent", [0, 1])
def test_permuting_pois_permutes_what_is_known_of_them(agent):
    order = jnp.array([2, 0, 1])
    heading = team_of_three(present=jnp.array([True, True, False]))
    there = replace(
        heading,
        positions=PLACES[order],
        present=heading.present[order],
        target=jnp.array([NOP, 2, 1]),  # PoI 1 is now the third, PoI 0 the second
    )
    belief = jax.tree.map(lambda x: x[order], BELIEF)
    here = observe(heading, jnp.int32(agent))
    np.testing.assert_array_equal(observe(there, jnp.int32(agent), belief), here[:, order])


def test_of_an_absent_poi_nothing_is_known():
    found = observe(team_of_three(present=jnp.array([True, False, True])), jnp.int32(0))
    np.testing.assert_array_equal(found[:, 1], 0.0)
    whole = observe(team_of_three(), jnp.int32(0))
    np.testing.assert_array_equal(found[:, [0, 2]], whole[:, [0, 2]])


FEATURES = num_features(2, 2)
NETWORK = PoolingNetwork((6, 8), FEATURES)
PARAMS = networks.init(jax.random.key(0), NETWORK, 3 * FEATURES)
apply = jax.jit(lambda x: networks.apply(NETWORK, PARAMS, x.reshape(-1, *x.shape[2:])))


def seen(number, seed=1):
    """`[F, N]` of as many PoIs, all of which are present."""
    return jax.random.normal(jax.random.key(seed), (FEATURES, number)).at[-3].set(1.0)


def plain(params, x):
    """The values of the PoIs and of NOP in NumPy."""
    of_layer = lambda name, x: params[name]["kernel"].T @ x + params[name]["bias"][:, None]  # noqa: E731
    dense = lambda name, x: np.maximum(of_layer(name, x), 0)  # noqa: E731
    present, known = x[-3], x[:-2]
    each = dense("PoI_1", dense("PoI_0", known)) * present
    message, seconds = dense("Message", each) * present, pooling._seconds_between(x[-2:])
    near, far = np.exp(-seconds / 2), np.exp(-seconds / 6)
    own = [known, each, message @ near.T, message @ far.T / (1 + far @ present)]
    pool = np.append(each.sum(axis=1) / max(present.sum(), 1), each.max(axis=1))
    context = of_layer("Context", pool[:, None])
    of_pois = np.maximum(of_layer("Own", np.concatenate(own)) + context, 0)
    values = of_layer("Value", of_pois)[0]
    return np.append(np.where(present > 0, values, pooling._NOTHING), 0)


@pytest.mark.parametrize("number", [1, 2, 5])
def test_values_are_those_of_a_plain_network(number):
    # Of the second PoI, which is absent, nothing counts. Biases of zero would hide what is added.
    rng, x = np.random.default_rng(0), np.array(seen(number))
    x[-3, 1:2] = 0.0
    params = jax.tree.map(lambda x: rng.normal(0, 0.5, x.shape).astype(np.float32), PARAMS)
    values = jax.jit(lambda x: networks.apply(NETWORK, params, x.reshape(-1)))(x)
    np.testing.assert_allclose(values, plain(params["params"], x), rtol=1e-4)
    assert len(np.unique(values)) == number + 1


def test_a_batch_equals_single_ones():
    batch = jnp.stack([seen(3, seed) for seed in range(4)], axis=-1)
    batch = batch.at[-3, 1, 2].set(0.0)
    together = apply(batch)
    for i in range(4):
        np.testing.assert_allclose(together[:, i], apply(batch[:, :, i]), atol=1e-5)


@pytest.mark.parametrize("is_absent", [False, True])
def test_gradients_are_finite_where_all_pois_are_at_one_place(is_absent):
    # The lengths of ways are 0 there, whose square root has no gradient.
    x = seen(3).at[-2:].set(0.0)
    x = jnp.where(jnp.arange(3) == 1, 0.0, x) if is_absent else x

    def total(params, x):
        return jnp.sum(networks.apply(NETWORK, params, x.reshape(-1))[:-1:2])

    gradients = jax.jit(jax.grad(total, argnums=(0, 1)))(PARAMS, x)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))
    assert any(np.any(g != 0) for g in jax.tree.leaves(gradients[0]))


def test_nearness_as_worked_by_hand():
    # From the origin over PoI 0 to each; robots look from .9 m, and drive .2 m in a second.
    place = jnp.array([[1.9, 1.0, 5.0, -2.9], [0.0, 2.9, 0.0, 0.0]])
    seconds = pooling._seconds_between(place)[0]
    # It stops 1 m ahead. PoI 0 is near enough; PoI 1 a quarter turn and 2 m to drive; PoI 2 4 m
    # straight on, 3.1 to drive; PoI 3 a half turn and 3.9 m behind it, 3 to drive.
    expected = [0, np.pi / 2 + 2 / 0.2, 3.1 / 0.2, np.pi + 3.0 / 0.2]
    np.testing.assert_allclose(seconds, expected, atol=1e-3)

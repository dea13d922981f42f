"""What is reported of missions, on made-up ends of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from teams import AHEAD, CONFIG, POLICIES, with_class_beliefs

from jaxsense import mission
from jaxsense.core.types import Belief
from jaxsense.mission import outcome
from jaxsense.mission.outcome import REASONS, reason
from jaxsense.mission.state import DRIVING, ENDED, FAILED

POSES = [[0.0, 0.0, 0.0], [0.0, 1.2, 0.0]]
# Green cylinder, red cylinder, red cube.
MEANS = jnp.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])


@pytest.fixture(scope="module")
def known(models):
    return with_class_beliefs(models, Belief(MEANS, jnp.full((3, 2), 0.3)))


@pytest.fixture
def ended(arena_of):
    state = arena_of(AHEAD, POSES, classes=(0, 1, 2))
    robots = replace(state.robots, phase=jnp.full(2, ENDED))
    return replace(state, robots=robots, done=jnp.bool_(True), steps=jnp.int32(123))


def test_figures_as_worked_by_hand(team, known, ended):
    # PoI 0 is known; PoI 1, a red cylinder, may as well be a red cube; PoI 2 is taken for green.
    mean = jnp.array([[-1.0, 1.0], [1.0, 0.1], [-1.0, 1.0]])
    std = jnp.array([[0.3, 0.4], [0.3, 1.2], [0.3, 0.4]])
    robots = replace(
        ended.robots,
        goals=jnp.array([3, 2]),
        reached=jnp.array([3, 1]),
        looks=jnp.array([3, 2]),
        detections=jnp.array([3, 1]),
    )
    state = replace(ended, belief=Belief(mean, std), robots=robots, contacts=jnp.int32(4))
    state = replace(state, times_seen=jnp.array([[1, 0]] * 3))
    measure = jax.jit(lambda state: outcome.measure(team, known, state))
    found = measure(state)
    np.testing.assert_array_equal(found["is_right"], [True, True, False])
    np.testing.assert_array_equal(found["ambiguous"], [False, True, False])
    np.testing.assert_allclose(found["nll"][:2], -np.log(found["confidence"][:2]), rtol=1e-6)
    assert found["nll"][2] > 1 > found["nll"][1] > 0.5 > found["nll"][0] > 0
    # Colours: green, red and, wrongly, green; shapes: round, round and, wrongly, round.
    np.testing.assert_allclose(found["told"]["camera"], 2 / 3)
    np.testing.assert_allclose(found["told"]["lidar"], 2 / 3)
    np.testing.assert_allclose(found["observations_per_poi"], 5 / 3)
    np.testing.assert_allclose(found["time_s"], 12.3, rtol=1e-6)
    assert (found["collisions"], found["goals"], found["goals_reached"]) == (4, 5, 4)
    # 1 / .5 + 1 / sqrt(.09 + 1.44) + 1 / .5
    np.testing.assert_allclose(found["information"], 4 + 1 / np.sqrt(1.53), rtol=1e-5)
    # What nobody has seen is neither right nor reported.
    unseen = measure(replace(state, times_seen=jnp.zeros((3, 2), int)))
    assert not np.any(unseen["is_right"])
    assert not np.any(unseen["ambiguous"])
    assert unseen["told"]["camera"] == 0


@pytest.mark.parametrize(
    ("expected", "change"),
    [
        ("finished", lambda s: s),
        ("running", lambda s: replace(s, done=jnp.bool_(False))),
        ("time limit", lambda s: _phases(s, ENDED, DRIVING)),
        ("no robot left", lambda s: _phases(s, FAILED, FAILED)),
        ("robot failed", lambda s: _phases(s, FAILED, ENDED)),
        ("unreachable", lambda s: _flags(s, "unreachable")),
        ("undetected", lambda s: _flags(s, "undetected")),
        ("exhausted", lambda s: _flags(s, "exhausted")),
        ("undetected", lambda s: _flags(_flags(s, "exhausted"), "undetected")),
        ("unreachable", lambda s: _flags(_flags(s, "undetected"), "unreachable")),
    ],
)
def test_a_mission_says_how_it_ended(ended, expected, change):
    assert REASONS[reason(change(ended))] == expected


def _phases(state, *phases):
    return replace(state, robots=replace(state.robots, phase=jnp.array(phases)))


def _flags(state, name):
    flags = getattr(state.robots, name).at[1, 2].set(True)
    return replace(state, robots=replace(state.robots, **{name: flags}))


def test_cases_are_the_policies_and_every_failure_of_every_robot():
    cases = mission.cases(CONFIG)
    assert list(cases) == [
        *POLICIES,
        "camera_alone", "camera_stops", "camera_blind",
        "lidar_alone", "lidar_stops", "lidar_blind",
    ]  # fmt: skip
    assert all(cases[name].policy == name for name in POLICIES)
    assert all(cases[name].policy == "latent" for name in cases if name not in POLICIES)
    np.testing.assert_array_equal(cases["camera_alone"].faults.stops_at, [np.inf, 0.0])
    np.testing.assert_array_equal(cases["lidar_stops"].faults.stops_at, [np.inf, 6.0])
    np.testing.assert_array_equal(cases["lidar_blind"].faults.blind_at, [np.inf, 6.0])
    np.testing.assert_array_equal(cases["naive"].faults.stops_at, [np.inf, np.inf])
    settings = replace(CONFIG.jmvae, reconstruction_weights=(1.0,))
    single = replace(CONFIG, modalities=("camera",), jmvae=settings)
    assert list(mission.cases(single)) == list(POLICIES)

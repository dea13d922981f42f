"""The MDP of teams with times worked by hand, on maps whose rewards are known."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import PLACES, TRAVEL, Fixed, classes_mdp, noisy_mdp, team_mdp_of

from jaxsense.config.learning import TeamConfig
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts
from jaxsense.dqn.team import Places, Team, Travel

NOP, CAMERA, LIDAR = 3, 0, 1
FIRST = 0.2 - 1 / np.sqrt(40)  # gain of a look, see `toys.classes_mdp`


def make_mdp(mapped=None, places=PLACES, robots=(0, 1), **config):
    mapped = classes_mdp(partly_seen_starts=False) if mapped is None else mapped
    poses = jnp.arange(3.0 * len(robots)).reshape(-1, 3)
    given = {"num_pois": (1, 3), "robots": jnp.array(robots), "chooses_anew": False, **config}
    return team_mdp_of(mapped, Fixed(places, poses), **given)


MDP, ANEW = make_mdp(), make_mdp(chooses_anew=True)


reset = jax.jit(starts.reset)


def start(poses, modality, places=PLACES, works=None):
    """Nobody has chosen yet."""
    number = len(poses)
    works = np.ones(number, bool) if works is None else np.array(works)
    known = reset(jax.random.key(0), MDP, np.arange(3), np.zeros((3, 2), bool))
    team = Team(
        positions=places,
        present=jnp.ones(3, bool),
        poses=jnp.array(poses, jnp.float32),
        modality=jnp.array(modality),
        works=jnp.asarray(works),
        target=jnp.asarray(np.full(number, NOP)),
    )
    return dataclasses.replace(
        known,
        team=team,
        asks=jnp.asarray(works),
        agent=jnp.int32(np.argmax(works)),
        looked=jnp.zeros(number),
    )


jitted = jax.jit(mdps.step)


def play(state, *actions, mdp=MDP):
    """The states after each action, and the outcomes."""
    found = []
    for action in actions:
        found.append(jitted(jax.random.key(1), mdp, state, jnp.int32(action)))
        state = found[-1][0]
    return [*zip(*found, strict=True)]


reset_all = jax.jit(jax.vmap(starts.reset, (0, None)))


def resets(**given):
    return reset_all(
        jax.random.split(jax.random.key(3), 600), make_mdp(robots=(0, 0, 1, 1), **given)
    )


def test_teams_start_with_every_number_of_pois_and_of_robots():
    found = resets(alone=0.0, num_pois=(2, 3))
    present, works = np.asarray(found.team.present), np.asarray(found.team.works)
    # The first ones exist: two or three equally often, 300 +- 4 sqrt(600 / 4) = +- 49.
    np.testing.assert_array_equal(present, np.arange(3) < present.sum(axis=1)[:, None])
    np.testing.assert_allclose(
        np.bincount(present.sum(axis=1), minlength=4), [0, 0, 300, 300], atol=49
    )
    # Of two robots of each modality, the first works, and the second in half of the teams.
    np.testing.assert_array_equal(found.team.modality, np.tile([0, 0, 1, 1], (600, 1)))
    np.testing.assert_allclose(works.mean(axis=0), [1, 0.5, 1, 0.5], atol=0.082)
    assert abs(np.corrcoef(works[:, 1], works[:, 3])[0, 1]) < 4 / np.sqrt(600)
    np.testing.assert_array_equal(found.asks, works)
    np.testing.assert_array_equal(found.agent, 0)
    np.testing.assert_array_equal(found.seconds, 0)
    np.testing.assert_array_equal(found.team.target, 3)
    np.testing.assert_array_equal(found.team.positions, np.tile(PLACES, (600, 1, 1)))
    np.testing.assert_array_equal(found.team.poses[0], np.arange(12.0).reshape(4, 3))


def test_alone_one_robot_of_either_modality_is_where_everything_is():
    found = resets(alone=1.0)
    works = np.asarray(found.team.works)
    np.testing.assert_array_equal(works.sum(axis=1), 1)
    np.testing.assert_allclose(works.mean(axis=0), [0.5, 0, 0.5, 0], atol=0.082)
    np.testing.assert_array_equal(found.agent, works.argmax(axis=1))
    np.testing.assert_array_equal(found.team.positions, 0.0)
    np.testing.assert_array_equal(found.team.poses, 0.0)
    # Any share of the six looks is taken. The share's variance is 1/12, and that of the mean of six
    # coins of that share 1/6 of 1/6 on average: 1/9 in all.
    shares = np.mean(found.seen, axis=(1, 2))
    np.testing.assert_allclose(shares.mean(), 1 / 2, atol=4 / 3 / np.sqrt(600))
    # Each number of looks is as likely as any other: 600 / 7 +- 4 sqrt(600 x 6/49) = +- 34.
    np.testing.assert_allclose(np.bincount(np.rint(6 * shares).astype(int)), 600 / 7, atol=34)


def test_shares_of_episodes_alone_and_partly_seen():
    found = resets(alone=0.25, partly_seen=0.5)
    alone = np.asarray(found.team.works).sum(axis=1) == 1
    np.testing.assert_allclose(alone.mean(), 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 600))
    # Of the others half start late, in which 1 of 7 has seen nothing all the same.
    has_seen = np.asarray(found.seen).any(axis=(1, 2))[~alone]
    np.testing.assert_allclose(has_seen.mean(), 0.5 * 6 / 7, atol=4 * 0.5 / np.sqrt(450))
    assert not np.any(resets(alone=0.0, partly_seen=0.0).seen)
    late = np.asarray(resets(alone=0.0, partly_seen=1.0).seen)
    assert late.any(axis=(1, 2)).mean() > 0.7


def test_two_robots_as_worked_by_hand():
    begun = start([[0, 0, 0], [0, 0, math.pi / 2]], [CAMERA, LIDAR])
    # Robot 0 takes PoI 0, 6 s away; robot 1 PoI 1, 11 s away; then robot 0 has enough.
    states, outcomes = play(begun, 0, 1, NOP, NOP)
    np.testing.assert_allclose([o.seconds for o in outcomes], [0, 6, 5, 0], atol=1e-5)
    np.testing.assert_allclose([s.seconds for s in states], [0, 6, 11, 11], atol=1e-5)
    np.testing.assert_allclose([o.reward for o in outcomes], [0, FIRST, FIRST, 0], atol=1e-6)
    assert [int(s.agent) for s in states[:3]] == [1, 0, 1]
    assert [bool(o.terminated) for o in outcomes] == [False, False, False, True]
    assert not any(o.truncated for o in outcomes)
    # At first nobody has moved; after 6 s robot 1 has driven 1.2 m; then robot 0 stays.
    expected = [
        [[0, 0, 0], [0, 0, np.pi / 2]],
        [[1, 0, 0], [0, 1.2, np.pi / 2]],
        [[1, 0, 0], [0, 2, np.pi / 2]],
    ]
    for state, poses in zip(states[:3], expected, strict=True):
        np.testing.assert_allclose(state.team.poses, poses, atol=1e-5)
    np.testing.assert_array_equal(states[0].team.target, [0, NOP])
    np.testing.assert_array_equal(states[1].team.target, [NOP, 1])
    np.testing.assert_array_equal(states[2].team.works, [False, True])
    np.testing.assert_array_equal(states[1].seen, [[1, 0], [0, 0], [0, 0]])
    np.testing.assert_array_equal(states[2].seen, [[1, 0], [0, 1], [0, 0]])


def test_robots_look_side_by_side():
    # All three are near enough: each look takes 1 s, and there is one of each robot in every one.
    here = jnp.zeros((3, 2))
    begun = start([[0, 0, 0]] * 3, [CAMERA, LIDAR, CAMERA], places=here)
    states, _ = play(begun, 0, 1, 2, 0, 1, 2)
    # The third choice lets time pass, and from then on every choice one look.
    np.testing.assert_allclose([s.seconds for s in states], [0, 0, 1, 1, 1, 2], atol=1e-5)
    assert [int(s.agent) for s in states] == [1, 2, 0, 1, 2, 0]


@pytest.mark.parametrize("anew", [False, True])
def test_a_look_that_has_begun_goes_on_while_others_look(anew):
    # Robot 1 is in place after 5.4 s and robot 0 looks at 6 s: .4 s are left, and it is not asked.
    poses = [[0, 0, 0], [0, 0.08, math.pi / 2]]
    places = jnp.array([[1.9, 0.0], [0.0, 2.06], [-3.9, 0.0]])
    begun = start(poses, [CAMERA, LIDAR], places=places)
    states, outcomes = play(begun, 0, 1, 0, NOP, mdp=ANEW if anew else MDP)
    # (2.06 - .08 - .9) / .2 = 5.4 s and 1 s of looking.
    np.testing.assert_allclose([o.seconds for o in outcomes[:3]], [0, 6, 0.4], atol=1e-4)
    assert [int(s.agent) for s in states] == [1, 0, 1, 0]


def test_robots_on_their_way_choose_anew_after_a_look():
    begun = start([[0, 0, 0], [0, 0, math.pi / 2]], [CAMERA, LIDAR])
    # Robot 0 looks after 6 s; robot 1, which has driven 1.2 m, may go on, for 5 s, or turn round.
    (*_, goes_on), outcomes = play(begun, 0, 1, NOP, 1, mdp=ANEW)
    np.testing.assert_allclose([o.seconds for o in outcomes], [0, 6, 0, 5], atol=1e-5)
    assert goes_on.seen[1, LIDAR]
    assert goes_on.asks.tolist() == [False, True]  # robot 0 has ended
    last = play(begun, 2, 1, mdp=ANEW)[0][-1]  # whoever has looked chooses first
    assert (int(last.agent), last.asks.tolist()) == (1, [True, True])
    states, _ = play(begun, 0, 1, NOP, 0, mdp=ANEW)
    assert [int(s.agent) for s in states] == [1, 0, 1, 1]
    assert states[3].seen[0, LIDAR]


def test_first_choices_go_round_the_robots_that_work():
    begun = start([[0, 0, 0]] * 4, [0, 0, 1, 1], works=[True, False, True, True])
    states, outcomes = play(begun, 2, 2, 0)
    assert [int(s.agent) for s in states] == [2, 3, 3]
    # The third choice is of PoI 0, 6 s away: robot 3 looks first.
    np.testing.assert_allclose([o.seconds for o in outcomes], [0, 0, 6], atol=1e-5)
    np.testing.assert_array_equal(states[2].team.poses[1], 0.0)  # that one takes no part
    assert states[2].seen[0, LIDAR]


def test_pois_are_anywhere_in_cells_of_their_own_and_robots_anywhere():
    places = Places(TeamConfig(num_pois=(2, 2), sides=(2.0, 4.0)), poi_pitch=0.6)
    keys = jax.random.split(jax.random.key(0), 4000)
    positions, poses = jax.jit(jax.vmap(lambda key: places.draw(key, 2)))(keys)
    # Two cells along sides of 2 to 4 m: each 1 to 2 m, of which a PoI keeps .3 m from either end.
    for x in (positions, -positions):
        assert 1.6 < x.max() < 1.7
    assert 0.3 < jnp.abs(positions).min() < 0.31
    assert jnp.linalg.norm(positions[:, 0] - positions[:, 1], axis=-1).min() > 0.6
    for x in (poses, -poses):
        np.testing.assert_allclose(x.max(axis=(0, 1)), [1.9, 1.9, jnp.pi], rtol=0.05)
    assert jnp.abs(poses[..., :2]).max() < 1.9


@pytest.mark.parametrize("modality", [CAMERA, LIDAR])
@pytest.mark.parametrize("mapped", [classes_mdp(partly_seen_starts=False), noisy_mdp()])
def test_a_robot_alone_earns_what_the_map_mdp_gives(mapped, modality):
    mapped = mapped.of(modality)
    # Of two robots, so that all sensors look.
    known = team = reset(jax.random.key(4), mapped)
    mdp = make_mdp(mapped)
    for i, action in enumerate([0, 2, 2, 1, NOP]):
        given = jax.random.key(10 + i), jnp.int32(action)
        team, here = jitted(given[0], mdp, team, given[1])
        known, there = jitted(given[0], mapped, known, given[1])
        np.testing.assert_allclose(here.reward, there.reward, rtol=1e-6)
        assert here.terminated == there.terminated
        assert float(here.seconds) == (0 if action == NOP else 1)
        for name in ("belief", "seen", "classes", "scene", "steps"):
            jax.tree.map(np.testing.assert_array_equal, getattr(team, name), getattr(known, name))


def test_an_episode_of_a_given_team_has_these_robots_and_no_other():
    mdp = make_mdp(robots=(1, 0, 1, 1), alone=1.0, is_random=False)
    state = reset(jax.random.key(0), mdp)
    np.testing.assert_array_equal(state.team.modality, [1, 0, 1, 1])
    np.testing.assert_array_equal(state.team.works, True)
    np.testing.assert_array_equal(state.asks, True)
    # It is never alone.
    np.testing.assert_array_equal(state.team.positions, PLACES)
    with pytest.raises(ValueError, match="robots = 2: must be a whole number from 0 to 1"):
        starts.reset(jax.random.key(0), make_mdp(robots=(0, 2, 0, 0)))


def test_the_only_robot_of_a_team_may_have_any_sensor():
    mdp = team_mdp_of(classes_mdp(), Fixed(PLACES, jnp.zeros((1, 3)))).of(LIDAR)
    state = reset(jax.random.key(0), mdp)
    np.testing.assert_array_equal(state.team.modality, [LIDAR])
    np.testing.assert_array_equal(state.team.works, [True])


def test_a_state_of_another_mdp_is_refused():
    state = reset(jax.random.key(0), classes_mdp(num_pois=2))
    with pytest.raises(ValueError, match=r"state.seen has the shape \(2, 2\): must be \(3, 2\)"):
        mdps.step(jax.random.key(0), MDP, state, jnp.int32(0))


seconds_of_way = jax.jit(Travel.seconds)
move = jax.jit(Travel.move)


@pytest.mark.parametrize(
    ("pose", "place", "seconds"),
    [
        # A quarter turn at 1 rad/s, 2 - .9 m at .2 m/s, and the look.
        ((0, 0, 0), (0, 2), math.pi / 2 + 5.5 + 1),
        ((0, 0, 0), (0, -2), math.pi / 2 + 5.5 + 1),
        # From (1, 1) to (1, 3), from which the robot looks away by .5 rad.
        ((1, 1, math.pi / 2 - 0.5), (1, 3), 0.5 + 5.5 + 1),
        # The short way around: from 3 to -3 rad, 2 pi - 6.
        ((0, 0, 3.0), (-2 * math.cos(0.14159265), -2 * math.sin(0.14159265)), 0.28319 + 5.5 + 1),
        # A heading of two turns too many.
        ((0, 0, 4 * math.pi), (2, 0), 5.5 + 1),
        # Near enough: only turning and looking.
        ((0, 0, 0), (0, 0.8), math.pi / 2 + 1),
        # All at one place: only looking, whatever the heading.
        ((1, 2, 0.7), (1, 2), 1.0),
    ],
)
def test_time_until_a_look_as_worked_by_hand(pose, place, seconds):
    pose, place = jnp.array(pose, jnp.float32), jnp.array(place, jnp.float32)
    np.testing.assert_allclose(seconds_of_way(TRAVEL, pose, place), seconds, rtol=1e-4)


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.0, (0, 0, 0)),
        (0.5, (0, 0, 0.5)),  # still turning, to the left
        (math.pi / 2 + 2, (0, 0.4, math.pi / 2)),  # and 2 s of driving at .2 m/s
        (math.pi / 2 + 5.5, (0, 1.1, math.pi / 2)),
        (99.0, (0, 1.1, math.pi / 2)),  # it waits there
    ],
)
def test_the_pose_on_the_way_as_worked_by_hand(seconds, expected):
    moved = move(TRAVEL, jnp.zeros(3), jnp.array([0.0, 2.0]), jnp.float32(seconds))
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    mirrored = move(TRAVEL, jnp.zeros(3), jnp.array([0.0, -2.0]), jnp.float32(seconds))
    np.testing.assert_allclose(mirrored, np.array(expected) * (1, -1, -1), atol=1e-6)


@jax.jit
def in_two_parts(pose, place, share):
    """The time of a way in one part; in two; and the pose at its end, in one and in two."""
    whole = TRAVEL.seconds(pose, place)
    before = share * (whole - TRAVEL.look_seconds)
    between = TRAVEL.move(pose, place, before)
    rest = TRAVEL.seconds(between, place)
    end = TRAVEL.move(pose, place, whole)
    return whole, before + rest, end, TRAVEL.move(between, place, rest)


PLACE = st.floats(-3, 3, width=32)


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(st.tuples(PLACE, PLACE, PLACE), st.tuples(PLACE, PLACE), st.floats(0, 1, width=32))
def test_a_way_in_two_parts_takes_as_long_as_in_one(pose, place, share):
    numbers = (np.float32(x) for x in (pose, place, share))
    one, two, end, end_of_two = in_two_parts(*numbers)
    np.testing.assert_allclose(one, two, atol=1e-3)
    np.testing.assert_allclose(end[:2], end_of_two[:2], atol=1e-3)
    # A heading counts only up to full turns.
    np.testing.assert_allclose(np.exp(1j * end[2]), np.exp(1j * end_of_two[2]), atol=2e-3)

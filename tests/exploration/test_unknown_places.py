"""Missions in unknown places: what robots may do, what they find, and what they may know."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxsense import ConfigError, exploration, load_pretrained, mission
from jaxsense.exploration import decide, proposals, rollout, sensing, slots
from jaxsense.mission.roadmap import require_known_places

CONFIG, MODELS = load_pretrained("default")


def among_walls(config, **changes):
    given = {"side": 5.0, "num_pois": 5, "fewest_pois": 3, "inner_walls": 2, **changes}
    return dataclasses.replace(config, arena=dataclasses.replace(config.arena, **given))


HIDDEN = among_walls(CONFIG)
MISSION = mission.make_mission(HIDDEN)
ERRORS = {"error": (0.02, 1.0), "drift": (0.005, 0.2)}
NOTHING = HIDDEN.arena.num_pois + 4 + 12


@pytest.fixture(scope="module")
def begun():
    return jax.jit(exploration.reset, static_argnums=1)(jax.random.key(3), MISSION, MODELS)


@pytest.fixture(scope="module")
def told(begun):
    return exploration.told(MISSION, begun)


@pytest.fixture(scope="module")
def scanned(begun):
    """After three scans of each robot."""
    sense = jax.jit(sensing.sense, static_argnums=1)
    for seed in range(1, 4):
        begun = sense(jax.random.key(seed), MISSION, MODELS, begun)
    return begun


def test_robots_start_apart_from_everything_on_an_empty_map(begun):
    layout, poses = begun.scene.layout, begun.scene.poses
    apart = jnp.linalg.norm(poses[:, None, :2] - layout.position[None], axis=-1)
    assert jnp.min(apart) > 0.35 + HIDDEN.arena.poi_radius
    assert 0.35 < jnp.linalg.norm(poses[0, :2] - poses[1, :2]) < 1.5  # put down together
    assert not jnp.any(begun.slots.is_used)
    assert not jnp.any(begun.grid.evidence)


def test_who_is_told_everything_knows_walls_and_pois_as_they_are(begun, told):
    layout, known = begun.scene.layout, slots.found(told.slots)
    np.testing.assert_array_equal(known[: len(layout.present)], layout.present)
    assert jnp.sum(known) == jnp.sum(layout.present)
    places = told.slots.position[: len(layout.present)]
    np.testing.assert_array_equal(places[layout.present], layout.position[layout.present])
    # The middle of each wall is occupied, a place half a metre beside it is not.
    for x, y, yaw, half in np.asarray(layout.walls):
        beside = jnp.array([x - 0.4 * np.sin(yaw), y + 0.4 * np.cos(yaw)])
        assert half > 0
        assert told.grid.at(told.grid.occupied, jnp.array([x, y]))
        assert not told.grid.at(told.grid.occupied, beside)


def options(state):
    return jax.jit(decide.options_of, static_argnums=0)(MISSION, MODELS, state, 0)


def test_a_robot_that_knows_all_may_look_at_each_poi_and_explores_nothing(told):
    (known, goals), number = options(told), len(told.slots.existence)
    present = jnp.pad(told.scene.layout.present, (0, 4))
    np.testing.assert_array_equal(known.team.present[:number], present)
    assert not jnp.any(known.team.present[number:])
    for slot in np.flatnonzero(present):
        to_poi = told.slots.position[slot] - goals[slot, :2]
        distance = float(jnp.linalg.norm(to_poi))
        assert HIDDEN.viewpoint.min_distance <= distance <= HIDDEN.navigation.view_range + 1e-5
        assert jnp.arctan2(to_poi[1], to_poi[0]) == pytest.approx(float(goals[slot, 2]))
        # As fast as a robot drives, no path is shorter than the straight line.
        straight = jnp.linalg.norm(goals[slot, :2] - told.scene.poses[0, :2])
        assert known.times[0, slot] >= 5 * straight
    np.testing.assert_array_equal(known.exists[:number], 1)
    # The other robot has yet to choose, and heads for nothing.
    assert not jnp.any(known.team.heads)


def pays(state, slot):
    known = options(state)[0]
    return exploration.POLICIES["nearest"](jax.random.key(0), MODELS, known)[slot] > 0


def test_looks_that_failed_or_tell_nothing_are_not_worth_going_for(told):
    slot = int(jnp.argmax(told.scene.layout.present))
    failed = dataclasses.replace(told, failures=told.failures.at[slot].set(3))
    assert pays(told, slot)
    assert not options(failed)[0].team.present[slot]
    classes = MODELS.fusion.classes
    belief = jax.tree.map(lambda rows, x: rows.at[slot].set(x[0]), told.slots.belief, classes)
    seen = told.slots.times_seen.at[slot].set(1)
    certain = dataclasses.replace(told.slots, belief=belief, times_seen=seen)
    assert not pays(dataclasses.replace(told, slots=certain), slot)


def test_frontiers_are_pois_that_may_be_there_and_another_robot_heads_for(scanned):
    number, arena = len(scanned.slots.existence), HIDDEN.arena
    known, goals = options(scanned)
    first = number + int(jnp.argmax(known.team.present[number:]))
    # Three to five PoIs on 25 m2; a camera sees less at once than a LiDAR.
    assert arena.density == pytest.approx(4 / 25)
    assert 0 < known.exists[first] < -jnp.expm1(-arena.density * jnp.pi * 0.75**2)
    np.testing.assert_array_equal(known.belief.std[first], MODELS.fusion.prior.std)
    beside = goals[first] + jnp.array([0.5, 0.0, 0.0])
    headed = scanned.with_robot(1, target=jnp.int32(number), goal=beside)
    assert options(headed)[0].team.target[1] == first
    away = headed.with_robot(1, goal=goals[first] + jnp.array([9.0, 0.0, 0.0]))
    assert options(away)[0].team.target[1] == NOTHING


def test_rules_choose_by_hand_worked_numbers(told):
    # A look after 9 s; frontiers after 10, 19 and 1 s, where a PoI is by chance .1, .4 and .9.
    known, place = options(told)[0], jnp.arange(NOTHING)
    chosen = dataclasses.replace(
        known,
        belief=jax.tree.map(lambda x: jnp.tile(x, (NOTHING, 1)), MODELS.fusion.prior),
        team=dataclasses.replace(known.team, present=place < 3, works=jnp.ones(2, bool)),
        times=jnp.zeros((2, NOTHING)).at[:, :4].set(jnp.array([9.0, 10.0, 19.0, 1.0])),
        exists=jnp.ones(NOTHING).at[1:4].set(jnp.array([0.1, 0.4, 0.9])),
    )

    def of(name, known):
        values = exploration.POLICIES[name](jax.random.key(0), MODELS, known)
        return int(decide.action_of(values, known))

    rules = [name for name in exploration.POLICIES if name != "latent"]
    # A second: 1 / 9, 6 * .1 ** .5 / 10 = .19 and 6 * .4 ** .5 / 19 = .2.
    expected = {"explore_first": 1, "look_first": 0, "nearest": 0, "auction": 0, "gain_rate": 2}
    assert {name: of(name, chosen) for name in rules} == expected
    likely = dataclasses.replace(chosen, exists=chosen.exists.at[1].set(0.2))
    assert of("gain_rate", likely) == 1

    def taken(poi):
        team = dataclasses.replace(chosen.team, target=jnp.array([NOTHING, poi]))
        return dataclasses.replace(chosen, team=team)

    assert (of("nearest", taken(0)), of("gain_rate", taken(2))) == (1, 1)
    # The other robot carries another sensor, so it takes no look away.
    near = dataclasses.replace(taken(0), times=chosen.times.at[:, 0].set(1.0))
    assert of("gain_rate", near) == 0
    nothing = dataclasses.replace(
        chosen, team=dataclasses.replace(chosen.team, present=jnp.zeros(NOTHING, bool))
    )
    assert {of(name, nothing) for name in exploration.POLICIES} == {NOTHING}


def test_the_network_alone_chooses_looks_and_frontiers(scanned):
    """Other parameters, other choices: the network's highest value among those that exist."""
    (known, _), choices = options(scanned), []
    for seed in range(8):
        flat, of_flat = ravel_pytree(MODELS.q_networks)
        params = of_flat(jax.random.normal(jax.random.key(seed), flat.shape))
        models = dataclasses.replace(MODELS, q_networks=params)
        policy = exploration.POLICIES["latent"]
        chosen = decide.choose(jax.random.key(0), MISSION, models, policy, scanned, 0)
        agent, present = models.agent, np.append(known.team.present, True)
        observed = agent.observe(known.belief, known.team, known.times, known.robot)
        of_pois = agent.values(params[int(known.modality) * (len(params) > 1)], observed)
        values = np.append(known.exists * of_pois[:-1], 0.0)
        choices.append(int(chosen.robots.target[0]))
        assert choices[-1] == np.argmax(np.where(present, values, -np.inf))
    assert len({*choices}) > 1


def test_a_network_without_numbers_chooses_nothing(scanned):
    broken = jax.tree.map(lambda x: x * jnp.nan, MODELS.q_networks)
    models, policy = dataclasses.replace(MODELS, q_networks=broken), exploration.POLICIES["latent"]
    chosen = decide.choose(jax.random.key(0), MISSION, models, policy, scanned, 0)
    assert chosen.robots.target[0] == NOTHING
    np.testing.assert_array_equal(chosen.robots.goal[0], scanned.scene.poses[0])


def test_a_sensor_that_finds_nothing_explores_nothing(scanned, monkeypatch):
    number = len(scanned.slots.existence)
    assert jnp.any(options(scanned)[0].team.present[number:])
    monkeypatch.setattr(decide, "_shares", lambda mission: jnp.zeros(2))
    known, _ = decide.options_of(MISSION, MODELS, scanned, 0)
    assert not jnp.any(known.team.present[number:])


def test_a_robot_that_errs_looks_where_its_scan_shows_the_object(told):
    slot = int(jnp.argmax(told.scene.layout.present))
    place = decide.options_of(MISSION, MODELS, told, 1)[1][slot]
    sideways = jnp.array([-jnp.sin(place[2]), jnp.cos(place[2]), 0.0])
    believed = place + 0.15 * sideways  # ten degrees and more, seen from the object
    there = stood(told, told.scene.poses[0], place).with_robot(
        1, target=jnp.int32(slot), goal=believed
    )
    there = dataclasses.replace(there, pose_error=jnp.stack([jnp.zeros(3), believed - place]))
    sense = jax.jit(sensing.sense, static_argnums=1)
    after = sense(jax.random.key(1), MISSION, MODELS, there)
    assert after.slots.times_seen[slot, 1] == 1
    labels = np.array(HIDDEN.label_of_class("lidar"))
    shown = MODELS.fusion.class_probabilities(jax.tree.map(lambda x: x[slot], after.slots.belief))
    assert labels[jnp.argmax(shown)] == labels[told.classes[slot]]


def test_scans_show_floor_and_the_pois_in_view(begun, scanned):
    after = scanned
    assert jnp.sum(after.grid.free) > 100
    used = np.flatnonzero(after.slots.is_used)
    places = np.asarray(begun.scene.layout.position)
    for slot in used:
        apart = np.linalg.norm(places - np.asarray(after.slots.position[slot]), axis=-1)
        assert apart.min() < 4 * np.sqrt(np.trace(after.slots.covariance[slot]))
    # What is free is no wall.
    walls = exploration.told(MISSION, begun).grid.occupied
    assert jnp.sum(after.grid.free & walls) <= 0.01 * jnp.sum(walls)


def test_a_robot_that_errs_notes_places_where_it_believes_to_see_them(begun, scanned):
    """All is off by its error alone, and what it sees and looks at is the same."""
    error = jnp.array([0.3, 0.15, 0.0])
    wrong = dataclasses.replace(begun, pose_error=jnp.tile(error, (2, 1)))
    sense = jax.jit(sensing.sense, static_argnums=1)
    for seed in range(1, 4):
        wrong = sense(jax.random.key(seed), MISSION, MODELS, wrong)
    used = np.asarray(scanned.slots.is_used & wrong.slots.is_used)
    assert used.sum() > 1
    off = (wrong.slots.position - scanned.slots.position)[used]
    np.testing.assert_allclose(off, np.tile(error[:2], (used.sum(), 1)), atol=0.02)
    # Two cells along x and one along y.
    moved = np.asarray(wrong.grid.free)[2:, 1:] == np.asarray(scanned.grid.free)[:-2, :-1]
    assert moved.mean() > 0.97


def stood(state, *poses):
    """The state with robots at these poses."""
    scene = dataclasses.replace(state.scene, poses=jnp.array(poses))
    return dataclasses.replace(state, scene=scene)


@pytest.fixture(scope="module")
def open_floor(told):
    """Three objects, 1 m, 2 m and .5 m from the origin, on floor that is all known and free."""
    places = jnp.array([[1.0, 0.0], [2.0, 0.1], [0.0, 0.5]])
    used = jnp.arange(len(told.slots.is_used)) < 3
    position = told.slots.position.at[:3].set(places)
    known = dataclasses.replace(told.slots, is_used=used, position=position)
    floor = dataclasses.replace(told.grid, evidence=jnp.full_like(told.grid.evidence, -4))
    return dataclasses.replace(told, slots=known, grid=floor)


def test_bodies_and_unknown_floor_hide_objects(open_floor):
    sight = jax.jit(sensing._in_sight, static_argnums=(0, 2))
    away, between = (-2.0, -2.0, 0.0), (0.5, 0.0, 0.0)
    seen = sight(MISSION, stood(open_floor, (0.0, 0.0, 0.0), away), 0)[:3]
    np.testing.assert_array_equal(seen, [True, False, True])  # the second is behind the first
    seen = sight(MISSION, stood(open_floor, (0.0, 0.0, 0.0), between), 0)[:3]
    np.testing.assert_array_equal(seen, [False, False, True])
    # Floor at x = .6 that nobody has seen.
    column = int((0.6 + 2.5) / open_floor.grid.cell)
    evidence = open_floor.grid.evidence.at[column].set(0)
    unknown = dataclasses.replace(
        open_floor, grid=dataclasses.replace(open_floor.grid, evidence=evidence)
    )
    seen = sight(MISSION, stood(unknown, (0.0, 0.0, 0.0), away), 0)[:3]
    np.testing.assert_array_equal(seen, [False, False, True])


def test_a_robot_that_does_not_get_nearer_backs_off_and_gives_a_frontier_up(open_floor):
    progressed = jax.jit(rollout._progressed, static_argnums=(0, 2))
    explores = len(open_floor.slots.is_used)  # the first frontier
    grid = open_floor.grid
    late = dataclasses.replace(open_floor, steps=jnp.int32(60)).with_robot(
        0,
        target=explores,
        goal=jnp.array([1.5, 1.5, 0.0]),
        left=1.0,
        progress_at=0.0,
        reconsiders=False,
    )
    at = lambda length: late.with_robot(0, way=jnp.full_like(late.robots.way[0], length))  # noqa: E731
    nearer, stuck = progressed(MISSION, at(0.9), 0), progressed(MISSION, at(0.97), 0)
    assert nearer.robots.left[0] == pytest.approx(0.9)
    assert not nearer.robots.reconsiders[0]
    assert not jnp.any(nearer.grid.given_up)
    # 6.0 s without 5 cm of progress.
    assert stuck.robots.reconsiders[0]
    assert stuck.robots.backs_off_until[0] > 6.5
    given_up = np.pi * 0.5**2 / grid.cell**2
    assert jnp.sum(stuck.grid.given_up[0]) == pytest.approx(given_up, rel=0.1)
    assert not jnp.any(stuck.grid.given_up[1])
    np.testing.assert_array_equal(stuck.grid.seen, grid.seen)


def test_a_viewpoint_out_of_reach_is_one_of_a_failed_look(open_floor):
    way = jnp.full_like(open_floor.robots.way[0], 1.0)
    goal = jnp.array([1.0, 0.5, 0.0])
    late = dataclasses.replace(open_floor, steps=jnp.int32(60)).with_robot(
        1, target=2, goal=goal, left=1.0, progress_at=0.0, way=way
    )
    stuck = jax.jit(rollout._progressed, static_argnums=(0, 2))(MISSION, late, 1)
    assert stuck.failures[2, 1] == 1
    assert jnp.sum(stuck.failures) == 1
    np.testing.assert_array_equal(stuck.failed_from[2, 1, 0], goal[:2])
    assert not jnp.any(stuck.grid.given_up)


def test_only_beams_that_pass_its_place_refute_an_object(open_floor):
    expected = jax.jit(sensing._expected, static_argnums=(0, 2, 4))
    lidar = MISSION.world.sensors[1]
    state = stood(open_floor, (-2.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    ahead = np.abs(lidar.angles) < 0.01
    at_object, passing = (jnp.where(ahead, x, 4.0) for x in (0.9, 4.0))
    found = expected(MISSION, state, lidar, passing, 1)
    np.testing.assert_array_equal(found[:3], [True, False, True])  # one is hidden
    found = expected(MISSION, state, lidar, at_object, 1)
    np.testing.assert_array_equal(found[:3], [False, False, True])
    # A wide body at a rim, 0.36 m away, reaches out of the scan by 1.5 degrees, on both sides.
    wide = mission.make_mission(among_walls(CONFIG, poi_radius=0.15))
    place = open_floor.slots.position.at[0].set(jnp.array([0.36, 0.0]))
    slots_there = dataclasses.replace(open_floor.slots, position=place)
    near = dataclasses.replace(open_floor, slots=slots_there)
    for sign in (-1, 1):
        turn = sign * np.radians(lidar.field_of_view / 2 - 10.5)
        near = stood(near, (-2.0, -2.0, 0.0), (0.0, 0.0, turn))
        assert not expected(wide, near, lidar, passing, 1)[0]


def test_robots_explore_by_what_their_sensors_see_at_once():
    # 240 degrees up to the 5 m of its range, 80 degrees up to 2 m.
    lidar, camera = (proposals.reach(MISSION.world.sensors[m], 0.1) for m in (1, 0))
    assert (lidar, camera) == (5.0, 2.0)
    shares = decide._shares(MISSION)
    np.testing.assert_allclose(shares, [80 * 2**2 / (240 * 5**2), 1.0], rtol=2e-3)
    # Five beams of 240 / 682 degrees on a body of 6 cm.
    narrow = proposals.reach(MISSION.world.sensors[1], 0.03)
    assert narrow == pytest.approx(0.06 / (5 * np.radians(240 / 682)), rel=1e-4)


def test_places_are_either_known_or_found(begun):
    with pytest.raises(ConfigError, match=r"arena.inner_walls = 2: must be 0 where places"):
        require_known_places(HIDDEN)
    with pytest.raises(ConfigError, match=r"arena.fewest_pois = 3"):
        mission.reset(
            jax.random.key(0), mission.make_mission(among_walls(CONFIG, inner_walls=0)), MODELS
        )
    blind = mission.make_mission(dataclasses.replace(HIDDEN, robots=("camera", "camera")))
    with pytest.raises(ConfigError, match="must include one whose sensor measures distances"):
        exploration.reset(jax.random.key(0), blind, MODELS)


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "errors"), [("nearest", {}), ("latent", ERRORS)])
def test_robots_find_all_pois_and_what_they_are(policy, errors):
    poses = dataclasses.replace(HIDDEN.mission.localisation, **errors)
    config = dataclasses.replace(HIDDEN.mission, localisation=poses)
    scenario = mission.make_mission(dataclasses.replace(HIDDEN, mission=config))
    keys, choose = jax.random.split(jax.random.key(21), (2, 8)), exploration.POLICIES[policy]

    @jax.jit
    def play(keys):
        begun = jax.vmap(lambda key: exploration.reset(key, scenario, MODELS))(keys[0])
        states = exploration.rollout_batch(keys[1], scenario, MODELS, choose, begun, 2400)
        found = jax.vmap(lambda state: exploration.measure(MODELS, state))(states)
        return begun, states, found

    begun, states, found = jax.tree.map(np.asarray, play(keys))
    present = found["present"].sum()
    assert found["found"].sum() >= present - 1
    assert found["false"].sum() <= 2
    assert found["right"].sum() >= present - 2
    assert found["gospa"].position_error.max() < (0.2 if errors else 0.05)
    assert found["collisions"].sum() == 0
    assert states.done.mean() >= 0.75
    assert np.all((states.pose_error != begun.pose_error) == bool(errors))

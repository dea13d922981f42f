from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense import sim
from jaxsense.config import Config
from jaxsense.config.scene import CLEARANCE, ArenaConfig, ViewpointConfig
from jaxsense.sim import viewpoints
from jaxsense.sim import world as worlds

CLASSES = jnp.array([0, 1, 2])  # green cylinder, red cylinder, red cube
NUM_LOOKS = 16
# Viewpoints need no more of a world.
WORLD = SimpleNamespace(viewpoint=ViewpointConfig(), arena=SimpleNamespace(config=ArenaConfig()))


@pytest.fixture(scope="module")
def draws():
    """Viewpoints in random layouts with another robot anywhere: layout, other, poi, pose."""

    def draw(key):
        layout_key, other_key, poi_key, key = jax.random.split(key, 4)
        layout = sim.random_layout(layout_key, ArenaConfig(), CLASSES)
        other = jax.random.uniform(other_key, (1, 2), minval=-1.3, maxval=1.3)
        poi = jax.random.randint(poi_key, (), 0, 3)
        pose, bearing = worlds.random_viewpoint(key, WORLD, layout, other, poi)
        return layout.position, other[0], poi, pose, bearing

    drawn = jax.device_get(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 3000)))
    # The other robot stands free of the PoIs, which reach 0.141421, with its radius of 0.0495.
    from_pois = np.linalg.norm(drawn[0] - drawn[1][:, None], axis=-1).min(axis=-1)
    return [x[from_pois > 0.141421 + 0.0495 + 0.03] for x in drawn]


def test_viewpoints_face_the_poi_in_range(draws):
    position, _, poi, pose, believed = draws
    to_poi = position[range(len(poi)), poi] - pose[:, :2]
    distance = np.linalg.norm(to_poi, axis=-1)
    assert 0.3 - 1e-5 <= distance.min() < 0.35
    assert 1.0 < distance.max() <= 1.2 + 1e-5
    bearing = np.arctan2(to_poi[:, 1], to_poi[:, 0]) - pose[:, 2]
    bearing = np.degrees((bearing + np.pi) % (2 * np.pi) - np.pi)
    assert -20.01 <= bearing.min() < -19
    assert 19 < bearing.max() <= 20.01
    error = np.degrees(believed) - bearing
    assert -1.01 <= error.min() < -0.9
    assert 0.9 < error.max() <= 1.01
    # Of one another, they tell nothing.
    assert np.abs(np.corrcoef([distance, bearing, error]) - np.eye(3)).max() < 0.1


def test_viewpoints_are_free_and_see_the_whole_poi(draws):
    position, other, poi, pose, _ = draws
    # Corners of a cube are 0.141421 from its centre, a robot's radius is 0.0495.
    obstacles = np.concatenate([position, other[:, None]], axis=1)
    radius = np.tile([0.141421, 0.141421, 0.141421, 0.0495], (len(poi), 1))
    target = position[range(len(poi)), poi]
    radius[range(len(poi)), poi] = -np.inf
    here = pose[:, :2]
    stands = np.abs(here).max(axis=-1) < 1.5 - 0.0495
    stands &= (np.linalg.norm(obstacles - here[:, None], axis=-1) > radius + 0.0495).all(axis=-1)
    # Points along lines to the middle and both flanks of the PoI are in no other object.
    view = target - here
    flank = np.stack([-view[:, 1], view[:, 0]], -1) / np.linalg.norm(view, axis=-1)[:, None]
    sees = np.ones(len(poi), bool)
    for side in (-0.1414, 0.0, 0.1414):
        for share in np.linspace(0.02, 1.0, 60):
            point = here + share * (view + side * flank)
            away = np.linalg.norm(obstacles - point[:, None], axis=-1)
            sees &= (away > radius - 1e-3).all(axis=-1)
    assert (stands & sees).mean() >= 0.995
    assert np.linalg.norm(target - here, axis=-1).min() > 0.141421 + 0.0495


@pytest.mark.parametrize(("above", "is_first"), [(0.5, True), (9.0, False)])
def test_the_first_free_viewpoint_is_taken_or_that_with_the_most_room(monkeypatch, above, is_first):
    rooms = []

    def free_room(x, *_):
        rooms.append(x - above)
        return rooms[-1]

    monkeypatch.setattr(viewpoints, "free_room", free_room)
    layout, nobody = SimpleNamespace(position=jnp.zeros((3, 2))), jnp.zeros((0, 2))
    pose, _ = worlds.random_viewpoint(jax.random.key(0), WORLD, layout, nobody, 0)
    first, most = np.argmax(rooms[0] > 0), np.argmax(rooms[0])
    assert 0 != first != most if is_first else first == 0 != most
    assert pose[0] == pytest.approx(float(rooms[0][first if is_first else most] + above), rel=1e-5)


@pytest.mark.parametrize("side", [1.0, 20.0])
def test_what_is_away_is_outside_of_the_walls(side):
    assert np.max(np.abs(viewpoints.outside(ArenaConfig(side=side, num_pois=1)))) > side


@jax.jit
def free_room(x, y, clearance, layout, others, poi):
    return viewpoints.free_room(x, y, clearance, ArenaConfig(), layout, others, poi)


def room(x, y, others, poi=0):
    """Room around a viewpoint among PoIs at (0, 0), (1, 0) and (-1, -1)."""
    position = jnp.array([[0.0, 0.0], [1.0, 0.0], [-1.0, -1.0]])
    layout = sim.make_layout(ArenaConfig(), position, jnp.zeros(3), CLASSES)
    place = jnp.array([x]), jnp.array([y])
    return float(free_room(*place, CLEARANCE, layout, jnp.array(others), jnp.int32(poi))[0])


def test_hand_worked_room_around_a_viewpoint():
    far = [[1.3, -1.3]]
    # A robot needs 0.0495 + 0.03 = 0.0795 m. At y = 1.35, the wall is 0.15 - 0.0795 away.
    assert room(0.0, 1.35, far) == pytest.approx(0.0705, abs=1e-5)
    # PoI 1 at (1, 0) from (0.6, 0): 0.4 - 0.141421 - 0.0795.
    assert room(0.6, 0.0, far) == pytest.approx(0.179079, abs=1e-5)
    # Another robot 0.15 behind: 0.15 - 0.0495 - 0.0795.
    assert room(0.0, 0.6, [[0.0, 0.75]]) == pytest.approx(0.021, abs=1e-5)
    # Another robot half way to the PoI and 0.2 beside the view, half as wide there:
    # 0.2 - 0.5 * 0.141421 - 0.0495.
    assert room(0.0, 1.0, [[0.2, 0.5]]) == pytest.approx(0.079789, abs=1e-5)
    # It stands in the view.
    assert room(0.0, 1.0, [[0.05, 0.5]]) < 0
    # PoI 0 hides PoI 1 from (-0.4, 0).
    assert room(-0.4, 0.0, far, poi=1) < 0


POSITIONS = jnp.array([[0.0, 0.0], [1.2, 1.2], [-1.2, 1.2]])
PLACE = jnp.array([0.6, 0.0])


@pytest.fixture(scope="module")
def moved():
    layout = sim.make_layout(ArenaConfig(), POSITIONS, np.zeros(3), np.zeros(3, np.int32))

    @jax.jit
    def draw(keys, distance, others):
        return jax.vmap(
            lambda key: worlds.moved_viewpoint(
                key, WORLD, layout, others, jnp.int32(0), PLACE, distance
            )
        )(keys)

    keys = jax.random.split(jax.random.key(0), 64)
    return lambda distance, others: draw(keys, jnp.float32(distance), jnp.array(others))


def test_second_viewpoints_are_at_the_distance_in_range_and_face_the_poi(moved):
    poses, believed = moved(0.4, [[1.4, -1.4]])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - PLACE[None]).T), 0.4, rtol=1e-5)
    to_poi = np.hypot(*poses[:, :2].T)
    assert np.all((to_poi >= 0.3) & (to_poi <= 1.2))
    assert np.ptp(np.arctan2(poses[:, 1], poses[:, 0] - 0.6)) > 1
    found = jax.vmap(lambda pose: viewpoints.bearing(pose, POSITIONS[0]))(poses)
    assert np.all(np.abs(found) <= np.radians(20) + 1e-5)
    # The robot knows the bearing to one degree.
    assert 0 < np.abs(found - believed).max() <= np.radians(1) + 1e-5


@pytest.fixture(scope="module")
def simulation():
    return sim.make_world(Config())


@pytest.fixture(scope="module")
def looks(simulation):
    """Scenes, and what each robot then sees of a PoI, with the scene after it."""

    scene_keys, *robot_keys = jax.random.split(jax.random.key(1), (3, NUM_LOOKS))
    pois = jnp.arange(NUM_LOOKS) % 3

    def each(function, *args):
        # A loop of singles compiles in half the time of a batch.
        results = [jax.device_get(jax.jit(function)(*one)) for one in zip(*args, strict=True)]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *results)

    scenes = each(lambda key: sim.random_scene(key, simulation, CLASSES), scene_keys)
    single = [jax.tree.map(lambda x, n=n: x[n], scenes) for n in range(NUM_LOOKS)]
    after = [
        each(lambda k, s, p, r=r: sim.look(k, simulation, s, r, p), keys, single, pois)
        for r, keys in enumerate(robot_keys)
    ]
    return np.array(pois), scenes, after


def test_look_is_centred_on_the_poi(looks):
    pois, before, (((pixels, _), _), ((ranges, expected), scene)) = looks
    red, green, _ = pixels.reshape(NUM_LOOKS, 80, 3)[:, 39:41].mean(axis=1).T
    np.testing.assert_array_equal(red > green, np.array(pois) > 0)
    # In the middle of the window is the near side of the PoI: 0.1 to 0.1414 before its centre, and
    # not much farther where the window's bearing is 1 degree off; three deviations of noise.
    target = before.layout.position[range(NUM_LOOKS), pois]
    distance = np.linalg.norm(target - scene.poses[:, 1, :2], axis=-1)
    np.testing.assert_allclose(expected, distance, rtol=1e-6)
    depth = distance - np.median(ranges[:, 62:66], axis=-1)
    assert depth.min() > 0.1 - 0.03
    assert depth.max() < 0.1415 + 0.03

"""The arena in MuJoCo-MJX: walls, robots, and PoIs whose classes are data.

Each PoI has one upright solid for every shape, each of them a mocap body; all but the one that it
shows are stored below the floor. Position and shape are thus part of the MJX state and colour is
part of the layout, so a new layout or class never recompiles anything. Neither do inner walls,
whose lengths are part of the layout, or fewer PoIs: what is absent stands far outside.
"""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx
from scipy.spatial.transform import Rotation

from jaxsense.config.scene import POI_HEIGHT, TIMESTEP, WALL_HEIGHT, WALL_THICKNESS, ArenaConfig
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.sim import amiro

_STORE = -2.0  # m, height of hidden shapes, below the floor
_AWAY = -1000.0  # m, x of absent PoIs and walls
_APART = 10.0  # m, between absent PoIs, so that a look at one shows no other
_SHORTEST, _LONGEST = 0.25, 0.55  # shares of the arena's side that inner walls are long
_PASSAGE = 0.6  # m, smallest gap between an inner wall and other walls
_NUM_CANDIDATES = 64  # places drawn for each inner wall


@pytree
class Layout:
    """PoIs of one arena; no field is static.

    Attributes:
      position: `[N, 2]` centres, in metres from the arena's centre; far outside of absent PoIs.
      yaw: `[N]` in radians.
      shape: `[N]` int32 index into the shapes of the settings.
      colour: `[N, 3]` albedo, linear RGB in [0, 1].
      values: `[N]` value of each attribute in the settings.
      walls: `[K, 4]` inner walls: x and y of the centre [m], yaw [rad] and half the length [m]; see
        `absent_walls` for those that are absent.
    """

    position: jax.Array
    yaw: jax.Array
    shape: jax.Array
    colour: jax.Array
    values: dict[str, jax.Array] = struct.field(default_factory=dict)
    walls: jax.Array | np.ndarray = struct.field(default_factory=lambda: absent_walls(0))

    @property
    def present(self) -> Bool[Array, "*B N"]:
        """Which PoIs are in the arena."""
        return self.position[..., 0] > _AWAY / 2


@dataclasses.dataclass(frozen=True, eq=False)
class Arena:
    """A compiled arena, shared by all its layouts. Static under `jit`, compared by identity.

    `build` returns the same one for equal settings.

    Attributes:
      config: the settings it was built from.
      mj_model: the model in C MuJoCo.
      model: the model in MJX.
      data: an MJX state for `place` to fill in.
      num_robots: R; they are named robot0, robot1 and so on.
    """

    config: ArenaConfig
    mj_model: mujoco.MjModel  # pyright: ignore[reportAttributeAccessIssue]
    model: mjx.Model
    data: mjx.Data
    num_robots: int

    @functools.cached_property
    def robot_of_geom(self) -> Int[np.ndarray, "G"]:
        """Index of the robot that each geom belongs to, or -1."""
        return np.maximum(self.mj_model.geom_bodyid - 1 - self.mj_model.nmocap, -1)

    @functools.cached_property
    def poi_of_geom(self) -> Int[np.ndarray, "G"]:
        """Index of the PoI that each geom belongs to, or -1."""
        body = self.mj_model.geom_bodyid - 1  # in the order of the MJCF: world, PoIs, inner walls
        num_bodies = self.mj_model.nmocap - self.config.inner_walls
        return np.where(body < num_bodies, body // len(self.config.shapes), -1)

    @functools.cached_property
    def inner_walls(self) -> Int[np.ndarray, "K"]:
        """Geom of each inner wall; none without obstacles."""
        first = max(self.mj_model.nmocap - self.config.inner_walls, 0)
        return np.flatnonzero(self.mj_model.body_mocapid[self.mj_model.geom_bodyid] >= first)

    @functools.cached_property
    def geom_axes(self) -> Float[np.ndarray, "G 3 3"]:
        """Rotation matrix of each geom in its body."""
        turns = Rotation.from_quat(self.mj_model.geom_quat, scalar_first=True)
        return turns.as_matrix().astype(np.float32)


@checks.typed
@functools.cache
def build(
    config: ArenaConfig,
    lidar_robots: tuple[bool, ...],
    *,
    contacts: bool = False,
    obstacles: bool = True,
) -> Arena:
    """Compiles an arena.

    Args:
      lidar_robots: for each robot, whether it carries a laser scanner, or another sensor on top.
      contacts: whether robots collide with PoIs, with each other and with the walls.
      obstacles: whether there are PoIs and walls.
    """
    import jinja2  # noqa: PLC0415  (whoever builds no arena need not wait for it)

    loader, undefined = jinja2.PackageLoader("jaxsense.sim", "."), jinja2.StrictUndefined
    mjcf = jinja2.Environment(loader=loader, undefined=undefined).get_template("arena.xml.jinja")
    mj_model = mujoco.MjModel.from_xml_string(  # pyright: ignore[reportAttributeAccessIssue]
        mjcf.render(
            amiro=amiro,
            config=config,
            lidar_robots=lidar_robots,
            contacts=contacts,
            obstacles=obstacles,
            timestep=TIMESTEP,
            poi_height=POI_HEIGHT,
            wall_height=WALL_HEIGHT,
            wall_thickness=WALL_THICKNESS,
        )
    )
    # By default MJX takes the first device of all processes.
    device = jax.local_devices()[0]
    with jax.ensure_compile_time_eval():  # it outlives a program that is being traced
        model = mjx.put_model(mj_model, device=device, impl="jax")
        data = mjx.make_data(model, device=device)
    return Arena(config, mj_model, model, data, len(lidar_robots))


@checks.typed
def make_layout(
    config: ArenaConfig,
    position: Float[Array, "N 2"],
    yaw: Float[Array, "N"],
    classes: Int[Array, "N"],
    walls: Float[Array | np.ndarray, "K 4"] | None = None,
) -> Layout:
    """Layout of PoIs and inner walls.

    Args:
      position: centres of the PoIs, in metres from the arena's centre.
      yaw: in radians.
      classes: index of each PoI's class in `config.classes`.
      walls: see `Layout`; absent by default.
    """
    walls = absent_walls(config.inner_walls) if walls is None else walls
    chex.assert_shape(walls, (config.inner_walls, 4))
    chex.assert_shape(position, (config.num_pois, 2))
    chex.assert_shape([yaw, classes], (config.num_pois,))
    checks.require_index("classes", classes, len(config.classes))
    shapes = jnp.array([list(config.shapes).index(w) for w in config.words("shape")], jnp.int32)
    colours = jnp.array(config.values("colour"))
    values = {name: jnp.array(config.values(name)) for name in config.attributes}
    of_pois = {name: numbers[classes] for name, numbers in values.items()}
    return Layout(position, yaw, shapes[classes], colours[classes], of_pois, walls)


def absent_walls(number: int) -> Float[np.ndarray, "K 4"]:
    """Walls without length, far outside."""
    return np.tile(np.array([_AWAY, 0.0, 0.0, 0.0], np.float32), (number, 1))


def random_layout(key: Key, config: ArenaConfig, classes: Int[Array, "N"]) -> Layout:
    """Draws a layout of PoIs of given classes, at least `poi_gap` apart, and of inner walls.

    The arena is divided into square cells, about twice as many as PoIs. Each PoI gets a cell of its
    own and a position that leaves half the gap free on every side. Where their number varies, the
    last ones may be absent. Inner walls keep `poi_gap` from PoIs and 0.6 m from all walls, so that
    they close nothing in.

    Args:
      classes: index of each PoI's class in `config.classes`.
    """
    checks.require_key(key)
    number_key = wall_key = key
    if config.fewest_pois or config.inner_walls:
        key, number_key, wall_key = jax.random.split(key, 3)
    per_side = min(
        int(np.ceil(np.sqrt(2 * config.num_pois))), int(np.floor(config.side / config.poi_pitch))
    )
    cell_side = config.side / per_side
    draws = jax.random.uniform(key, (per_side**2 + 3 * config.num_pois,))
    cell = jnp.argsort(draws[: per_side**2])[: config.num_pois]
    x, y, turn = draws[per_side**2 :].reshape(3, config.num_pois)
    corner = jnp.stack([cell // per_side, cell % per_side], axis=-1).astype(draws.dtype)
    play = (cell_side - config.poi_pitch) / 2
    offset = play * (2 * jnp.stack([x, y], axis=-1) - 1)
    yaw = jnp.pi * (2 * turn - 1)
    position = corner * cell_side - config.side / 2 + cell_side / 2 + offset
    if config.fewest_pois:
        index = jnp.arange(config.num_pois)
        number = jax.random.randint(number_key, (), config.fewest_pois, config.num_pois + 1)
        away = jnp.stack([jnp.full_like(yaw, _AWAY), _APART * index], axis=-1)
        position = jnp.where((index < number)[:, None], position, away)
    walls = _random_walls(wall_key, config, position) if config.inner_walls else None
    return make_layout(config, position, yaw, classes, walls)


def _random_walls(
    key: Key, config: ArenaConfig, position: Float[Array, "N 2"]
) -> Float[Array, "K 4"]:
    """Draws inner walls along the sides of an arena; one that finds no room is absent."""
    draws = jax.random.uniform(key, (4, config.inner_walls, _NUM_CANDIDATES))
    reach, thin = config.side / 2 - _PASSAGE, WALL_THICKNESS / 2
    half = config.side / 2 * (_SHORTEST + (_LONGEST - _SHORTEST) * draws[0])
    half = jnp.minimum(half, reach)  # in small arenas
    along, across = (reach - jnp.stack([half, jnp.full_like(half, thin)])) * (2 * draws[1:3] - 1)
    turns = draws[3] < 0.5
    x, y = jnp.where(turns, across, along), jnp.where(turns, along, across)
    candidates = jnp.stack([x, y, jnp.pi / 2 * turns, half], axis=-1)

    def sides(walls: jax.Array) -> jax.Array:
        """Half the extent of walls in x and y."""
        half = jnp.stack([walls[..., 3], jnp.full_like(walls[..., 3], thin)], axis=-1)
        return jnp.where(walls[..., 2:3] > 0, half[..., ::-1], half)

    def add(walls: jax.Array, drawn: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        """Puts one wall where there is room."""

        def fits(wall: jax.Array) -> jax.Array:
            between = jnp.abs(walls[:, :2] - wall[None, :2]) - sides(walls) - sides(wall)[None]
            to_walls = jnp.linalg.norm(jnp.maximum(between, 0.0), axis=-1)
            to_pois = room_beside(wall[None], *position.T) - config.poi_extent
            return jnp.all(to_walls >= _PASSAGE) & jnp.all(to_pois >= config.poi_gap)

        has_room, (index, places) = jax.vmap(fits)(drawn[1]), drawn
        chosen = jnp.where(jnp.any(has_room), places[jnp.argmax(has_room)], walls[index])
        return walls.at[index].set(chosen), None

    none = jnp.array(absent_walls(config.inner_walls))
    return jax.lax.scan(add, none, (jnp.arange(len(none)), candidates))[0]


def to_box(x: Array, y: Array, yaw: Array, half_u: Array, half_v: Array | float) -> Array:
    """Distance of positions, relative to a box's centre, from the box; negative inside."""
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    along = jnp.abs(cos * x + sin * y) - half_u
    across = jnp.abs(cos * y - sin * x) - half_v
    outside = jnp.hypot(jnp.maximum(along, 0.0), jnp.maximum(across, 0.0))
    return outside + jnp.minimum(jnp.maximum(along, across), 0.0)


def room_beside(
    walls: Float[Array | np.ndarray, "K 4"], x: Float[Array, "*B"], y: Float[Array, "*B"]
) -> Float[Array, "*B"]:
    """Distance of positions from the nearest of some inner walls, in metres; negative inside."""

    def to_wall(wall: jax.Array) -> jax.Array:
        return to_box(x - wall[0], y - wall[1], wall[2], wall[3], WALL_THICKNESS / 2)

    return jnp.min(jax.vmap(to_wall)(jnp.asarray(walls)), axis=0)


def sized(arena: Arena, layout: Layout) -> Arena:
    """The arena with inner walls of the lengths in a layout, which may be traced."""
    if not len(arena.inner_walls):
        return arena
    sizes = arena.model.geom_size.at[arena.inner_walls, 0].set(layout.walls[:, 3])
    return dataclasses.replace(arena, model=arena.model.replace(geom_size=sizes))


def place(arena: Arena, layout: Layout, poses: Float[Array, "R 3"]) -> mjx.Data:
    """MJX state with PoIs and robots at rest.

    Only `geom_xpos` and `geom_xmat` follow from them; what else kinematics compute is that of
    `arena.data`. All bodies stand upright in the world, so one turn places a geom.
    `mjx.kinematics`, which follows chains of joints, is a program of 36 times as many operations.

    Args:
      poses: x [m], y [m] and yaw [rad] of each robot.
    """
    data = put(arena, layout, poses)
    pois = data.mocap_pos[: arena.mj_model.nmocap]
    turns = _yaws(arena, layout)[: len(pois)]
    body = jnp.asarray(arena.mj_model.geom_bodyid)
    robots = jnp.pad(poses[:, :2], ((0, 0), (0, 1)))
    origin = jnp.concatenate([jnp.zeros((1, 3)), pois, robots])[body]
    yaw = jnp.concatenate([jnp.zeros(1), turns, poses[:, 2]])[body, None]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)

    def turned(x: jax.Array, y: jax.Array, z: jax.Array) -> tuple[jax.Array, ...]:
        return cos * x - sin * y, cos * y + sin * x, z

    offset = jnp.concatenate(turned(*jnp.split(arena.model.geom_pos, 3, axis=1)), axis=1)
    rows = turned(*(jnp.asarray(arena.geom_axes[:, i]) for i in range(3)))
    return data.replace(geom_xpos=origin + offset, geom_xmat=jnp.stack(rows, axis=1))


def put(arena: Arena, layout: Layout, poses: Float[Array, "R 3"]) -> mjx.Data:
    """`place` without the kinematics, which a physics step computes anyway."""
    chex.assert_shape(poses, (arena.num_robots, 3))
    chex.assert_shape(layout.position, (arena.config.num_pois, 2))
    chex.assert_shape(layout.walls, (arena.config.inner_walls, 4))
    shown = layout.shape[:, None] == jnp.arange(len(arena.config.shapes))[None]
    height = jnp.where(shown, POI_HEIGHT / 2, _STORE)
    position = jnp.concatenate(
        [jnp.broadcast_to(layout.position[:, None], (*height.shape, 2)), height[..., None]], axis=-1
    )
    position, yaw = position.reshape(-1, 3), _yaws(arena, layout)
    if len(layout.walls):
        middles = jnp.pad(layout.walls[:, :2], [(0, 0), (0, 1)], constant_values=WALL_HEIGHT / 2)
        position = jnp.concatenate([position, middles])
    zero = jnp.zeros_like(yaw)
    turn = jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)], axis=-1)
    return arena.data.replace(mocap_pos=position, mocap_quat=turn, qpos=poses.reshape(-1))


def _yaws(arena: Arena, layout: Layout) -> Float[Array, "_"]:
    """Direction of each mocap body, in radians."""
    yaw = jnp.repeat(layout.yaw, len(arena.config.shapes))
    return jnp.append(yaw, layout.walls[:, 2]) if len(layout.walls) else yaw


def robot_poses(data: mjx.Data) -> Float[Array, "R 3"]:
    """Each robot's x [m], y [m] and yaw [rad]."""
    return data.qpos.reshape(-1, 3)


def drive(arena: Arena, data: mjx.Data, wheel_speeds: Float[Array, "R 2"]) -> mjx.Data:
    """Advances the physics by `TIMESTEP` seconds.

    Args:
      arena: with inner walls `sized` for the layout.
      wheel_speeds: left and right wheel speed of each robot, in rad/s.
    """
    chex.assert_shape(wheel_speeds, (arena.num_robots, 2))
    # MJX relies on rank promotion, which the caller may have forbidden.
    with jax.numpy_rank_promotion("allow"):
        return mjx.step(arena.model, data.replace(ctrl=as_control(wheel_speeds)))


def as_control(wheel_speeds: Float[Array, "R 2"]) -> Float[Array, "U"]:
    """MuJoCo's control vector; the third actuator of a robot is passive."""
    return jnp.pad(wheel_speeds, ((0, 0), (0, 1))).reshape(-1)

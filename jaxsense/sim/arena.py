"""The arena in MuJoCo-MJX: walls, robots, and PoIs whose classes are data.

Each PoI has one upright solid for every shape, each of them a mocap body; all but the one that it
shows are stored below the floor. Position and shape are thus part of the MJX state and colour is
part of the layout, so a new layout or class never recompiles anything.
"""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int
from mujoco import mjx
from scipy.spatial.transform import Rotation

from jaxsense.config.scene import POI_HEIGHT, TIMESTEP, ArenaConfig
from jaxsense.core import checks
from jaxsense.core.types import Key, pytree
from jaxsense.sim import amiro

_STORE = -2.0  # m, height of hidden shapes, below the floor


@pytree
class Layout:
    """PoIs of one arena; no field is static.

    Attributes:
      position: `[N, 2]` centres, in metres from the arena's centre.
      yaw: `[N]` in radians.
      shape: `[N]` int32 index into the shapes of the settings.
      colour: `[N, 3]` albedo, linear RGB in [0, 1].
      values: `[N]` value of each attribute in the settings.
    """

    position: jax.Array
    yaw: jax.Array
    shape: jax.Array
    colour: jax.Array
    values: dict[str, jax.Array] = struct.field(default_factory=dict)


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
        body = self.mj_model.geom_bodyid - 1  # in the order of the MJCF: world, PoIs, robots
        return np.where(body < self.mj_model.nmocap, body // len(self.config.shapes), -1)

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
) -> Layout:
    """Layout of PoIs.

    Args:
      position: centres of the PoIs, in metres from the arena's centre.
      yaw: in radians.
      classes: index of each PoI's class in `config.classes`.
    """
    chex.assert_shape(position, (config.num_pois, 2))
    chex.assert_shape([yaw, classes], (config.num_pois,))
    checks.require_index("classes", classes, len(config.classes))
    shapes = jnp.array([list(config.shapes).index(w) for w in config.words("shape")], jnp.int32)
    colours = jnp.array(config.values("colour"))
    values = {name: jnp.array(config.values(name)) for name in config.attributes}
    of_pois = {name: numbers[classes] for name, numbers in values.items()}
    return Layout(position, yaw, shapes[classes], colours[classes], of_pois)


def random_layout(key: Key, config: ArenaConfig, classes: Int[Array, "N"]) -> Layout:
    """Draws a layout of PoIs of given classes, at least `poi_gap` apart.

    The arena is divided into square cells, about twice as many as PoIs. Each PoI gets a cell of its
    own and a position that leaves half the gap free on every side.

    Args:
      classes: index of each PoI's class in `config.classes`.
    """
    checks.require_key(key)
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
    return make_layout(
        config, corner * cell_side - config.side / 2 + cell_side / 2 + offset, yaw, classes
    )


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
    turns = jnp.repeat(layout.yaw, len(arena.config.shapes))[: len(pois)]
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
    shown = layout.shape[:, None] == jnp.arange(len(arena.config.shapes))[None]
    height = jnp.where(shown, POI_HEIGHT / 2, _STORE)
    position = jnp.concatenate(
        [jnp.broadcast_to(layout.position[:, None], (*height.shape, 2)), height[..., None]], axis=-1
    )
    zero = jnp.zeros_like(layout.yaw)
    turn = jnp.stack([jnp.cos(layout.yaw / 2), zero, zero, jnp.sin(layout.yaw / 2)], axis=-1)
    return arena.data.replace(
        mocap_pos=position.reshape(-1, 3),
        mocap_quat=jnp.repeat(turn, len(arena.config.shapes), axis=0),
        qpos=poses.reshape(-1),
    )


def robot_poses(data: mjx.Data) -> Float[Array, "R 3"]:
    """Each robot's x [m], y [m] and yaw [rad]."""
    return data.qpos.reshape(-1, 3)


def drive(arena: Arena, data: mjx.Data, wheel_speeds: Float[Array, "R 2"]) -> mjx.Data:
    """Advances the physics by `TIMESTEP` seconds.

    Args:
      wheel_speeds: left and right wheel speed of each robot, in rad/s.
    """
    chex.assert_shape(wheel_speeds, (arena.num_robots, 2))
    # MJX relies on rank promotion, which the caller may have forbidden.
    with jax.numpy_rank_promotion("allow"):
        return mjx.step(arena.model, data.replace(ctrl=as_control(wheel_speeds)))


def as_control(wheel_speeds: Float[Array, "R 2"]) -> Float[Array, "U"]:
    """MuJoCo's control vector; the third actuator of a robot is passive."""
    return jnp.pad(wheel_speeds, ((0, 0), (0, 1))).reshape(-1)

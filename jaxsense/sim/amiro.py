"""The AMiRo mini robot: its dimensions and its MJCF.

The numbers come from the robot's published URDF (`amiro_description`). Two slides and a hinge let
the robot move in the plane, so its `qpos` and `qvel` are x [m], y [m] and yaw [rad]. Its wheels are
velocity servos that push the body at the wheels' positions; a third, passive actuator prevents it
from sliding sideways. A wheel that cannot reach its speed with the servo's force slips.
"""

from jaxsense.config.scene import ROBOT_RADIUS

BODY_RADIUS = ROBOT_RADIUS
BODY_HEIGHT = 0.084  # m
GROUND_CLEARANCE = 0.010  # m
BODY_MASS = 0.4  # kg
WHEEL_RADIUS = 0.05571 / 2  # m
WHEEL_WIDTH = 0.006  # m
WHEEL_MASS = 0.02  # kg
WHEEL_SEPARATION = 0.069  # m
CASTER_RADIUS = 0.0025  # m
CASTER_OFFSET = 0.036  # m, fore and aft
CAMERA_HEIGHT = 0.042  # m, above the floor
LIDAR_HALF_WIDTH = 0.025  # m, the URG-04LX is 50 mm x 50 mm x 70 mm
LIDAR_TOP = 0.164  # m
BODY_TOP = GROUND_CLEARANCE + BODY_HEIGHT  # m, above the floor

MAX_SPEED = 0.2  # m/s
MAX_TURN_RATE = 1.0  # rad/s
MAX_ACCELERATION = 2.5  # m/s^2
MAX_TURN_ACCELERATION = 3.2  # rad/s^2

_MASS = BODY_MASS + 2 * WHEEL_MASS
# Time constant of the wheel servos; two physics steps or more keep the integration stable and well
# damped.
_TIME_CONSTANT = 0.02  # s
_WHEEL_GAIN = _MASS * WHEEL_RADIUS**2 / (2 * _TIME_CONSTANT)  # N m s / rad
_WHEEL_TORQUE = _MASS * MAX_ACCELERATION * WHEEL_RADIUS / 2  # N m
_SLIP_GAIN = _MASS / _TIME_CONSTANT  # N s / m
_SLIP_FORCE = 0.8 * _MASS * 9.81  # N, friction coefficient of rubber on a smooth floor

_WHEEL_INERTIA = WHEEL_MASS * (WHEEL_RADIUS**2 / 4 + WHEEL_WIDTH**2 / 12)  # about its upright axis
_YAW_INERTIA = BODY_MASS * BODY_RADIUS**2 / 2 + 2 * (
    _WHEEL_INERTIA + WHEEL_MASS * (WHEEL_SEPARATION / 2) ** 2
)  # kg m^2
# The same motors accelerate and turn the robot: each rad/s^2 of turning costs this much forward
# acceleration.
FORWARD_PER_TURN = 2 * _YAW_INERTIA / (_MASS * WHEEL_SEPARATION)  # m/rad

MAX_WHEEL_SPEED = (MAX_SPEED + MAX_TURN_RATE * WHEEL_SEPARATION / 2) / WHEEL_RADIUS  # rad/s


def body(name: str, has_lidar: bool, reach: float) -> str:
    """MJCF of one robot's body.

    Only the sphere in its middle collides: with upright cylinders, boxes and other robots, it
    collides exactly where the robot's disc would.

    Args:
      name: prefix of the names of its parts.
      has_lidar: whether a sensor is mounted on top, in the case of a laser scanner.
      reach: maximum distance of the robot's centre from the origin along x and y, in metres.
    """
    middle = GROUND_CLEARANCE + BODY_HEIGHT / 2
    tower = (LIDAR_TOP - BODY_TOP) / 2
    lidar = (
        f'<geom name="{name}_lidar" type="box" pos="0 0 {LIDAR_TOP - tower}" mass="0" '
        f'size="{LIDAR_HALF_WIDTH} {LIDAR_HALF_WIDTH} {tower}" rgba=".15 .15 .15 1"/>'
    )
    wheels = "".join(
        f'<geom name="{name}_{side}_wheel" type="cylinder" mass="{WHEEL_MASS}" group="1" '
        f'size="{WHEEL_RADIUS} {WHEEL_WIDTH / 2}" euler="90 0 0" '
        f'pos="0 {sign * WHEEL_SEPARATION / 2} {WHEEL_RADIUS}" rgba=".1 .1 .1 1"/>'
        f'<site name="{name}_{side}" pos="0 {sign * WHEEL_SEPARATION / 2} 0"/>'
        for side, sign in (("left", 1), ("right", -1))
    )
    casters = "".join(
        f'<geom name="{name}_{end}_caster" type="sphere" mass="0" size="{CASTER_RADIUS}" group="1" '
        f'pos="{sign * CASTER_OFFSET} 0 {CASTER_RADIUS}" rgba=".5 .5 .5 1"/>'
        for end, sign in (("front", 1), ("rear", -1))
    )
    return f"""
    <body name="{name}">
      <joint name="{name}_x" type="slide" axis="1 0 0" range="{-reach} {reach}"/>
      <joint name="{name}_y" type="slide" axis="0 1 0" range="{-reach} {reach}"/>
      <joint name="{name}_yaw" type="hinge" axis="0 0 1" limited="false"/>
      <geom name="{name}_body" type="cylinder" size="{BODY_RADIUS} {BODY_HEIGHT / 2}"
            pos="0 0 {middle}" mass="{BODY_MASS}" rgba=".25 .25 .3 1"/>
      <geom name="{name}_collider" type="sphere" size="{BODY_RADIUS}" pos="0 0 {middle}" mass="0"
            class="collider"/>
      {wheels}{casters}<site name="{name}_axle"/>
      {lidar if has_lidar else ""}
    </body>"""


def actuators(name: str) -> str:
    """Writes the MJCF of one robot's actuators: left wheel, right wheel and sideways grip."""
    wheels = "".join(
        f'<velocity name="{name}_{side}" site="{name}_{side}" gear="{1 / WHEEL_RADIUS} 0 0 0 0 0" '
        f'kv="{_WHEEL_GAIN}" ctrlrange="{-MAX_WHEEL_SPEED} {MAX_WHEEL_SPEED}" '
        f'forcerange="{-_WHEEL_TORQUE} {_WHEEL_TORQUE}"/>'
        for side in ("left", "right")
    )
    return wheels + (
        f'<general name="{name}_grip" site="{name}_axle" gear="0 1 0 0 0 0" gaintype="fixed" '
        f'gainprm="0" biastype="affine" biasprm="0 0 {-_SLIP_GAIN}" '
        f'forcerange="{-_SLIP_FORCE} {_SLIP_FORCE}"/>'
    )

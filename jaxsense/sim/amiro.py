"""The AMiRo mini robot: its dimensions; its MJCF is in `arena.xml.jinja`.

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
WHEEL_GAIN = _MASS * WHEEL_RADIUS**2 / (2 * _TIME_CONSTANT)  # N m s / rad
WHEEL_TORQUE = _MASS * MAX_ACCELERATION * WHEEL_RADIUS / 2  # N m
SLIP_GAIN = _MASS / _TIME_CONSTANT  # N s / m
SLIP_FORCE = 0.8 * _MASS * 9.81  # N, friction coefficient of rubber on a smooth floor

_WHEEL_INERTIA = WHEEL_MASS * (WHEEL_RADIUS**2 / 4 + WHEEL_WIDTH**2 / 12)  # about its upright axis
_YAW_INERTIA = BODY_MASS * BODY_RADIUS**2 / 2 + 2 * (
    _WHEEL_INERTIA + WHEEL_MASS * (WHEEL_SEPARATION / 2) ** 2
)  # kg m^2
# The same motors accelerate and turn the robot: each rad/s^2 of turning costs this much forward
# acceleration.
FORWARD_PER_TURN = 2 * _YAW_INERTIA / (_MASS * WHEEL_SEPARATION)  # m/rad

MAX_WHEEL_SPEED = (MAX_SPEED + MAX_TURN_RATE * WHEEL_SEPARATION / 2) / WHEEL_RADIUS  # rad/s

"""Simulation in MuJoCo-MJX: arenas, AMiRo robots and their scanline sensors."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    # On import, MJX prints that NVIDIA Warp is not installed; nothing here uses it.
    import mujoco.mjx as _  # noqa: F401

from jaxsense.sim.arena import make_layout as make_layout
from jaxsense.sim.arena import place as place
from jaxsense.sim.arena import random_layout as random_layout
from jaxsense.sim.raycast import CrossSection as CrossSection
from jaxsense.sim.raycast import Fan as Fan
from jaxsense.sim.raycast import Pinhole as Pinhole
from jaxsense.sim.raycast import cast as cast
from jaxsense.sim.raycast import choose as choose
from jaxsense.sim.raycast import cross_section as cross_section
from jaxsense.sim.sensors import Sensor as Sensor
from jaxsense.sim.sensors import scan as scan
from jaxsense.sim.windows import cut_out as cut_out
from jaxsense.sim.world import Scene as Scene
from jaxsense.sim.world import World as World
from jaxsense.sim.world import look as look
from jaxsense.sim.world import make_world as make_world
from jaxsense.sim.world import random_scene as random_scene

"""Settings of a run, as frozen dataclasses that check themselves, and presets.

An invalid value raises `ConfigError`, a `ValueError` whose one line names the field, its value and
what would be right. The attribute docstrings are the text of `--help`.
"""

from jaxsense.config.learning import DetectorConfig as DetectorConfig
from jaxsense.config.learning import DqnConfig as DqnConfig
from jaxsense.config.learning import EvaluationConfig as EvaluationConfig
from jaxsense.config.learning import FilterConfig as FilterConfig
from jaxsense.config.learning import JmvaeConfig as JmvaeConfig
from jaxsense.config.learning import MdpConfig as MdpConfig
from jaxsense.config.learning import TeamConfig as TeamConfig
from jaxsense.config.learning import ToursConfig as ToursConfig
from jaxsense.config.learning import TravelConfig as TravelConfig
from jaxsense.config.mission import CONTROL_PERIOD as CONTROL_PERIOD
from jaxsense.config.mission import MARGIN as MARGIN
from jaxsense.config.mission import NODES_PER_POI as NODES_PER_POI
from jaxsense.config.mission import PLANNING_RADIUS as PLANNING_RADIUS
from jaxsense.config.mission import VIEW_SIDES as VIEW_SIDES
from jaxsense.config.mission import CommunicationConfig as CommunicationConfig
from jaxsense.config.mission import LocalisationConfig as LocalisationConfig
from jaxsense.config.mission import MissionConfig as MissionConfig
from jaxsense.config.mission import NavigationConfig as NavigationConfig
from jaxsense.config.mission import Search as Search
from jaxsense.config.options import as_plain as as_plain
from jaxsense.config.options import from_plain as from_plain
from jaxsense.config.options import parse_json as parse_json
from jaxsense.config.options import require_trust as require_trust
from jaxsense.config.scene import CLEARANCE as CLEARANCE
from jaxsense.config.scene import COLOURS as COLOURS
from jaxsense.config.scene import LIDAR_HEIGHT as LIDAR_HEIGHT
from jaxsense.config.scene import MAX_BEARING as MAX_BEARING
from jaxsense.config.scene import MODALITIES as MODALITIES
from jaxsense.config.scene import POI_HEIGHT as POI_HEIGHT
from jaxsense.config.scene import ROBOT_RADIUS as ROBOT_RADIUS
from jaxsense.config.scene import SHAPES as SHAPES
from jaxsense.config.scene import TIMESTEP as TIMESTEP
from jaxsense.config.scene import ArenaConfig as ArenaConfig
from jaxsense.config.scene import Attribute as Attribute
from jaxsense.config.scene import CameraConfig as CameraConfig
from jaxsense.config.scene import LidarConfig as LidarConfig
from jaxsense.config.scene import SensorConfig as SensorConfig
from jaxsense.config.scene import Shape as Shape
from jaxsense.config.scene import ViewpointConfig as ViewpointConfig
from jaxsense.config.section import ConfigError as ConfigError
from jaxsense.config.section import require_32_bits as require_32_bits
from jaxsense.config.whole import PRESETS as PRESETS
from jaxsense.config.whole import Config as Config
from jaxsense.config.whole import PresetName as PresetName
from jaxsense.config.whole import names_of_robots as names_of_robots

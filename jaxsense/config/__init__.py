"""Settings of a run, as frozen dataclasses that check themselves, and presets.

An invalid value raises `ConfigError`, a `ValueError` whose one line names the field, its value and
what would be right. The attribute docstrings are the text of `--help`.
"""

from jaxsense.config.learning import DetectorConfig as DetectorConfig
from jaxsense.config.learning import DqnConfig as DqnConfig
from jaxsense.config.learning import JmvaeConfig as JmvaeConfig
from jaxsense.config.learning import MdpConfig as MdpConfig
from jaxsense.config.options import as_plain as as_plain
from jaxsense.config.options import from_plain as from_plain
from jaxsense.config.presets import PRESETS as PRESETS
from jaxsense.config.scene import Attribute as Attribute
from jaxsense.config.scene import CameraConfig as CameraConfig
from jaxsense.config.scene import LidarConfig as LidarConfig
from jaxsense.config.scene import SensorConfig as SensorConfig
from jaxsense.config.scene import Shape as Shape
from jaxsense.config.section import ConfigError as ConfigError
from jaxsense.config.whole import Config as Config

"""Coordinated multi-modal robot perception in JAX.

Robots with different sensors look at points of interest and write what they see into one shared map
of latent Gaussians. A policy for each sensor decides which look gains the most information. After
Korthals, Leitner and Rueckert, "Coordinated Heterogeneous Distributed Perception based on Latent
Space Representation", 2018. The parts are `sim` (arena, rays, sensors), `vae` (detectors,
JMVAE, fusion), `dqn` (map MDP, Q-learning), `looks`, `training`, `mission` and `interfaces`. Every
function is pure, takes its random key first and works on one example: add `vmap` and `jit`.
"""

from jaxsense import dqn as dqn
from jaxsense import interfaces as interfaces
from jaxsense import mission as mission
from jaxsense import sim as sim
from jaxsense import vae as vae
from jaxsense.config import PRESETS as PRESETS
from jaxsense.config import Attribute as Attribute
from jaxsense.config import Config as Config
from jaxsense.config import ConfigError as ConfigError
from jaxsense.config import SensorConfig as SensorConfig
from jaxsense.config import Shape as Shape
from jaxsense.core.types import Belief as Belief
from jaxsense.core.types import Fusion as Fusion
from jaxsense.core.types import Key as Key
from jaxsense.core.types import Transition as Transition
from jaxsense.core.types import pytree as pytree
from jaxsense.looks import Bank as Bank
from jaxsense.looks import Live as Live
from jaxsense.looks import detections as detections
from jaxsense.looks import make_mdp as make_mdp
from jaxsense.models import Models as Models
from jaxsense.models import init as init
from jaxsense.models import make_bayes as make_bayes
from jaxsense.models import make_in_place as make_in_place
from jaxsense.models import make_jmvae as make_jmvae
from jaxsense.run.rundir import load as load
from jaxsense.run.version import __version__ as __version__
from jaxsense.show.scans import compare_scans as compare_scans
from jaxsense.training import learn as learn

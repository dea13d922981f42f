"""Missions in places that the robots do not know: where PoIs and inner walls are.

Robots scan as they drive. Scans propose objects, which are associated with the slots of a map, and
show floor and walls on a grid that all robots share; robots look at objects, or drive to
frontiers of what their sensors have seen. Functions take one mission, for `vmap`, unless they say
otherwise.
"""

from jaxsense.exploration.decide import POLICIES as POLICIES
from jaxsense.exploration.grid import Grid as Grid
from jaxsense.exploration.outcome import measure as measure
from jaxsense.exploration.proposals import Candidates as Candidates
from jaxsense.exploration.proposals import propose as propose
from jaxsense.exploration.rollout import rollout_batch as rollout_batch
from jaxsense.exploration.slots import Slots as Slots
from jaxsense.exploration.slots import associate as associate
from jaxsense.exploration.slots import gospa as gospa
from jaxsense.exploration.state import ExplorationState as ExplorationState
from jaxsense.exploration.state import reset as reset
from jaxsense.exploration.state import told as told

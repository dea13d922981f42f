"""The map MDP behind the interfaces of other libraries, one extra each.

Import `jaxsense.interfaces.gymnax`, `.rejax`, `.gymnasium` or `.stable_baselines3` by name; only
that library needs to be installed.
"""

from jaxsense.interfaces.common import prepared_starts as prepared_starts
from jaxsense.interfaces.mdps import detections as detections
from jaxsense.interfaces.mdps import map_mdp as map_mdp

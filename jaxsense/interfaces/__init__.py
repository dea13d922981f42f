"""The map MDP behind the interfaces of other libraries, each an extra of its own.

`jaxsense.interfaces.gymnax`, `.rejax`, `.gymnasium` and `.stable_baselines3` are imported by name,
so that only the one that is used has to be installed.
"""

from jaxsense.interfaces.common import prepared_starts as prepared_starts
from jaxsense.interfaces.mdps import detections as detections
from jaxsense.interfaces.mdps import map_mdp as map_mdp

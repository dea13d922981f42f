"""Environments for other libraries: the tasks, the map MDP and the team MDP.

Import `jaxsense.interfaces.gymnax`, `.rejax`, `.gymnasium`, `.stable_baselines3`, `.jaxmarl` or
`.pettingzoo` by name; only that library must be installed.
"""

from jaxsense.interfaces.common import prepared_starts as prepared_starts

"""The map MDP and the team MDP behind the interfaces of other libraries, one extra each.

Import `jaxsense.interfaces.gymnax`, `.rejax`, `.gymnasium`, `.stable_baselines3`, `.jaxmarl` or
`.pettingzoo` by name; only that library must be installed.
`jaxsense.interfaces.rawlog` reads laser scans from logs of MRPT, without that library.
"""

from jaxsense.interfaces.common import prepared_starts as prepared_starts

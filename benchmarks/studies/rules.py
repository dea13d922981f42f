"""rules.py PRESET N SIDE ROBOTS SEED POLICIES"""

import sys, dataclasses
import jaxsense as js

preset, n, side, robots, seed, pols = sys.argv[1:]
c, m = js.load_pretrained(preset)
if n != "-":
    c = dataclasses.replace(
        c, arena=dataclasses.replace(c.arena, num_pois=int(n), side=float(side))
    )
if robots != "-":
    c = dataclasses.replace(c, robots=tuple(robots.split(",")))
print(
    "===",
    sys.argv[1:],
    "\n",
    js.score_missions(c, m, {}, against=tuple(pols.split(",")), episodes=512, seed=int(seed)),
    flush=True,
)

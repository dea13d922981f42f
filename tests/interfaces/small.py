"""MDPs of frozen tasks with starts that differ, short episodes and three robots."""

import dataclasses
import functools

import jaxsense

# Of three robots; a price of time that is a sum of powers of 2.
TEAM = dataclasses.replace(jaxsense.PRESETS["team"], robots=("camera", "camera", "lidar"))
AGENTS = ("camera_1", "camera_2", "lidar")
TEAM_NOP = 8


@functools.cache
def small_mdp():
    """The MDP of one robot and three PoIs, some of which are seen at the start."""
    mdp = jaxsense.make("map-v0").mdp
    return dataclasses.replace(mdp, config=dataclasses.replace(mdp.config, partly_seen_starts=True))


@functools.cache
def team():
    """The MDP of a team, with the lonely episodes that no interface may have."""
    mdp = jaxsense.make("team-v0").mdp
    config = dataclasses.replace(mdp.teams.config, num_pois=(1, 8), second_cost=0.125)
    teams = dataclasses.replace(mdp.teams, config=config, alone=1.0, is_random=True)
    length = dataclasses.replace(mdp.config, max_steps=12)
    return dataclasses.replace(mdp, config=length, teams=teams)

"""Missions: all robots act together in one MJX arena, in closed loop over a shared map.

Each robot asks its policy which PoI to look at, drives to a viewpoint, turns to the PoI, scans it,
updates the shared map with the detection and asks again, until the policy chooses NOP. Robots
decide independently of each other, and again when the map changes under way. By settings, they have
errors of localisation, and maps of their own in place of the shared one. Most functions take
one mission, for `vmap`; those that are faster for many take B missions.
"""

from jaxsense.mission import roadmap as roadmap
from jaxsense.mission.begin import reset as reset
from jaxsense.mission.outcome import Case as Case
from jaxsense.mission.outcome import cases as cases
from jaxsense.mission.rollout import rollout as rollout
from jaxsense.mission.state import Mission as Mission
from jaxsense.mission.state import MissionState as MissionState
from jaxsense.mission.state import Record as Record
from jaxsense.mission.state import make_mission as make_mission

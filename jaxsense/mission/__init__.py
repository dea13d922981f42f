"""Missions: all robots act together in one MJX arena, in closed loop over a shared map.

Each robot asks its policy which PoI to look at, drives to a viewpoint, turns to the PoI, scans it,
updates the shared map with the detection and asks again, until the policy chooses NOP. Robots
decide independently of each other, and again when the map changes under way. By settings, they have
errors of localisation, and maps of their own in place of the shared one. Most functions take
one mission, for `vmap`; those that are faster for many take B missions.
"""

from jaxsense.mission import roadmap as roadmap
from jaxsense.mission.begin import reset as reset
from jaxsense.mission.begin import start as start
from jaxsense.mission.outcome import REASONS as REASONS
from jaxsense.mission.outcome import Case as Case
from jaxsense.mission.outcome import cases as cases
from jaxsense.mission.outcome import is_fault as is_fault
from jaxsense.mission.outcome import measure as measure
from jaxsense.mission.outcome import reason as reason
from jaxsense.mission.outcome import require_playable as require_playable
from jaxsense.mission.rollout import rollout as rollout
from jaxsense.mission.rollout import rollout_batch as rollout_batch
from jaxsense.mission.rollout import step as step
from jaxsense.mission.state import Faults as Faults
from jaxsense.mission.state import Mission as Mission
from jaxsense.mission.state import MissionState as MissionState
from jaxsense.mission.state import Record as Record
from jaxsense.mission.state import make_mission as make_mission
from jaxsense.mission.state import no_faults as no_faults

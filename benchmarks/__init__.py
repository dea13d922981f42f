"""The speed of each stage, compared with other libraries: `python -m benchmarks --help`."""

from collections.abc import Callable

from benchmarks.dqn import dqn_live, dqn_rejax, dqn_sb3, dqn_seeds
from benchmarks.jmvae import jmvae
from benchmarks.measure import Options, Row
from benchmarks.missions import (
    missions,
    missions_devices,
    missions_many,
    missions_many_devices,
    missions_many_under_way,
    missions_many_under_way_devices,
    missions_under_way,
    missions_under_way_devices,
    resets_many,
)
from benchmarks.physics import (
    physics,
    physics_batch,
    physics_contacts,
    physics_contacts_warp,
    physics_devices,
    physics_solver,
    physics_solver_batch,
    physics_solver_warp,
    physics_warp,
)
from benchmarks.rays import rays, rays_warp, rays_warp_bvh
from benchmarks.team import team_mdp
from benchmarks.time_to_optimal import time_to_optimal_rejax, time_to_optimal_sb3

ROWS: dict[str, Callable[[Options], Row]] = {
    "physics": physics,
    "physics_contacts": physics_contacts,
    "physics_solver": physics_solver,
    "physics_batch": physics_batch,
    "physics_solver_batch": physics_solver_batch,
    "physics_warp": physics_warp,
    "physics_contacts_warp": physics_contacts_warp,
    "physics_solver_warp": physics_solver_warp,
    "physics_devices": physics_devices,
    "rays": rays,
    "rays_warp": rays_warp,
    "rays_warp_bvh": rays_warp_bvh,
    "missions": missions,
    "missions_under_way": missions_under_way,
    "missions_devices": missions_devices,
    "missions_many": missions_many,
    "missions_many_under_way": missions_many_under_way,
    "missions_many_devices": missions_many_devices,
    "missions_under_way_devices": missions_under_way_devices,
    "missions_many_under_way_devices": missions_many_under_way_devices,
    "resets_many": resets_many,
    "jmvae": jmvae,
    "dqn_rejax": dqn_rejax,
    "dqn_sb3": dqn_sb3,
    "dqn_live": dqn_live,
    "dqn_seeds": dqn_seeds,
    "team_mdp": team_mdp,
    "time_to_optimal_rejax": time_to_optimal_rejax,
    "time_to_optimal_sb3": time_to_optimal_sb3,
}
"""Every row by its name, in the order of the table."""

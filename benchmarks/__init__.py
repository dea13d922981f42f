"""The speed of each stage, compared with other libraries: `python -m benchmarks --help`."""

from collections.abc import Callable

from benchmarks.dqn import dqn_live, dqn_rejax, dqn_sb3, dqn_seeds
from benchmarks.jmvae import jmvae
from benchmarks.measure import Options, Row
from benchmarks.missions import missions, missions_many, resets_many
from benchmarks.physics import physics, physics_contacts, physics_solver
from benchmarks.rays import rays
from benchmarks.team import team_mdp
from benchmarks.time_to_optimal import time_to_optimal_rejax, time_to_optimal_sb3
from benchmarks.train import train, train_warm

ROWS: dict[str, Callable[[Options], Row]] = {
    "physics": physics,
    "physics_contacts": physics_contacts,
    "physics_solver": physics_solver,
    "rays": rays,
    "missions": missions,
    "missions_many": missions_many,
    "resets_many": resets_many,
    "jmvae": jmvae,
    "dqn_rejax": dqn_rejax,
    "dqn_sb3": dqn_sb3,
    "dqn_live": dqn_live,
    "dqn_seeds": dqn_seeds,
    "team_mdp": team_mdp,
    "time_to_optimal_rejax": time_to_optimal_rejax,
    "time_to_optimal_sb3": time_to_optimal_sb3,
    "train": train,
    "train_warm": train_warm,
}
"""Every row by its name, in the order of the table."""

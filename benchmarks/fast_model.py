"""How well the MDP with travel predicts the duration of missions.

    python -m benchmarks.fast_model default --policy auction

Missions are simulated in MJX. The MDP starts where they start, and its robots look where those of
the mission have looked, in the same order. Prints the mean of predicted over played durations,
until the last look, and their correlation.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import Config, Models, load_pretrained, make_mdp, mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.dqn import mdp as mdps
from jaxsense.dqn import starts
from jaxsense.dqn.mdp import Mdp
from jaxsense.dqn.team import Team
from jaxsense.looks import Bank
from jaxsense.mission import MissionState, Record
from jaxsense.mission.rollout import rollout_batch
from jaxsense.mission.state import no_faults

_MOST_LOOKS = 64  # by one robot


def played(
    key: jax.Array, config: Config, models: Models, policy: str, episodes: int
) -> tuple[MissionState, Record]:
    """First states of missions, and `[B, T]` records of all of their control periods."""
    made, steps = mission.make_mission(config), round(config.mission.time_limit / CONTROL_PERIOD)
    reset_key, play_key = jax.random.split(key)

    @jax.jit
    def play(config: Config, models: Models) -> tuple[MissionState, Record]:
        there = dataclasses.replace(mission.make_mission(config), policies=made.policies)
        faults, index = no_faults(config), made.policy(policy)
        begin = lambda key: mission.reset(key, there, models, index, faults)  # noqa: E731
        states = jax.vmap(begin)(jax.random.split(reset_key, episodes))
        keys = jax.random.split(play_key, episodes)
        return states, rollout_batch(keys, there, models, states, steps)[1]

    return jax.tree.map(np.asarray, play(config, models))


def looks(record: Record, positions: np.ndarray) -> tuple[np.ndarray, float]:
    """Where the robots of a mission have looked.

    Returns:
      `[R, L]` PoIs, -1 after a robot's last look, and the time of the last look of all, in seconds.
    """
    found = np.full((record.scanned.shape[1], _MOST_LOOKS), -1, np.int32)
    # A robot that has detected its target has a new one already.
    is_new = np.any(np.diff(record.belief.mean, axis=0) != 0, axis=-1)
    for robot, scans in enumerate(record.scanned.T):
        for i, step in enumerate(np.flatnonzero(scans)):
            apart = np.linalg.norm(positions - record.poses[step, robot, :2], axis=1)
            changed = np.where(is_new[step - 1], apart, np.inf)
            detects = record.detected[step, robot]
            found[robot, i] = np.argmin(changed) if detects else record.target[step, robot]
    return found, float((1 + np.flatnonzero(record.scanned.any(axis=1))[-1]) * CONTROL_PERIOD)


def predicted(
    mdp: Mdp,
    features: tuple[jax.Array, ...],
    positions: jax.Array,
    poses: jax.Array,
    modality: jax.Array,
    looks: jax.Array,
) -> jax.Array:
    """`[]` seconds until robots have looked at `[R, L]` PoIs in the MDP.

    Args:
      features: for each modality `[N, D_m]` of looks before the start, of which there are none.
    """
    number, (num_robots, most) = len(positions), looks.shape
    team = Team(
        positions=positions,
        present=jnp.ones(number, bool),
        poses=poses,
        modality=modality,
        works=looks[:, 0] >= 0,
        target=jnp.full(num_robots, number, jnp.int32),
    )
    classes = jnp.zeros(number, jnp.int32)
    seen = jnp.zeros((number, mdp.num_modalities), bool)
    start = starts.begin(jax.random.key(0), mdp, team, classes, classes, seen, features)

    def choose(carry: tuple[mdps.State, jax.Array]) -> tuple[mdps.State, jax.Array]:
        state, taken = carry
        agent = state.agent
        of_agent = looks[agent, jnp.minimum(taken[agent], most - 1)]
        action = jnp.where((taken[agent] < most) & (of_agent >= 0), of_agent, number)
        after, _ = mdps.step(jax.random.key(0), mdp, state, action)
        return after, taken.at[agent].add(1)

    works = lambda carry: jnp.any(carry[0].team.works)  # noqa: E731
    taken = jnp.zeros(num_robots, jnp.int32)
    return jax.lax.while_loop(works, choose, (start, taken))[0].seconds


def compare(
    key: jax.Array, config: Config, models: Models, policy: str, episodes: int
) -> tuple[np.ndarray, np.ndarray]:
    """`[B]` predicted and `[B]` played durations of missions, in seconds."""
    states, records = played(key, config, models, policy, episodes)
    sizes = [len(config.labels(m)) for m in config.modalities]
    bank = Bank(tuple(jnp.zeros((len(config.arena.classes), 1, size)) for size in sizes))
    mdp = make_mdp(config, models, bank)
    assert mdp.teams is not None
    # The looks are given: nobody chooses anew.
    teams = dataclasses.replace(mdp.teams, chooses_anew=False)
    mdp = dataclasses.replace(mdp, num_pois=config.arena.num_pois, teams=teams)
    of_mission = lambda i: jax.tree.map(lambda x: x[i], (records, states.scene.layout.position))  # noqa: E731
    of_each = [looks(*of_mission(i)) for i in range(episodes)]
    sequences, times = (np.stack(x) for x in zip(*of_each, strict=True))
    nothing = tuple(jnp.zeros((config.arena.num_pois, size)) for size in sizes)
    predict = jax.jit(jax.vmap(predicted, (None, None, 0, 0, None, 0)))
    scene, modality = states.scene, jnp.array(config.modality_of_robot)
    found = predict(mdp, nothing, scene.layout.position, scene.poses, modality, sequences)
    return np.asarray(found), times


def main() -> None:
    """Compares the MDP with missions, and prints a line."""
    parser = argparse.ArgumentParser("python -m benchmarks.fast_model")
    parser.add_argument("preset")
    parser.add_argument("--policy", default="latent")
    parser.add_argument("--pois", type=int)
    parser.add_argument("--robots", nargs="*", default=[])
    parser.add_argument("--side", type=float)
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    config, models = load_pretrained(args.preset)
    number, side = args.pois or config.arena.num_pois, args.side or config.arena.side
    arena = dataclasses.replace(config.arena, num_pois=number, side=side)
    robots = tuple(args.robots) or config.robots
    config, key = dataclasses.replace(config, robots=robots, arena=arena), jax.random.key(args.seed)
    of_mdp, of_missions = compare(key, config, models, args.policy, args.episodes)
    ratio, correlation = of_mdp.mean() / of_missions.mean(), np.corrcoef(of_mdp, of_missions)
    print(f"{number} PoIs: predicted / played {ratio:.3f}, correlation {correlation[0, 1]:.3f}")


if __name__ == "__main__":
    main()

"""What missions in unknown places find, and how long they take, by policy.

    python -m benchmarks.exploration --arenas 1024

Arenas of 8 m with 4 to 12 PoIs and five inner walls; the models of preset `default` that ship.
"""

import argparse
import functools
from typing import Any

import jax
import numpy as np

from jaxsense import exploration, load_pretrained, mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.options import from_plain

SECONDS, CHUNK = 600.0, 100


def main() -> None:
    """Prints a row for each policy."""
    parser = argparse.ArgumentParser("python -m benchmarks.exploration")
    parser.add_argument("--arenas", type=int, default=64)
    arenas = parser.parse_args().arenas
    config, models = load_pretrained("default")
    arena = {"side": 8.0, "num_pois": 12, "fewest_pois": 4, "inner_walls": 5}
    config = from_plain({"arena": arena, "mission": {"time_limit": SECONDS}}, config)
    made = mission.make_mission(config)
    reset_key, key = jax.random.split(jax.random.key(7))

    @jax.jit
    def begin() -> exploration.ExplorationState:
        reset = jax.vmap(lambda key: exploration.reset(key, made, models))
        return reset(jax.random.split(reset_key, arenas))

    @functools.partial(jax.jit, static_argnums=0)
    def go_on(policy: exploration.Policy, chunk: int, states: exploration.ExplorationState):
        keys = jax.random.split(jax.random.fold_in(key, chunk), arenas)
        return exploration.rollout_batch(keys, made, models, policy, states, CHUNK)

    def play(policy: exploration.Policy, states: exploration.ExplorationState) -> dict[str, Any]:
        for chunk in range(round(SECONDS / CONTROL_PERIOD) // CHUNK):
            states = go_on(policy, chunk, states)
            if np.all(states.done):
                break
        measured = jax.vmap(lambda state: exploration.measure(models, state))(states)
        return jax.tree.map(np.asarray, measured)

    told = jax.vmap(lambda state: exploration.told(made, state))(begin())
    known = play(exploration.POLICIES["nearest"], told)["time_s"]
    for name, policy in exploration.POLICIES.items():
        print(name, row(play(policy, begin()), known), flush=True)


def row(found: dict[str, Any], known: np.ndarray) -> str:
    """The figures of a policy, most of them for each PoI, next to the seconds with known places."""
    present, seconds = found["present"].sum(), found["time_s"]
    figures = {
        "seconds": seconds.mean(),
        "over known": seconds.mean() / known.mean(),
        **{n: found[n].sum() / present for n in ("found", "false", "right", "confidence", "looks")},
        "duplicates": found["gospa"].duplicates.sum() / present,
        "metres off": found["gospa"].position_error.mean(),
        "late": np.mean(seconds >= SECONDS),
        "with contact": np.mean(found["collisions"] > 0),
    }
    return ", ".join(f"{name} {number:.4g}" for name, number in figures.items())


if __name__ == "__main__":
    main()

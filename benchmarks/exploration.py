"""What missions in unknown places find, and how long they take, by policy.

    python -m benchmarks.exploration --arenas 1024

Arenas of 8 m with 4 to 12 PoIs and five inner walls; the models of preset `default` that ship.
"""

import argparse
from typing import Any

import jax
import numpy as np

from jaxsense import exploration, load_pretrained, mission
from jaxsense.config.mission import CONTROL_PERIOD
from jaxsense.config.options import from_plain

SECONDS = 600.0


def main() -> None:
    """Prints a row for each policy."""
    parser = argparse.ArgumentParser("python -m benchmarks.exploration")
    parser.add_argument("--arenas", type=int, default=64)
    arenas = parser.parse_args().arenas
    config, models = load_pretrained("default")
    arena = {"side": 8.0, "num_pois": 12, "fewest_pois": 4, "inner_walls": 5}
    config = from_plain({"arena": arena, "mission": {"time_limit": SECONDS}}, config)
    made, steps = mission.make_mission(config), round(SECONDS / CONTROL_PERIOD)
    keys = jax.random.split(jax.random.key(7), (2, arenas))

    def play(policy: exploration.Policy, is_told: bool):
        states = jax.vmap(lambda key: exploration.reset(key, made, models))(keys[0])
        if is_told:
            states = jax.vmap(lambda state: exploration.told(made, state))(states)
        states = exploration.rollout_batch(keys[1], made, models, policy, states, steps)
        return jax.vmap(lambda state: exploration.measure(models, state))(states)

    played = jax.jit(play, static_argnums=(0, 1))
    known = np.asarray(played(exploration.POLICIES["nearest"], True)["time_s"])
    for name, policy in exploration.POLICIES.items():
        print(name, row(jax.tree.map(np.asarray, played(policy, False)), known), flush=True)


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

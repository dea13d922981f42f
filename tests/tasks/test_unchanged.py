"""`-v0` never changes: fixed episodes give the observations, rewards and ends that are stored.

`python tests/tasks/test_unchanged.py` writes those of tasks that have none yet.
"""

import functools
import json
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxsense
from jaxsense.tasks import registry

STORED = Path(__file__).parent / "unchanged.json"
CASES = [f"{name} {agent}" for name in jaxsense.registered() for agent in registry.agents(name)]
STEPS = 10


@functools.cache
def programs(name):
    """Functions of a task, compiled once for all of its agents."""
    del name
    return (
        jax.jit(lambda key, task: task.reset(key)),
        jax.jit(lambda key, task, state, action: task.step(key, state, action)),
        jax.jit(lambda task, state: task.action_mask(state)),
    )


def episode(case):
    """What the PoIs that exist, in turn and then NOP, lead to."""
    name, agent = case.split()
    task = jaxsense.make(name, agent)
    reset, step, mask_of = programs(name)
    key = jax.random.key(32)
    observation, state = reset(key, task)
    found = {"observations": [observation], "rewards": [], "ends": [], "masks": []}
    for i in range(STEPS):
        mask = np.asarray(mask_of(task, state))
        pois = np.flatnonzero(mask[:-1])
        action = task.num_actions - 1 if i == STEPS - 1 else int(pois[i % len(pois)])
        state, seen = step(jax.random.fold_in(key, i), task, state, np.int32(action))
        found["observations"].append(seen.observation)
        found["rewards"].append(seen.reward)
        found["ends"].append([seen.terminated, seen.truncated])
        found["masks"].append(mask)
    return {name: np.array(rows) for name, rows in found.items()}


def test_all_tasks_are_stored():
    assert sorted(json.loads(STORED.read_text())) == sorted(CASES)


@pytest.mark.parametrize("case", CASES)
def test_an_episode_is_the_stored_one(case):
    stored, found = json.loads(STORED.read_text())[case], episode(case)
    for name in ("ends", "masks"):
        np.testing.assert_array_equal(found[name], np.array(stored[name], bool))
    for name in ("observations", "rewards"):
        np.testing.assert_allclose(found[name], stored[name], atol=1e-4, err_msg=name)


def main():
    stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    for case in CASES:
        if case not in stored:
            found = episode(case)
            stored[case] = {
                name: np.round(rows.astype(float), 5).tolist()
                if rows.dtype.kind == "f"
                else rows.astype(int).tolist()
                for name, rows in found.items()
            }
    lines = [f"{json.dumps(case)}: {json.dumps(stored[case])}" for case in sorted(stored)]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()

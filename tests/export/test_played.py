"""A robot with an archive chooses what the robots of missions choose."""

import dataclasses
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import export, mission
from jaxsense.interfaces import robot
from jaxsense.mission import decide
from jaxsense.mission.rollout import rollout_batch

ENOUGH = 40


@pytest.mark.slow  # compiles missions
@pytest.mark.parametrize("preset", ["default", "team"])
def test_an_archive_chooses_as_the_robots_of_missions_do(preset):
    config, models = jaxsense.load_pretrained(preset)
    _, programs = robot.load(io.BytesIO(export.archive(config, models)))
    made = mission.make_mission(config)
    # Only the policy that plays, which compiles faster.
    made = dataclasses.replace(made, policies={"latent": made.policies["latent"]})

    @jax.jit
    def choices(keys, states):
        """Of each robot: where its choice is due, what it knows, and what it chooses."""
        found = []
        for index in map(jnp.int32, range(len(config.carried))):
            known = jax.vmap(lambda s: decide.known_to(made, models, s, index))(states)  # noqa: B023
            due = jax.vmap(lambda s: decide.is_due(made, s, index) & ~s.done)(states)  # noqa: B023
            chosen = decide.choices(keys, made, models, states, index, jnp.int32(0))
            team = known.team
            inputs = {**vars(known.belief), "looked_from": states.looked_from, **vars(team)}
            found.append((due, inputs, chosen))
        return found

    advance = jax.jit(lambda keys, s: rollout_batch(keys, made, models, s, 1, len(keys)))
    keys = jax.random.split(jax.random.key(0), 8)
    states, count, actions = jax.vmap(lambda key: mission.reset(key, made, models))(keys), 0, set()
    while count < ENOUGH and not states.done.all():
        before = jax.tree.map(np.asarray, choices(keys, states))
        states, records = advance(keys, states)
        for number, (due, inputs, chosen) in enumerate(before):
            for row in np.flatnonzero(due):
                given = {name: x[row] for name, x in inputs.items()}
                found = int(programs["decide"](**given, robot=number)["action"])
                assert found == chosen[row]
                if number == 0:  # the others decide when it has looked
                    assert found == records.target[row, 0, 0]
                actions.add(found)
                count += 1
    assert count >= ENOUGH
    assert len(actions) > 2

"""Exported policies of teams of any size, against those of jaxsense."""

import dataclasses
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exporting import CONFIG, EXAMPLE, with_classes

from jaxsense import export
from jaxsense.config import PRESETS
from jaxsense.core.types import Belief
from jaxsense.dqn.team_mdp import Team
from jaxsense.interfaces.robot import load
from jaxsense.models import init


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    """Settings, models and archive of a team with tours."""
    dqn = dataclasses.replace(PRESETS["team"].dqn, hidden=(8,))
    config = dataclasses.replace(CONFIG, dqn=dqn, robots=("camera", "lidar", "lidar"))
    trained = with_classes(init(jax.random.key(0), config), config)
    path = tmp_path_factory.mktemp("team") / "team.zip"
    path.write_bytes(export.archive(config, trained))
    return config, trained, path


@pytest.mark.slow
def test_a_team_may_have_any_number_of_points_and_robots(team):
    _, trained, path = team
    assert trained.agent.orders
    contents, programs = load(path)
    about = contents["programs"]["decide"]
    assert about["outputs"]["values"]["shape"] == ["pois + 1"]
    for num_pois, num_robots, num_looks in ((5, 3, 2), (2, 1, 1), (9, 4, 32)):
        rng = np.random.default_rng(num_pois)
        belief = Belief(*rng.uniform(0.1, 1, (2, num_pois, 2)).astype(np.float32))
        of_team = Team(
            positions=rng.normal(size=(num_pois, 2)).astype(np.float32),
            present=np.arange(num_pois) < 4,
            poses=rng.normal(size=(num_robots, 3)).astype(np.float32),
            modality=np.ones(num_robots, np.int32),
            works=np.ones(num_robots, bool),
            target=np.full(num_robots, num_pois, np.int32),
        )
        robot = np.int32(num_robots - 1)
        looked_from = np.full((num_pois, 2, num_looks, 2), np.inf, np.float32)
        given = {**vars(belief), **vars(of_team), "robot": robot, "looked_from": looked_from}
        found = programs["decide"](**given)
        expected = trained.agent.decide(
            trained.q_networks[1],
            trained.tours,
            trained.fusion.classes,
            belief,
            jax.tree.map(jnp.asarray, of_team),
            robot,
        )
        np.testing.assert_allclose(found["values"], expected, rtol=1e-4)
        # Values count travel time: the best is taken.
        assert found["action"] == np.argmax(expected)


@pytest.mark.slow
def test_a_value_that_is_not_a_number_is_answered_by_minus_one(team):
    _, _, path = team
    contents, programs = load(path)
    given = {
        name: np.ones([{"pois": 2}.get(n, n if isinstance(n, int) else 1) for n in x["shape"]])
        for name, x in contents["programs"]["decide"]["inputs"].items()
    }
    given["robot"] = 0
    assert programs["decide"](**given)["action"] >= 0
    given["mean"][1, 0] = np.nan
    assert programs["decide"](**given)["action"] == -1


@pytest.mark.slow
def test_the_example_plays_a_team(team):
    lines = runpy.run_path(str(EXAMPLE))["explore"](*load(team[2]), [0, 1, 2, 0])
    assert [line.split(" is a ")[0] for line in lines[-4:]] == [f"PoI {n}" for n in range(4)]
    assert any("looks at PoI" in line for line in lines)

"""Exported policies of teams of any size, and robots with maps of their own."""

import dataclasses
import io
import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exporting import CONFIG, EXAMPLE, drawn
from untrained import untrained

import jaxsense
from jaxsense import export
from jaxsense.config import PRESETS
from jaxsense.config.mission import CommunicationConfig
from jaxsense.core import networks
from jaxsense.core.networks import MLP
from jaxsense.core.types import Belief
from jaxsense.dqn import policies
from jaxsense.dqn.team import Known, Team
from jaxsense.interfaces.robot import load
from jaxsense.mission.maps import MOST_LOOKS, OwnMap, empty, evidence_of
from jaxsense.vae import readout

OWN = dataclasses.replace(
    CONFIG,
    jmvae=dataclasses.replace(CONFIG.jmvae, fusion="filter"),
    mission=dataclasses.replace(
        CONFIG.mission, communication=CommunicationConfig(own_maps=True, loss=0.3, delay=1.0)
    ),
)


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(EXAMPLE))


@pytest.fixture(scope="module")
def team():
    """Models of a team, and their archive."""
    dqn = dataclasses.replace(PRESETS["team"].dqn, hidden=(8,))
    config = dataclasses.replace(CONFIG, dqn=dqn, robots=("camera", "lidar", "lidar"))
    trained = jaxsense.init(jax.random.key(1), config)  # whose network looks
    return trained, load(io.BytesIO(export.archive(config, trained)))


@pytest.mark.slow
def test_a_team_may_have_any_number_of_points_and_robots(team, example):
    trained, (contents, programs) = team
    assert contents["programs"]["decide"]["outputs"]["values"]["shape"] == ["pois + 1"]
    rng = np.random.default_rng(0)
    for pois, robots, looks in ((5, 3, 2), (2, 1, 1), (9, 4, 32)):
        sizes = {"pois": pois, "robots": robots, "looks": looks}
        given = drawn(rng, contents, "decide", sizes)
        given |= {"looked_from": np.full_like(given["looked_from"], np.inf)}
        given |= {"works": np.ones(robots, bool), "target": np.full(robots, pois, np.int32)}
        found = programs["decide"](**given)
        of_team = Team(**{key: jnp.asarray(given[key]) for key in Team.__dataclass_fields__})
        known = Known(
            belief=Belief(given["mean"], given["std"]),
            looks=jnp.zeros((pois, 2), jnp.int32),
            log_posterior=jnp.zeros((pois, 3)),
            team=of_team,
            times=trained.agent.travel.times(of_team, jnp.zeros((robots, pois))),
            robot=given["robot"],
        )
        expected = policies.latent(None, trained, known)
        np.testing.assert_allclose(found["values"], expected, rtol=1e-4)
        # Values count travel time: the best is taken.
        assert found["action"] == np.argmax(expected)
    given["mean"][1, 0] = np.nan
    assert programs["decide"](**given)["action"] == -1
    lines = example["explore"](contents, programs, [0, 1, 2, 0])
    assert [line.split(" is a ")[0] for line in lines[-4:]] == [f"PoI {n}" for n in range(4)]
    assert any("looks at PoI" in line for line in lines)


@pytest.fixture(scope="module")
def models():
    """Models with a filter that says different things of different features."""
    found = untrained(OWN)
    classes = Belief(jnp.array([[1.5, 0.0], [-1.0, 1.2], [-0.8, -1.4]]), jnp.full((3, 2), 0.3))
    fusion = found.fusion
    read = readout.make(classes, fusion.model.feature_sizes)
    network = MLP(fusion.hidden, read.of_classes.shape[1])
    sizes = zip(fusion.model.modalities, fusion.model.feature_sizes, strict=True)
    params = {
        name: networks.scale_last(network, networks.init(jax.random.key(i), network, size), 0.3)
        for i, (name, size) in enumerate(sizes)
    }
    fusion = dataclasses.replace(fusion, classes=classes, readout=read, networks=params)
    return dataclasses.replace(found, fusion=fusion)


@pytest.fixture(scope="module")
def own_maps(models):
    return load(io.BytesIO(export.archive(OWN, models)))


def test_maps_are_merged_as_missions_merge_them(models, own_maps):
    """Three robots look at five PoIs; the first one has heard of some looks of the others."""
    _, programs = own_maps
    assert not {"write_camera", "write_lidar"} & {*programs}
    rng, modality = np.random.default_rng(0), np.array([0, 1, 1], np.int32)
    held, sums = empty(jnp.asarray(modality), 3), np.zeros((3, 5, 3), np.float32)

    @jax.jit
    def remember(held, robot, poi, evidence):
        nowhere, now, applies = jnp.zeros(2), jnp.float32(0), jnp.bool_(True)
        return held.with_look(robot, poi, nowhere, evidence, now, applies)

    read = jax.jit(evidence_of, static_argnums=2)
    hears_of = np.array([9, 3, 0])  # looks of each robot that the first one knows of
    for look in range(18):
        robot, poi = look % 3, int(rng.integers(4))  # nobody looks at the last PoI
        m, weight = int(modality[robot]), np.float32(rng.uniform(0.2, 1.0))
        features = np.float32(rng.dirichlet([0.5, 0.5]))
        found = read(models, features, m, weight)
        held = remember(held, np.int32(robot), np.int32(poi), found)
        told = programs[f"tell_{OWN.modalities[m]}"](features=features, weight=weight)["evidence"]
        np.testing.assert_allclose(told, found.log_likelihood, atol=1e-5)
        if look // 3 < hears_of[robot]:
            sums[robot, poi] += told
    is_known = held.taken() & (jnp.arange(MOST_LOOKS)[None] < hears_of[:, None])
    expected = jax.jit(lambda held: OwnMap(held, is_known, 5).read(models).belief)(held)
    merged = programs["merge"](sums=sums)
    np.testing.assert_allclose(merged["mean"], expected.mean, atol=1e-5)
    np.testing.assert_allclose(merged["std"], expected.std, atol=1e-5)
    assert np.abs(merged["mean"][:4]).max() > 0.3
    np.testing.assert_array_equal(merged["std"][4], models.fusion.prior.std)


def test_a_message_that_comes_twice_is_counted_once(own_maps, example):
    contents, programs = own_maps
    assert contents["remembered_looks"] == MOST_LOOKS
    maps = [example["empty"](contents, 3) for _ in range(2)]
    place = np.array([0.5, 0.2], np.float32)
    maps[0]["sums"][0, 1] = [0.0, -2.0, -3.0]
    example["remember"](contents, maps[0], 0, 1, 0, place)
    example["tell"](contents, programs, maps, 0)
    once = {name: x.copy() for name, x in maps[1].items()}
    assert np.abs(once["mean"][1]).max() > 0.1
    np.testing.assert_array_equal(once["looked_from"][1, 0, 0], place)
    example["tell"](contents, programs, maps, 0)
    # An older one, of no look.
    example["tell"](contents, programs, [example["empty"](contents, 3), maps[1]], 0)
    jax.tree.map(np.testing.assert_array_equal, maps[1], once)
    lines = example["explore"](contents, programs, [0, 1, 2])
    assert [line.split(" is a ")[0] for line in lines[-3:]] == [f"PoI {n}" for n in range(3)]
    assert any("looks at PoI" in line for line in lines)

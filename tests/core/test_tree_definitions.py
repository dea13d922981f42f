"""The class belongs to the tree definition: no program of one class runs with another."""

import dataclasses
import importlib.util
import itertools
import pkgutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx, serialization
from jax.sharding import SingleDeviceSharding

import jaxsense
from jaxsense import dqn, sim
from jaxsense.config import Config
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn.map_agent import MapAgent
from jaxsense.dqn.rewards import Nats, Paper
from jaxsense.dqn.team_agent import TeamAgent
from jaxsense.vae import Filter, InPlace


def own_reward(value):
    """As a notebook's cell defines it each time that it is run."""

    @pytree
    class Mine:
        cost: jax.Array

        def of_gain(self, gain):
            return value * gain - self.cost

    return Mine


@jax.jit
def paid(reward, gain):
    return reward.of_gain(gain)


def wrong_programs(number):
    rewards = [own_reward(float(value))(0.0) for value in range(number)]
    return sum(float(paid(reward, 1.0)) != value for value, reward in enumerate(rewards))


def test_a_class_that_is_defined_again_runs_its_own_program():
    assert wrong_programs(60) == 0


@pytest.mark.slow
def test_three_thousand_classes_run_their_own_programs():
    assert wrong_programs(3000) == 0


def test_classes_with_equal_fields_have_different_tree_definitions():
    blank = [Nats(0.1), Paper(0.1), *(own_reward(0)(0.1) for _ in range(78))]
    trees = [jax.tree.structure(each) for each in blank]
    pairs = list(itertools.combinations(trees, 2))
    assert len(pairs) == 80 * 79 // 2 == 3160
    assert not any(a == b for a, b in pairs)
    assert all(a == jax.tree.structure(each) for a, each in zip(trees, blank, strict=True))


@pytest.mark.parametrize("kinds", [(Nats, Paper), (InPlace, Filter), (MapAgent, TeamAgent)])
def test_placeholders_of_two_classes_differ(kinds):
    def blank(kind):
        return object.__new__(kind)

    for kind in kinds:
        for field in dataclasses.fields(kind):
            assert field.name in kind.__dataclass_fields__
    one, two = (blank(kind) for kind in kinds)
    for each, kind in zip((one, two), kinds, strict=True):
        each.__dict__.update({field.name: 0 for field in dataclasses.fields(kind)})
    assert jax.tree.structure(one) != jax.tree.structure(two)


def test_branches_of_two_classes_are_refused():
    with pytest.raises(TypeError):
        jax.lax.cond(jnp.bool_(True), lambda: Nats(jnp.float32(1)), lambda: Paper(jnp.float32(1)))


def test_static_fields_and_paths_of_leaves_belong_to_the_definition():
    config = Config()
    paths = {
        jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(config)[0]
    }
    assert ".dqn.discount" in paths
    other = dataclasses.replace(config.dqn, hidden=(3,))
    assert jax.tree.structure(config.dqn) != jax.tree.structure(other)


def test_state_dictionaries_are_those_of_earlier_checkpoints():
    belief = Belief(jnp.arange(2.0), jnp.ones(2))
    state = serialization.to_state_dict(belief)
    assert list(state) == ["mean", "std"]
    blank = jax.tree.map(jnp.zeros_like, belief)
    found = serialization.from_state_dict(blank, state)
    np.testing.assert_array_equal(found.mean, [0, 1])
    with pytest.raises(ValueError, match="Belief"):
        serialization.from_state_dict(blank, {"mean": state["mean"]})


@pytest.fixture(scope="module")
def mdp():
    return jaxsense.tasks.make("map-v0", agent="camera").mdp


def own_sensor(value):
    class Own(sim.Sensor):
        gain: jax.Array

        def read(self, key, hits, surfaces, light):
            return value * self.gain

    return Own(jnp.float32(1), height=0.1, rays=sim.Fan(8, 90.0), window=4)


def test_a_sensor_that_is_defined_again_runs_its_own_program():
    read = jax.jit(lambda sensor: sensor.read(None, None, None, None))
    own = [own_sensor(float(value)) for value in range(60)]
    assert [float(read(sensor)) for sensor in own] == list(range(60))
    assert jax.tree.structure(own[0]) != jax.tree.structure(own[1])


def test_every_pytree_of_the_package_names_its_class():
    modules = pkgutil.walk_packages(jaxsense.__path__, "jaxsense.")
    for module in modules:
        source = importlib.util.find_spec(module.name)
        text = Path(source.origin).read_text(encoding="utf-8") if source.origin else ""
        assert "PyTreeNode" not in text, module.name
        assert "register_dataclass(" not in text.replace("`jax.tree_util.register_dataclass`", "")


def test_placeholder_leaves_pass_through_every_transformation(mdp):
    jax.tree.map(lambda _: object(), mdp)
    jax.tree.map(lambda _: None, Config())
    batch = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), mdp)
    keys = jax.random.split(jax.random.key(0), 2)
    reset = jax.vmap(dqn.reset, in_axes=(0, jax.tree.map(lambda _: 0, mdp)))
    assert jax.tree.leaves(reset(keys, batch))[0].shape[0] == 2
    device = SingleDeviceSharding(jax.devices()[0])
    shardings = jax.tree.map(lambda _: device, mdp)
    jax.jit(lambda mdp: mdp, out_shardings=shardings)(mdp)
    assert isinstance(nnx.jit(lambda mdp: mdp)(mdp), type(mdp))


def test_settings_are_placeholders_under_nnx_grad():
    section = jax.tree.map(jnp.float32, Config().mdp)
    gradient = nnx.grad(lambda section: section.look_cost**2, allow_int=True)(section)
    assert float(gradient.look_cost) == pytest.approx(2 * 0.05)


def test_a_traced_setting_does_not_switch_off_the_checks_of_others():
    config = Config()

    def change(distance, **wrong):
        viewpoint = dataclasses.replace(config.viewpoint, min_distance=distance)
        return dataclasses.replace(config, viewpoint=viewpoint, **wrong).viewpoint.min_distance

    assert float(jax.jit(change)(0.4)) == pytest.approx(0.4)
    with pytest.raises(ValueError, match="robots"):
        jax.jit(lambda x: change(x, robots=("camera", "nose")))(0.4)

    def bearing(distance):
        viewpoint = dataclasses.replace(config.viewpoint, min_distance=distance)
        return dataclasses.replace(viewpoint, bearing_error=31.0).bearing_error

    with pytest.raises(ValueError, match=r"viewpoint.bearing_error = 31.0: must be from 0 to 10"):
        jax.jit(bearing)(0.4)


@pytest.mark.parametrize(
    ("value", "message"),
    [(7.0, "discount = 7.0: must be from 0 to 1"), (np.nan, "discount = nan")],
)
def test_an_array_is_checked_like_a_number(value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Config().dqn, discount=jnp.float32(value))


def test_a_relation_with_an_array_is_checked():
    with pytest.raises(ValueError, match="max_distance"):
        dataclasses.replace(Config().viewpoint, max_distance=jnp.float32(0.2))

"""The table of policies, on values worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toys import known_of, policy

from jaxsense.config import ConfigError
from jaxsense.core.types import Belief, pytree
from jaxsense.dqn import map_agent, optimum, policies
from jaxsense.dqn.optimum import LookValues
from jaxsense.dqn.policies import Policy

NOP, KEY, UNKNOWN = 3, jax.random.key(0), np.zeros((3, 3))
# The logarithm of what is not so.
NO = -np.inf
ROUND, EDGY = [np.log(0.5), np.log(0.5), NO], [NO, NO, 0.0]


@pytree
class OnMap:
    """A fusion whose beliefs hold the classes' probabilities as their mean."""

    def class_probabilities(self, belief):
        return belief.mean


def linear(of_classes, unseen):
    """A table of `[P]` means of the rewards of three classes, and that of an unseen PoI."""
    points = jnp.array(optimum.lattice(3, 66), jnp.float32)
    return points @ jnp.array(of_classes, jnp.float32), jnp.float32(unseen)


def worthless():
    return linear([-1, -1, -1], -1)


def look_values(q, one_step=None):
    (one, one_unseen), (total, unseen) = one_step or worthless(), q
    return LookValues(one, total, one_unseen, unseen)


@pytest.mark.parametrize(
    ("seen_by_camera", "expected"),
    [((0, 0, 0), 0), ((1, 0, 0), 1), ((0, 1, 1), 0), ((1, 1, 0), 2), ((1, 1, 1), NOP)],
)
def test_naive_looks_at_the_first_poi_the_own_sensor_has_not_seen(seen_by_camera, expected):
    looks = np.array([seen_by_camera, (1, 0, 1)]).T  # what the LiDAR has seen does not matter
    assert policy("naive")(KEY, known_of(UNKNOWN, looks, 0)) == expected
    assert policy("naive")(KEY, known_of(UNKNOWN, looks[:, ::-1], 1)) == expected


def test_naive_play_of_more_looks_counts_its_own():
    looks = np.array([(1, 3), (2, 0), (3, 0)])
    found = [policy(f"naive{n}")(KEY, known_of(UNKNOWN, looks, 0)) for n in ("", "_2", "_3")]
    assert [int(action) for action in found] == [NOP, 0, 0]
    assert policy("naive_3")(KEY, known_of(UNKNOWN, looks[1:], 0)) == 0


@pytest.mark.parametrize(
    ("of_classes", "unseen", "expected"),
    [
        # Unseen: (1 - 2 + 4) / 3 = 1. Seen round, class 0 or 1: (1 - 2) / 2. Seen edgy: 4.
        ((1.0, -2.0, 4.0), 1.0, 2),
        # Unseen: (4 - 2 - 8) / 3 = -2. Seen round: (4 - 2) / 2 = 1. Seen edgy: -8.
        ((4.0, -2.0, -8.0), -2.0, 1),
        # Nothing pays.
        ((-1.0, 0.5, -3.0), -1.2, NOP),
        # The first look at a PoI has a value of its own.
        ((-1.0, 0.5, -3.0), 0.1, 0),
    ],
)
@pytest.mark.parametrize("modality", [0, 1])
def test_optimal_averages_over_the_classes_that_the_looks_leave_open(
    of_classes, unseen, expected, modality
):
    known = known_of([[np.log(1 / 3)] * 3, ROUND, EDGY], [(0, 0), (0, 1), (0, 1)], modality)
    own, other = look_values(linear(of_classes, unseen)), look_values(worthless())
    models = (own, other) if modality == 0 else (other, own)
    assert policy("optimal", look_values=models)(KEY, known) == expected
    # `bayes` reads the reward of the next look alone.
    short = look_values(worthless(), linear(of_classes, unseen))
    models = (short, other) if modality == 0 else (other, short)
    assert policy("bayes", look_values=models)(KEY, known) == expected
    assert policy("optimal", look_values=models)(KEY, known) == NOP


def test_greedy_reads_the_map_where_bayes_reads_the_exact_posterior():
    values = look_values(worthless(), linear((1.0, -2.0, 4.0), -1.0))
    models = {"look_values": (values, look_values(worthless())), "fusion": OnMap()}
    on_map = Belief(jnp.array([[0.5, 0.5, 0], [0, 0, 1.0], [0, 1.0, 0]]), jnp.ones((3, 3)))
    known = known_of([EDGY, ROUND, ROUND], np.ones((3, 2)), 0, on_map)
    assert policy("greedy", **models)(KEY, known) == 1
    assert policy("bayes", **models)(KEY, known) == 0
    # The other sensor has other values.
    known = known_of([EDGY, ROUND, ROUND], np.ones((3, 2)), 1, on_map)
    assert policy("greedy", **models)(KEY, known) == NOP


def test_expected_gains_are_of_each_sensor_and_poi():
    camera = look_values(worthless(), linear((1.0, -2.0, 4.0), 7.0))
    lidar = look_values(worthless(), linear((0.0, 3.0, 0.0), -5.0))
    on_map = Belief(jnp.array([[0.5, 0.5, 0], [0, 0, 1.0], [0, 1.0, 0]]), jnp.ones((3, 3)))
    is_seen = jnp.array([True, True, False])
    found = policies.expected_gains(OnMap(), (camera, lidar), on_map, is_seen)
    np.testing.assert_allclose(found, [[-0.5, 4, 7], [1.5, 0, -5]], atol=1e-5)


def test_random_takes_every_action_equally_often():
    keys, known = jax.random.split(KEY, 4000), known_of(UNKNOWN, np.zeros((3, 2)))
    actions = jax.vmap(policy("random"), in_axes=(0, None))(keys, known)
    # 1000 each +- 4 sqrt(4000 x 3/16) = +- 110.
    np.testing.assert_allclose(np.bincount(actions, minlength=4), 1000, atol=110)


def test_latent_takes_the_action_that_the_own_q_network_values_most():
    agent = map_agent.MapAgent(0.5, 3, 2, (4,))
    layers = agent.init(KEY)["params"]

    def biased(best):
        bias = 100.0 * (jnp.arange(4) == best)
        return {"params": {**layers, "Dense_1": {**layers["Dense_1"], "bias": bias}}}

    class Classes:
        classes = Belief(*jnp.ones((2, 5, 2)))

    for best in range(4):
        networks = biased(best), biased((best + 1) % 4)
        models = {"agent": agent, "q_networks": networks, "tours": None, "fusion": Classes}
        for modality in (0, 1):
            known = known_of(UNKNOWN, np.zeros((3, 2)), modality)
            assert policy("latent", **models)(KEY, known) == (best + modality) % 4


@pytree
class Widths(map_agent.MapAgent):
    """Values of looks at all PoIs are the sum of all widths, and that of NOP is 1."""

    def values(self, params, observed):
        width = observed.reshape(self.num_pois, 2, -1)[:, 1].sum()
        return jnp.append(jnp.full(self.num_pois, width), 1.0)


def test_a_look_is_worth_what_it_is_worth_alone():
    agent = Widths(0.5, 3, 1, (4,))
    belief = Belief(jnp.zeros((3, 1)), jnp.array([[2.0], [4.0], [8.0]]))
    # Classes of widths .25 and .75: each of the other two PoIs counts .5.
    classes = Belief(jnp.zeros((2, 1)), jnp.array([[0.25], [0.75]]))
    team = known_of(UNKNOWN, np.zeros((3, 2))).team
    found = agent.worth(None, classes, belief, team, jnp.int32(0))
    np.testing.assert_allclose(found, [2 + 1 - 1, 4 + 1 - 1, 8 + 1 - 1])
    # One that was given up is never worth a look.
    there = team.replace(present=jnp.array([True, False, True]))
    found = agent.worth(None, classes, belief, there, jnp.int32(0))
    np.testing.assert_allclose(found, [2, -np.inf, 8])


def test_a_policy_of_ones_own_is_one_more_entry():
    def backwards(key, models, known):
        return jnp.append(jnp.arange(len(known.looks)), -1)

    timed = Policy(backwards, lambda agent: True)
    table = policies.table({"backwards": backwards, "timed": timed})
    assert [*table] == [*policies.POLICIES, "backwards", "timed"]
    known = known_of(UNKNOWN, np.zeros((3, 2)))
    assert policies.best(table["backwards"].values(KEY, None, known)) == 2
    assert not table["backwards"].counts_time(None)
    assert table["timed"] is timed
    with pytest.raises(ConfigError, match=r"^policies = 'greedy': must not be latent, "):
        policies.table({"greedy": backwards})

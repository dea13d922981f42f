"""Policies that are compared, on a JMVAE whose weights are set by hand."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from by_hand import CONFIG, EXACT, KEY, detections, in_place

from jaxsense.config.learning import EvaluationConfig
from jaxsense.dqn import episodes, optimum, policies
from jaxsense.dqn.optimum import LookValues
from jaxsense.looks import Bank, mdp_of_one
from jaxsense.models import make_bayes, make_models
from jaxsense.training import comparison


def with_bias(bias):
    """A Q-network whose values are the same for every map."""
    layers = {
        "Dense_0": {"kernel": jnp.zeros((2 * 3 * 3, 2)), "bias": jnp.zeros(2)},
        "Dense_1": {"kernel": jnp.zeros((2, 4)), "bias": bias},
    }
    return {"params": layers}


def constant(gain):
    """The same values of looks at every posterior."""
    table = jnp.full(len(optimum.lattice(3)), gain)
    return LookValues(table, table, *(jnp.float32(gain),) * 2)


def test_policies_are_compared_on_the_same_starts_and_the_same_looks(monkeypatch):
    # Looks at a class are all different: what differs is their noise.
    always = lambda key, models, known: jnp.array([1.0, 0.0, 0.0, 0.0])  # noqa: E731
    bank = tuple(
        jax.nn.softmax(3 * jax.random.normal(k, (3, 64, 2)))
        for k in jax.random.split(jax.random.key(3))
    )
    parts = {"look_values": (constant(1.0),) * 2, "q_networks": (with_bias(jnp.zeros(4)),) * 2}
    models = make_models(CONFIG, fusion=in_place(), **parts)
    config = replace(CONFIG, evaluation=EvaluationConfig(num_repeats=1, num_states=8))

    @jax.jit
    def compared(models):
        mdp = mdp_of_one(config, models.fusion, Bank(bank), 0)
        random = jnp.zeros((4, 3), jnp.int32), jnp.zeros((4, 3, 2), bool)
        return comparison.compare_policies(KEY, models, mdp, config, random)

    monkeypatch.setattr(policies, "POLICIES", dict.fromkeys(comparison.COMPARED, always))
    monkeypatch.setattr(comparison, "reference", lambda *_: lambda known, classes: always(*[0] * 3))
    found = np.array([*compared(models).values()])
    assert found.shape == (5, 2, 12)
    assert len(np.unique(found[0, 0])) > 6  # of 12; without a gain a look is worth -1
    np.testing.assert_array_equal(found, found[[0] * 5])


def test_the_learned_return_is_the_mean_over_random_starts():
    @jax.jit
    def returned(bias):
        mdp = mdp_of_one(CONFIG, in_place(), Bank(EXACT), 0)
        keys = jax.random.split(jax.random.key(1), CONFIG.evaluation.num_starts)
        starts = jax.vmap(lambda key: episodes.reset(key, mdp, make_bayes(CONFIG)))(keys)
        return comparison.evaluation(mdp, CONFIG, starts)(KEY, with_bias(bias))

    assert returned(jnp.array([0.0, 0.0, 0.0, 1.0])) == 0.0
    # Eight looks at PoI 0, of which all but the first are in vain, and that one in some starts: it
    # pays at most what a class that is known for certain is worth.
    total = returned(jnp.array([1.0, 0.0, 0.0, 0.0]))
    assert -8 < total < -7 + 1 / 3**0.5
    assert np.isnan(returned(jnp.array([jnp.nan, 0.0, 0.0, 1.0])))


def test_policies_start_where_evaluations_do(monkeypatch):
    starts = None, SimpleNamespace(state=SimpleNamespace(classes="classes", seen="seen"))
    given = dict(modality=0, q_network={}, fusion=in_place(), look_values=(), starts=starts)
    monkeypatch.setattr(comparison, "compare_policies", lambda *given: given[-1])
    bank = detections(held_out=EXACT)
    assert comparison.play_policies(KEY, CONFIG, detections=bank, **given) == ("classes", "seen")
    fewer = comparison.play_policies(KEY, CONFIG, detections=bank, num_pois=2, **given)
    assert [x.shape[1:] for x in fewer] == [(2,), (2, 2)]


def test_groups_of_episodes_change_nothing(monkeypatch):
    def longest(x, y):
        # Every episode takes as long as the longest of its group.
        return x + 10.0 * y, jnp.full_like(x, jnp.max(x))

    looks = jnp.array([3, 1, 2, 0, 4, 5])
    starts = 9.0 - 3.0 * looks, jnp.arange(6.0)
    monkeypatch.setattr(comparison, "_LEAST_GROUP", 2)
    found, waited = comparison._in_groups(longest, looks, starts)
    np.testing.assert_array_equal(found, longest(*starts)[0])
    # Three groups, by looks: 0 and 1, 2 and 3, 4 and 5.
    np.testing.assert_array_equal(waited, [3.0, 9.0, 3.0, 9.0, -3.0, -3.0])
    monkeypatch.setattr(comparison, "_LEAST_GROUP", 4)
    np.testing.assert_array_equal(comparison._in_groups(longest, looks, starts)[1], [9.0] * 6)

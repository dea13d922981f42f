"""Scaled observations of frozen tasks, and programs that policies of one kind share."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxsense
from jaxsense import tasks
from jaxsense.tasks.score import _play_compiled
from jaxsense.tasks.task import Scaling

make = functools.cache(jaxsense.make)


def test_scaling_is_inverted():
    scaling = Scaling(jnp.array([1.0, -2.0]), jnp.array([0.5, 4.0]))
    features = jnp.array([[0.5, 2.0], [2.0, -6.0]])
    np.testing.assert_allclose(scaling(features), [-1, 1, 2, -1])
    np.testing.assert_allclose(scaling.inverse(scaling(features)), features)


def above(bound, key, observation):
    return jnp.where(observation[0] > bound, 0, 3)


@pytest.mark.slow
def test_policies_of_one_kind_are_compiled_once():
    task = make("map-v0")
    programs = _play_compiled._cache_size()
    keys = jax.random.split(jax.random.key(0), 3)
    found = [
        tasks.mean_return(keys[0], task, Partial(above, jnp.float32(bound)), 32)
        for bound in (-20.0, 0.0, 20.0)
    ]
    assert _play_compiled._cache_size() == programs + 1
    # The first looks at one PoI again and again, the last never.
    assert found[0] < 0 == found[2]
    # With another key, other starts; a function alone is a program of its own.
    alone = [tasks.mean_return(key, task, functools.partial(above, -20.0), 32) for key in keys]
    assert alone[0] == pytest.approx(found[0], abs=1e-5)
    assert len(set(alone)) == 3

"""Checks of arguments, each in one line that names the argument, its value and what is right."""

import dataclasses
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsense
from jaxsense import dqn, vae
from jaxsense.core import checks
from jaxsense.core.types import Fusion


@pytest.mark.parametrize(
    ("shape", "right", "wrong", "expected"),
    [
        ((2,), (2,), (3,), "x has the shape (3,): must be (2,)"),
        ((2,), (2,), (4, 2), "(4, 2): must be (2,); use jax.vmap for a batch"),
        ((2, None), (2, 7), (2,), "(2,): must be (2, any)"),
        ((None, 3), (0, 3), (2, 4), "(2, 4): must be (any, 3)"),
        ((None, 3), (5, 3), (4, 5, 3), "must be (any, 3); use jax.vmap for a batch"),
        ((), (), (1,), "(1,): must be (); use jax.vmap for a batch"),
        ((3, ...), (3,), (2,), "(2,): must be (3, ...)"),
        ((3, ...), (3, 1, 4), (), "(): must be (3, ...)"),
        ((..., None), (1, 2), (), "(): must be (..., any)"),
        ((..., 2), (5, 2), (2, 5), "(2, 5): must be (..., 2)"),
    ],
)
def test_shapes(shape, right, wrong, expected):
    checks.require_shape("x", np.zeros(right), shape)
    with pytest.raises(ValueError, match=re.escape(expected) + "$"):
        checks.require_shape("x", np.zeros(wrong), shape)
    jax.eval_shape(lambda x: checks.require_shape("x", x, shape), jnp.zeros(right))
    with pytest.raises(ValueError, match=re.escape(expected)):
        jax.eval_shape(lambda x: checks.require_shape("x", x, shape), jnp.zeros(wrong))


def test_a_number_has_no_axes_and_a_list_is_no_array():
    checks.require_shape("x", 1, ())
    checks.require_shape("x", np.float32(1), ())
    with pytest.raises(ValueError, match=re.escape("x has the shape (): must be (2,)")):
        checks.require_shape("x", 1.0, (2,))
    for wrong in ([0.0, 1.0], None, "ab"):
        expected = re.escape(f"x = {wrong!r}: must be an array of shape (2,)")
        with pytest.raises(ValueError, match=expected):
            checks.require_shape("x", wrong, (2,))


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (0, "key = 0: must be one key, as from jax.random.key(0)"),
        (None, "key = None: must be one key"),
        (np.zeros(2), "key of float64[2]: must be one key"),
        (jnp.zeros(2), "key of float32[2]: must be one key"),
        (jnp.uint32(3), "key of uint32[]: must be one key"),
    ],
    ids=range(5),
)
def test_what_is_no_key(wrong, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        checks.require_key(wrong)


@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_one_key_of_several(make):
    checks.require_key(make(0))
    checks.require_key(np.asarray(jax.random.PRNGKey(0)))  # as from a file
    keys = jax.random.split(make(0), 3)
    with pytest.raises(ValueError, match=re.escape("key holds (3,) keys: must be one key")):
        checks.require_key(keys)
    jax.vmap(checks.require_key)(keys)
    jax.jit(checks.require_key)(keys[0])
    with pytest.raises(ValueError, match=r"use jax\.vmap for a batch"):
        jax.jit(checks.require_key)(keys)


def _of_keys():
    """Public functions whose first argument is a key, with values of the others."""
    found = []
    for module in (jaxsense, vae, dqn):
        for name in dir(module):
            function = getattr(module, name)
            if not inspect.isfunction(function) or name.startswith("_"):
                continue
            parameters = inspect.signature(function).parameters
            if [*parameters][:1] == ["key"]:
                others = [*parameters.values()][1:]
                named = {each.name: None for each in others if each.kind is each.KEYWORD_ONLY}
                values = [None] * (len(others) - len(named))
                found.append(pytest.param(function, values, named, id=f"{module.__name__}.{name}"))
    assert len(found) > 10
    return found


@pytest.mark.parametrize(("function", "arguments", "by_name"), _of_keys())
def test_every_function_refuses_a_seed_as_its_key(function, arguments, by_name):
    # Before it looks at anything else.
    with pytest.raises(ValueError, match=re.escape("key = 7: must be one key")):
        function(7, *arguments, **by_name)


def test_what_lacks_members_of_a_protocol():
    class Half:
        accumulates = True

        def update(self):
            """Updates nothing."""

    expected = "fusion = Half: must be a Fusion; it lacks classes, prior, together, class_prob"
    with pytest.raises(ValueError, match=re.escape(expected)):
        checks.require_members("fusion", Half(), Fusion)
    config, models = jaxsense.load_pretrained("default")
    checks.require_members("fusion", models.fusion, Fusion)
    with pytest.raises(ValueError, match=r"models\.fusion = Half: must be a Fusion"):
        jaxsense.make_mdp(config, dataclasses.replace(models, fusion=Half()))


def test_a_fusion_that_is_no_pytree_is_refused():
    config, models = jaxsense.load_pretrained("default")

    class Bare(vae.InPlace):
        pass

    fusion = object.__new__(Bare)
    fusion.__dict__.update(vars(models.fusion))
    with pytest.raises(ValueError, match=r"models\.fusion = Bare: must be a pytree, its class und"):
        jaxsense.make_mdp(config, dataclasses.replace(models, fusion=fusion))


def test_the_shape_of_a_jmvae_is_made_of_tuples():
    given = {"modalities": ("a",), "feature_sizes": (2,), "latent_size": 2, "hidden": (4,)}
    hash(vae.Jmvae(**given))
    for name in ("modalities", "feature_sizes", "hidden"):
        of_lists = {**given, name: [*given[name]]}
        with pytest.raises(ValueError, match=re.escape(f"{name} = {of_lists[name]}: must be a")):
            vae.Jmvae(**of_lists)

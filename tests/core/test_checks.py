"""Checks of arguments, each in one line that names the argument, its value and what is right."""

import dataclasses
import os
import re
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.config import Config
from jaxsense.core import checks, inside
from jaxsense.core.types import Belief

BELIEF = Belief(jnp.zeros(2), jnp.ones(2))
NAN, INF = np.nan, np.inf


def belief(**parts):
    return dataclasses.replace(BELIEF, **{name: np.array(x) for name, x in parts.items()})


class Walker(Protocol):
    def walk(self) -> None: ...

    def _breathe(self) -> None: ...


class Legs:
    def walk(self):
        return None


def of(check, *more):
    """A check of a value, whose name is x."""
    return lambda value: check("x", value, *more)


# A check, values that pass, and others that do not.
CHECKS = {
    "positive": (
        of(checks.require_positive),
        [1, 1e-9, [2.0, 1e30]],
        [0, -1.0, INF, NAN, [1.0, 0.0], "1", None, 1j],
    ),
    "finite": (of(checks.require_finite), [0, [-1e30, 1.0]], [INF, -INF, NAN, [0.0, NAN], "a"]),
    "probabilities": (
        of(checks.require_probabilities),
        [[0.25, 0.75], [[1.0, 0.0], [1.0, 0.0]], [1.0, 5e-4]],
        [[0.5, 0.75], [-0.25, 1.25], [0.5], [[1.0, 0.0], [0.5, 0.25]], [NAN, 1.0], [1.0, 2e-3]],
    ),
    "number": (
        of(checks.require_number),
        [1, 2**40, np.int64(3)],
        [0, -1, 1.0, True, "1", None, np.ones(1, int)],
    ),
    "index": (
        of(checks.require_index, 3),
        [0, 2, np.array([[0, 2]])],
        [-1, 3, np.array([0, 3]), 1.0, True],
    ),
    "modality": (
        lambda value: checks.require_modality(value, ("x", "y")),
        [0, 1, np.int32(1)],
        [-1, 2, True, 0.0, "x", None],
    ),
    "type": (of(checks.require_type, Belief, "as made"), [BELIEF], [Belief, None, (0, 1)]),
    "belief": (
        of(checks.require_belief),
        [BELIEF],
        [
            None,
            belief(mean=[[0.0, 0.0]], std=[[1.0, 1.0]]),
            belief(std=[1.0]),
            belief(std=[1.0, 0.0]),
            belief(mean=[0.0, NAN]),
        ],
    ),
    "belief of a size": (of(checks.require_belief, 2), [BELIEF], [belief(mean=[0.0], std=[1.0])]),
    "members": (of(checks.require_members, Walker), [Legs()], [Legs, Walker, 3]),
    "one each": (
        of(checks.require_one_each, ("x", "y")),
        [(1, 2), [0.0, 1.0], np.zeros((2, 3)), jnp.zeros(2)],
        [3, "ab", [1.0], (1, 2, 3), np.zeros((3, 2)), {0: 1, 1: 2}],
    ),
    "array": (of(checks.require_shape, (...,)), [0, 1.0, np.zeros(2)], ["x", None, [1.0], (2,)]),
}


@pytest.mark.parametrize("name", CHECKS)
def test_right_values_pass_and_wrong_ones_are_told_in_one_line(name):
    check, right, wrong = CHECKS[name]
    for value in right:
        assert check(value) is None
    for value in wrong:
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            check(value)


@pytest.mark.parametrize(
    ("check", "value", "told"),
    [
        ("positive", [1.0, -2.0, -3.0], "x = -2.0: must be greater than 0"),
        ("probabilities", [0.5, 0.75], "sum of x = 1.25: must be 1"),
        ("number", 200 * "y", f"x = '{199 * 'y'}...: must be a whole number greater than 0"),
        ("number", 198 * "y", f"x = '{198 * 'y'}': must be a whole number greater than 0"),
        ("type", Config(), "x = Config: must be Belief, as made"),
        ("type", Belief, "x = <class 'jaxsense.core.types.Belief'>: must be Belief, as made"),
        ("members", Legs, "x = Legs: must be a Walker, not its class"),
        ("members", 3, "x = int: must be a Walker; it lacks walk"),
        ("modality", 2, "modality = 2: must be 0 (x) or 1 (y)"),
        ("one each", 3, "x = 3: must hold 2, one for each of ('x', 'y')"),
        ("one each", [1.0], "x has 1 entries: must be 2, one for each of ('x', 'y')"),
    ],
)
def test_what_is_wrong_is_told_with_what_would_be_right(check, value, told):
    with pytest.raises(ValueError, match=f"^{re.escape(told)}$"):
        CHECKS[check][0](value)


def test_numbers_that_are_traced_are_unknown():
    for check, wrong in ((checks.require_positive, -1.0), (checks.require_probabilities, 2.0)):
        assert jax.jit(lambda x, check=check: check("x", x) or x)(wrong) == wrong


@checks.typed
def go(key, config: Config, walker: Walker, speed: float = 1.0):
    return speed


def test_arguments_are_of_the_dataclasses_and_protocols_of_their_annotations():
    key, config, walker = jax.random.key(0), Config(), Legs()
    assert go(key, config, walker=walker, speed="any") == "any"
    for wrong in ((0, config, walker), (key, Config, walker), (key, config, 3)):
        with pytest.raises(ValueError, match=r"^(key|config|walker) = "):
            go(*wrong)


@pytest.mark.parametrize(
    ("shape", "right", "wrong", "expected"),
    [
        ((2,), (2,), (3,), "x has the shape (3,): must be (2,)"),
        ((2,), (2,), (4, 2), "(4, 2): must be (2,)"),
        ((2, None), (2, 7), (2,), "(2,): must be (2, any)"),
        ((None, 3), (0, 3), (2, 4), "(2, 4): must be (any, 3)"),
        ((3, ...), (3, 1, 4), (), "(): must be (3, ...)"),
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


@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_one_key_of_several(make):
    checks.require_key(make(0))
    checks.require_key(np.asarray(jax.random.PRNGKey(0)))  # as from a file
    keys = jax.random.split(make(0), 3)
    for wrong, told in (
        (7, "key = 7: must be one key"),
        (np.zeros(2, np.float32), "key of float32[2]: must be one key"),
        (jnp.uint32(7), "key of uint32[]: must be one key"),
        (keys, "key holds (3,) keys: must be one key"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(told)}"):
            checks.require_key(wrong)
    jax.vmap(checks.require_key)(keys)
    jax.jit(checks.require_key)(keys[0])
    with pytest.raises(ValueError, match=r"use jax\.vmap for a batch"):
        jax.jit(checks.require_key)(keys)


def test_only_files_of_a_directory_that_are_small_enough_are_read(tmp_path, monkeypatch):
    there, file = tmp_path / "there", tmp_path / "x"
    there.mkdir()
    file.write_bytes(b"1234")
    assert inside.read(file, most=4) == b"1234"
    (there / "link").symlink_to(file)
    os.mkfifo(there / "pipe")
    for path, most, told in (
        (file, 3, "Larger than 3 bytes"),
        (there / "link", 4, "Leads out"),
        (there / "pipe", 4, "Not a regular file"),
        (there, 2**20, "Is a directory"),
    ):
        with pytest.raises(OSError, match=told):
            inside.read(path, most)
    for name in ("b.txt", "a.txt", "a\n.txt", "c.md"):
        (there / name).write_bytes(b"12")
    monkeypatch.setattr(inside, "LARGEST", 4)
    assert [path.name for path in inside.matching(there, "*.txt")] == ["a.txt", "b.txt"]
    monkeypatch.setattr(inside, "LARGEST", 3)
    with pytest.raises(OSError, match="Larger than 3 bytes"):
        inside.matching(there, "*.txt")
    (tmp_path / "outside").symlink_to("/")
    with pytest.raises(OSError, match="Leads out"):
        inside.matching(tmp_path, "outside/*.txt")

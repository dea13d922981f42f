"""Graphs of ONNX operators compute what JAX computes, with onnxruntime."""

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from jaxsense.interfaces.graph import Constants, as_onnx
from jaxsense.interfaces.translate import arrays_of, program

WEIGHTS = {"w": np.arange(6, dtype=np.float32).reshape(2, 3) / 5}
FLOATS = ("float32", ("n", 3))
X = np.array([[0.5, -1.0, 2.0], [0.0, 3.0, -0.25]], np.float32)


def played(apply, inputs, *given):
    """Outputs of a function by onnxruntime as it optimises by default."""
    constants = Constants(arrays_of(WEIGHTS))
    found = program(apply, WEIGHTS, inputs, constants)
    by_name = dict(zip(inputs, map(np.asarray, given), strict=True))
    file = as_onnx("test", "", found.graph, constants.arrays, found.outputs)
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    return dict(zip(found.outputs, session.run([*found.outputs], by_name), strict=True))


def check(function, *given, inputs=None):
    """A function of arrays, for the given ones and for more rows of the first."""
    named = inputs or {"x": FLOATS}

    def apply(models, *arrays):
        del models
        return {"y": function(*arrays)}

    expected = np.asarray(function(*map(jnp.asarray, given)))
    found = played(apply, named, *given)
    assert found["y"].dtype == expected.dtype
    np.testing.assert_allclose(found["y"], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x**-2 + jnp.tanh(x) * jax.nn.sigmoid(x),
        lambda x: jnp.arctan2(x - 0.5, jnp.append(x[:, 1:], x[:, :1], axis=1)),
        lambda x: jnp.round(x).astype(jnp.int32) // 2,
        lambda x: jnp.fmod(x, 0.75),
        lambda x: jnp.isfinite(x / x) & ~(x < 0),
        lambda x: jnp.where(x > 0, x > 1, x < -0.5),
        lambda x: jnp.clip(x, -0.5, 1.0),
        lambda x: jnp.argmin(x, axis=1),
        lambda x: jnp.any(x > 2, axis=0),
        lambda x: jnp.mean(x, axis=0),
        lambda x: jnp.max(x) - jnp.min(x, axis=1),
        lambda x: jnp.stack(jnp.split(x, 3, axis=1)),
        lambda x: jnp.append(x[:, 0], x[-1, 1:]),
        lambda x: jnp.broadcast_to(jnp.arange(x.shape[0])[:, None], (x.shape[0], 2)),
        lambda x: (x[:, None] * x[None]).reshape(-1),
        lambda x: jnp.diagonal(x @ x.T),
    ],
)
def test_numbers_and_shapes(function):
    check(function, X)
    check(function, np.concatenate([X, 2 * X]))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x.T @ jnp.ones(x.shape[0]),  # a transposed matrix and a vector
        lambda x: jnp.ones(x.shape[0]) @ x,
        jax.vmap(lambda row: jnp.outer(row, row) @ row),
        lambda x: jnp.einsum("ij,kj,lj->ikl", x, x, x),
    ],
)
def test_products(function):
    check(function, X)


def test_a_matrix_that_is_no_constant_and_a_vector():
    # onnxruntime 1.32 fuses their product with the transposition, wrongly.
    def function(x, z):
        return (x * 2.0).T @ z

    check(function, X, X[:, 0], inputs={"x": FLOATS, "z": ("float32", ("n",))})


INDEXED = {"x": FLOATS, "i": ("int32", ("k",))}


@pytest.mark.parametrize(
    "function",
    [
        lambda x, i: x[i],
        lambda x, i: x[i[0]],
        lambda x, i: x[:, i[1]],
        lambda x, i: x[i, i + 1],
        lambda x, i: jax.vmap(lambda row: x[row, :2])(i),
        lambda x, i: jax.vmap(lambda row: jax.lax.dynamic_slice(x, (row, row), (1, 2)))(i),
        lambda x, i: jax.lax.dynamic_slice(x, (i[1], i[1]), (1, 2)),
        lambda x, i: jax.lax.dynamic_slice(x, (i[1] - 9, i[1]), (1, 2)),  # moves inside
        lambda x, i: x.at[i[1]].set(7.0),
        lambda x, i: x.at[:, i[1]].add(7.0),
        lambda x, i: x.at[i[1] + 5].set(7.0),  # does not exist
        lambda x, i: (x > 0).at[i[1]].set(True),
    ],
)
def test_indices(function):
    check(function, X, np.int32([1, 0]), inputs=INDEXED)
    check(function, X, np.int32([0, 1]), inputs=INDEXED)


def test_an_index_for_each_row():
    def function(x, i):
        return jax.vmap(lambda row, j: row[j])(x, i)

    check(function, X, np.int32([2, 1]), inputs={"x": FLOATS, "i": ("int32", ("n",))})


@pytest.mark.parametrize("number", [0, 1, 4])
def test_loops_and_branches(number):
    inputs = {"x": FLOATS, "i": ("int32", ())}

    def scan(x, i):
        end, rows = jax.lax.scan(lambda c, row: (c + row[0] * i, c), jnp.float32(1), x)
        return jnp.append(rows, end)

    def loop(x, i):
        return jax.lax.fori_loop(0, i, lambda k, c: c * 2 + k * x[0, 0], x)

    def branch(x, i):
        return jax.lax.cond(i > 0, lambda: x + 1, lambda: x * 2)

    for function in (scan, loop, branch):
        check(function, X, np.int32(number), inputs=inputs)


def test_weights_keep_their_names():
    constants = Constants(arrays_of(WEIGHTS))
    found = program(lambda m, x: {"y": x @ m["w"].T}, WEIGHTS, {"x": FLOATS}, constants)
    assert "w" in found.graph.read()
    assert found.outputs == {"y": ("float32", ("n", 2))}


def test_what_nobody_reads_is_left_out_and_the_same_is_computed_once():
    def twice(models, x):
        return {"y": (jnp.exp(x) + jnp.exp(x), jnp.log(x))[0]}

    found = program(twice, WEIGHTS, {"x": FLOATS}, Constants({}))
    assert [node.operator for node in found.graph.nodes] == ["Exp", "Add"]
    with pytest.raises(NotImplementedError, match="primitive sin has no ONNX translation"):
        program(lambda m, x: {"y": jnp.sin(x)}, WEIGHTS, {"x": FLOATS}, Constants({}))


def test_a_size_without_translation_is_refused():
    def halves(models, x):
        return {"y": jnp.zeros((x.shape[0] // 2, 3)) + x.shape[0]}

    with pytest.raises(NotImplementedError, match=r"the size .* has no ONNX translation"):
        program(halves, WEIGHTS, {"x": FLOATS}, Constants({}))


def from_the_end(x):
    return jax.lax.scan(lambda total, row: (total + row, total), x[0], x[:2], reverse=True)[1]


def one_of_three(x):
    branches = [lambda x: x, lambda x: 2 * x, lambda x: 3 * x]
    return jax.lax.switch(x[0, 0].astype(jnp.int32), branches, x)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: ~x.astype(jnp.int32), "Not of bits"),
        (lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO), "rounding away"),
        (lambda x: jax.lax.select_n(x.astype(jnp.int32) % 3, x, 2 * x, 3 * x), "a choice among"),
        (one_of_three, "a choice among"),
        (lambda x: x.at[0, jnp.argmax(x[0])].get(mode="fill", fill_value=0.0), "gather that fills"),
        (lambda x: x.at[x[0].astype(jnp.int32)].set(0.0), "scatter of several rows"),
        (from_the_end, "a scan from the end"),
    ],
)
def test_what_has_no_translation_is_refused(function, reason):
    rows = "float32", (3, 3)
    with pytest.raises(NotImplementedError, match=f"{reason}.* has no ONNX translation"):
        program(lambda m, x: {"y": function(x)}, WEIGHTS, {"x": rows}, Constants({}))

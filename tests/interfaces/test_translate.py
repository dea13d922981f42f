"""Graphs of ONNX operators compute what JAX computes, with onnxruntime."""

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from jax import export

from jaxsense.interfaces.translate import program

WEIGHTS = {"w": np.arange(6, dtype=np.float32).reshape(2, 3) / 5}
N, K = export.symbolic_shape("n, k", constraints=["n >= 1", "k >= 1"])
X = np.array([[0.5, -1.0, 2.0], [0.0, 3.0, -0.25]], np.float32)
INDICES = np.int32([1, 0])


def translated(function, **inputs):
    structs = {name: jax.ShapeDtypeStruct(*each) for name, each in inputs.items()}
    return program("test", lambda _, *x: {"y": function(*x)}, WEIGHTS, structs)[0]


def check(function, *given, shapes=((N, 3), (K,)), also=()):
    """A function of arrays, by onnxruntime as it optimises by default; also of other arrays."""
    names = "xi"[: len(given)]
    inputs = {n: (s, x.dtype) for n, x, s in zip(names, given, shapes, strict=False)}
    file, providers = translated(function, **inputs), ["CPUExecutionProvider"]
    session = onnxruntime.InferenceSession(file, providers=providers)
    for each in (given, *also):
        (found,) = session.run(["y"], dict(zip(names, each, strict=True)))
        expected = np.asarray(function(*map(jnp.asarray, each)))
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x**-2 + jnp.tanh(x) * jax.nn.sigmoid(x),
        lambda x: jnp.arctan2(x - 0.5, jnp.append(x[:, 1:], x[:, :1], axis=1)),
        lambda x: jnp.arctan2(x, x * jnp.array([[0.0, -1.0, -0.0]])),
        lambda x: jnp.round(x).astype(jnp.int32) // 2,
        lambda x: jnp.fmod(x, 0.75),
        lambda x: jnp.isfinite(x / x) & ~(x < 0),
        lambda x: jnp.where(x > 0, x > 1, x < -0.5),
        lambda x: jnp.clip(x, -0.5, 1.0),
        lambda x: jnp.argmin(x, axis=1),
        lambda x: jnp.any(x > 2, axis=0) | jnp.all(x < 2.5, axis=0),
        lambda x: jnp.max(x) - jnp.min(x, axis=1) + jnp.mean(x),
        lambda x: jnp.stack(jnp.split(x, 3, axis=1)),
        lambda x: jnp.append(x[:, 0], x[-1, ::2]),
        lambda x: jnp.broadcast_to(jnp.arange(x.shape[0])[:, None], (x.shape[0], 2)),
        lambda x: (x[:, None] * x[None]).reshape(-1),
        lambda x: (x @ x.T)[jnp.arange(x.shape[0]), jnp.arange(x.shape[0])],
        lambda x: x.T @ jnp.ones(x.shape[0]),  # a transposed matrix and a vector
        lambda x: jnp.ones(x.shape[0]) @ x,
        jax.vmap(lambda row: jnp.outer(row, row) @ row),
        lambda x: jnp.einsum("ij,kj,lj->ikl", x, x, x),
        lambda x: jnp.zeros((x.shape[0] ** 2 - 1, 2 * x.shape[0])),
    ],
)
def test_functions_of_numbers_and_shapes(function):
    check(function, X, also=[(np.concatenate([X, 2 * X]),)])


def test_a_matrix_that_is_no_constant_and_a_vector():
    # onnxruntime 1.32 fuses their product with the transposition, wrongly.
    check(lambda x, z: (x * 2.0).T @ z, X, X[:, 0], shapes=((N, 3), (N,)))


@pytest.mark.parametrize(
    "function",
    [
        lambda x, i: x[i],
        lambda x, i: x[i[0]],
        lambda x, i: x[:, i[1]],
        lambda x, i: x[i, i + 1],
        lambda x, i: x[i[0], i[1]],
        lambda x, i: (x > 0)[i],
        lambda x, i: jax.vmap(lambda row: x[row, :2])(i),
        lambda x, i: jax.vmap(lambda row: jax.lax.dynamic_slice(x, (row, row), (1, 2)))(i),
        lambda x, i: jax.lax.dynamic_slice(x, (i[1], i[1]), (1, 2)),
        lambda x, i: jax.lax.dynamic_slice(x, (i[1] - 9, i[1]), (1, 2)),  # moves inside
        lambda x, i: x.at[i[1]].set(7.0),
        lambda x, i: x.at[:, i[1]].set(7.0),
        lambda x, i: x.at[i[1] + 5].set(7.0),  # does not exist
        lambda x, i: (x > 0).at[i[1]].set(True),
    ],
)
def test_indices(function):
    check(function, X, INDICES, also=[(X, INDICES[::-1])])


def test_an_index_for_each_row():
    function = jax.vmap(lambda row, j: row[j])
    check(function, X, np.int32([2, 1]), shapes=((N, 3), (N,)))


@pytest.mark.parametrize("number", [0, 1, 4])
def test_loops(number):
    def scan(x, i):
        end, rows = jax.lax.scan(lambda c, row: (c + row[0] * i, c), jnp.float32(1), x)
        return jnp.append(rows, end)

    check(scan, X, np.array(number, np.int32), shapes=((N, 3), ()))


def test_weights_keep_their_names_and_what_nobody_reads_is_left_out():
    def twice(models, x):
        return {"y": (2 * jnp.exp(x @ models["w"].T), jnp.log(x))[0]}

    inputs = {"x": jax.ShapeDtypeStruct((N, 3), jnp.float32)}
    file, outputs = program("test", twice, WEIGHTS, inputs)
    graph = onnx.load_model_from_string(file).graph
    operators = {node.op_type for node in graph.node}
    assert "Exp" in operators
    assert "Log" not in operators
    assert "w" in {each.name for each in graph.initializer}
    assert str(outputs["y"].shape) == "(n, 2)"


def from_the_end(x):
    return jax.lax.scan(lambda total, row: (total + row, total), x[0], x, reverse=True)[1]


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (jnp.sin, "the primitive sin"),
        (lambda x: jnp.zeros(x.shape[0] // 2), "the size"),
        (lambda x: jax.lax.round(x, jax.lax.RoundingMethod.AWAY_FROM_ZERO), "rounding away"),
        (lambda x: jax.lax.select_n(x.astype(jnp.int32) % 3, x, 2 * x, 3 * x), "a choice among"),
        (lambda x: jax.lax.cond(x[0, 0] > 0, jnp.exp, jnp.log, x), "the primitive cond"),
        (lambda x: x.at[0, jnp.argmax(x[0])].get(mode="fill", fill_value=0.0), "gather that fills"),
        (lambda x: x.at[x[:, 0].astype(jnp.int32)].set(0.0), "scatter of several rows"),
        (from_the_end, "a scan from the end"),
        (lambda x: x.astype(jnp.int32) & 1, "the primitive and of int32"),
        (lambda x: x + jax.random.normal(jax.random.key(0), (1, 3)), "the primitive"),
    ],
)
def test_what_has_no_translation_is_refused(function, reason):
    with pytest.raises(NotImplementedError, match=f"{reason}.* has no ONNX translation"):
        translated(function, x=((N, 3), jnp.float32))

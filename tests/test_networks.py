"""The one network, for rows and for columns."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense import networks


def test_a_network_as_worked_by_hand():
    params = {
        "params": {
            "Dense_0": {"kernel": jnp.array([[1.0, -1.0], [2.0, 0.0]]), "bias": jnp.ones(2)},
            "Dense_1": {"kernel": jnp.array([[3.0], [1.0]]), "bias": jnp.array([-2.0])},
        }
    }
    # (1, 2): hidden (1 + 4 + 1, -1 + 1) = (6, 0), output 18 - 2.
    # (-1, -1): hidden (-1 - 2 + 1, 1 + 1), of which the first is cut to 0: output 2 - 2.
    x = jnp.array([[1.0, 2.0], [-1.0, -1.0]])
    rows = networks.MLP((2,), 1).apply(params, x)
    np.testing.assert_allclose(np.asarray(rows), [[16.0], [0.0]])
    np.testing.assert_allclose(networks.apply_to_columns(params, x.T), [[16.0, 0.0]])


def test_columns_give_what_rows_give():
    network = networks.MLP((8, 5), 3)
    params = network.init(jax.random.key(0), jnp.zeros(4))
    x = jax.random.normal(jax.random.key(1), (7, 4))
    rows = network.apply(params, x)
    columns = networks.apply_to_columns(params, x.T)
    np.testing.assert_allclose(columns.T, rows, rtol=1e-5, atol=1e-6)

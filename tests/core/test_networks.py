"""The one network, for an example and for columns of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.core import networks


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
    network = networks.MLP((2,), 1)
    np.testing.assert_allclose(network.apply(params, x[0]), [16.0])
    np.testing.assert_allclose(network.apply(params, x.T), [[16.0, 0.0]])


def test_parameters_are_those_of_flax():
    # What a run has saved must be read by those who know flax alone.
    layers = networks.init(jax.random.key(0), networks.MLP((64, 64), 3), 40)["params"]
    shapes = {name: {n: x.shape for n, x in layer.items()} for name, layer in layers.items()}
    assert shapes == {
        "Dense_0": {"kernel": (40, 64), "bias": (64,)},
        "Dense_1": {"kernel": (64, 64), "bias": (64,)},
        "Dense_2": {"kernel": (64, 3), "bias": (3,)},
    }
    # He's variance where ReLU follows, LeCun's at the end; no bias.
    assert np.std(layers["Dense_1"]["kernel"]) == pytest.approx((2 / 64) ** 0.5, rel=0.05)
    assert np.std(layers["Dense_2"]["kernel"]) == pytest.approx((1 / 64) ** 0.5, rel=0.15)
    assert not np.any(layers["Dense_0"]["bias"])


def test_inputs_are_standardised_by_each_mean_and_one_deviation():
    # Means 2 and 4, from which the numbers differ by 1, 1, 2 and 2.
    offset, scale = networks.statistics(jnp.array([[1.0, 2.0], [3.0, 6.0]]))
    np.testing.assert_array_equal(offset, [2.0, 4.0])
    assert scale == pytest.approx(2.5**0.5)
    assert networks.statistics(jnp.ones((3, 2)))[1] > 0


def test_the_last_layer_is_scaled_as_a_whole_or_output_by_output():
    network = networks.MLP((4,), 2)
    params = networks.init(jax.random.key(0), network, 3)
    before = network.apply(params, jnp.ones(3))
    for factor in (0.25, jnp.array([2.0, -1.0])):
        found = network.apply(networks.scale_last(network, params, factor), jnp.ones(3))
        np.testing.assert_allclose(found, factor * before, rtol=1e-6)

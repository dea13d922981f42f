"""What a stage tells the outside: time, progress and bad ends."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsense.monitor import Monitor, StageError


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_first_step_with_a_loss_that_is_not_finite_is_named(value):
    # Steps 5 to 8 of 12; the third of them, step 7, is the first bad one.
    losses = np.array([1.0, 1.0, value, np.nan])
    with pytest.raises(StageError, match=rf"dqn_camera: loss = {value} at step 7 of 12"):
        Monitor().report("dqn_camera", 8, 12, losses)


def test_parameters_that_are_not_finite_are_named():
    Monitor().check_finite("jmvae", {"a": jnp.ones(2), "b": jnp.zeros(3)})
    with pytest.raises(StageError, match="jmvae: parameters are not finite after the last step"):
        Monitor().check_finite("jmvae", {"a": jnp.ones(2), "b": jnp.array([0.0, jnp.nan])})

"""A JMVAE whose weights are set by hand, and detections that it knows."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import Config, DqnConfig, JmvaeConfig, MdpConfig
from jaxsense.config.learning import EvaluationConfig
from jaxsense.core.types import Belief
from jaxsense.models import make_in_place
from jaxsense.training.detections import Detections

# Classes: green cylinder, red cylinder, red cube. Three latent dimensions, of which one is unused.
CONFIG = Config(
    jmvae=JmvaeConfig(latent_size=3, hidden=(4,)),
    mdp=MdpConfig(min_increase=0.0, max_steps=8),
    dqn=DqnConfig(task="map", hidden=(2,)),
    evaluation=EvaluationConfig(num_starts=16, num_repeats=8),
)
KEY = jax.random.key(0)
GREEN, CUBE = 1, 1  # where features (red, green) and (cylinder, cube) hold them
LN4, LN25, LN26 = np.log([4.0, 25.0, 26.0])


def network(inputs, outputs, weights, bias=()):
    """A hidden layer that passes on what is not negative, then outputs by their weights.

    Args:
      inputs: number of inputs.
      outputs: number of outputs.
      weights: `{(input, output): weight}`.
      bias: `{output: bias}`.
    """
    kernel = np.zeros((4, outputs), np.float32)
    for place, weight in weights.items():
        kernel[place] = weight
    biases = np.zeros(outputs, np.float32)
    for output, each in dict(bias).items():
        biases[output] = each
    hidden = {"kernel": np.eye(inputs, 4, dtype=np.float32), "bias": np.zeros(4, np.float32)}
    last = {"kernel": kernel, "bias": biases}
    return {"params": {"Dense_0": hidden, "Dense_1": last}}


PARAMS = {
    "encoders": {
        # (10 green, 10 cube, 0), of deviation 1, but 2 in two dimensions for a cube.
        "camera+lidar": network(
            4, 6, {(GREEN, 0): 10, (2 + CUBE, 1): 10, (3, 3): LN4, (3, 4): LN4}
        ),
        # Green is class 0; red lies between the classes 1 and 2, in the second dimension.
        "camera": network(2, 6, {(GREEN, 0): 10, (0, 1): 5, (0, 4): LN25}),
        # A cube is class 2; a cylinder lies between the classes 0 and 1, in the first.
        "lidar": network(2, 6, {(CUBE, 1): 10, (0, 0): 5, (0, 3): LN26, (CUBE, 4): LN4}),
    },
    "decoders": {
        "camera": network(3, 2, {(0, GREEN): 0.1}),
        # Wrong by .6: too much of a cube.
        "lidar": network(3, 2, {(1, CUBE): 0.1}, {CUBE: 0.6}),
    },
}
# Two looks at each class. The second LiDAR look at class 0 tells half a cylinder.
CAMERA = jnp.array([[[0, 1], [0, 1]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]], jnp.float32)
LIDAR = jnp.array([[[1, 0], [0.5, 0]], [[1, 0], [1, 0]], [[0, 1], [0, 1]]], jnp.float32)
BANK = (CAMERA, LIDAR)
# One look at each class.
EXACT = tuple(x[:, :1] for x in BANK)
CLASS_MEANS = jnp.array([[10.0, 0, 0], [0, 0, 0], [0, 10, 0]])


def detections(bank=(), held_out=()):
    """Detections of which no window is stored."""
    return Detections(bank, held_out, windows=(), by_distance=None)


def in_place(means=CLASS_MEANS):
    return make_in_place(CONFIG, PARAMS, Belief(means, jnp.ones((3, 3))))

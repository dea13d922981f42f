"""Fusion as a filter: one update for each look, any number of looks in any order.

The JMVAE's alpha term draws the posterior of each subset of the modalities to the joint one. Taken
from subsets to whole histories of looks, it is `E[sum_t KL(q*_c || q_t)]`: q*_c is the joint
posterior of the true class c, and q_t the belief after t looks. Among Gaussians this divergence is
least where q_t has the moments of the mixture `sum_c w_c q*_c` whose weights are the classes'
probabilities after the looks. So the mean shows which classes are open, and the width how much
doubt there is. The weights follow from the moments again: a belief is a sufficient memory.
"""

import chex
import jax
import jax.numpy as jnp

from jaxsense.config import FilterConfig
from jaxsense.core import checks, networks, supervised
from jaxsense.core.networks import MLP, Params
from jaxsense.core.supervised import FitState
from jaxsense.core.types import Belief, Key
from jaxsense.vae import gaussian
from jaxsense.vae.jmvae import Jmvae

LEAST_WEIGHT = 1e-5
"""Least probability of a class that a belief can hold in float32."""
_LEAST_FEATURE = 1e-6


def init(key: Key, model: Jmvae, classes: Belief, unseen: Belief, config: FilterConfig) -> Params:
    """Parameters of an untrained filter.

    Args:
      key: random key.
      model: shape of the JMVAE.
      classes: `[C, D]` joint posterior of each class.
      unseen: `[D]` entry of an unseen PoI.
      config: sizes of the networks.

    Returns:
      A dictionary of the `classes`, the `inverse` of `moments_inverse`, `unseen`, and one of the
      `networks` for each modality.
    """
    chex.assert_shape(classes.mean, (None, model.latent_size), custom_message="classes.mean")
    chex.assert_shape(classes.std, classes.mean.shape, custom_message="classes.std")
    chex.assert_shape(unseen.mean, (model.latent_size,), custom_message="unseen.mean")
    chex.assert_shape(unseen.std, (model.latent_size,), custom_message="unseen.std")
    number = len(classes.mean)
    return {
        "classes": classes,
        "inverse": moments_inverse(classes),
        "unseen": unseen,
        "networks": {
            name: networks.init(k, MLP(config.hidden, number), size)
            for k, name, size in zip(
                jax.random.split(key, len(model.modalities)),
                model.modalities,
                model.feature_sizes,
                strict=True,
            )
        },
    }


def update(
    params: Params, model: Jmvae, belief: Belief, features: jax.Array, modality: int
) -> Belief:
    """The belief after one more look.

    Args:
      params: of the filter.
      model: shape of the JMVAE.
      belief: `[D]` before the look, from `fusion.unseen` or an earlier update.
      features: `[D_m]` probabilities of the labels.
      modality: index of the sensor.

    Raises:
      ValueError: if there is no such modality, features are no probabilities, or a belief is not
        finite or not positive.
    """
    checks.require_index("modality", modality, len(model.modalities))
    size = (model.feature_sizes[modality],)
    chex.assert_shape(features, size, custom_message=f"features of {model.modalities[modality]}")
    checks.require_probabilities("features", features)
    chex.assert_shape(belief.mean, (model.latent_size,), custom_message="belief.mean")
    chex.assert_shape(belief.std, (model.latent_size,), custom_message="belief.std")
    found = evidence(params, model, features, modality)
    prior = jnp.log(weights(params, belief))
    return mixture(params["classes"], jax.nn.softmax(prior + found))


def evidence(params: Params, model: Jmvae, features: jax.Array, modality: int) -> jax.Array:
    """What a look adds to the logarithm of each class's weight, `[C]` of `[D_m]` features.

    Or `[C, B]` of `[D_m, B]`.
    """
    checks.require_index("modality", modality, len(model.modalities))
    hidden = tuple(
        layer["bias"].shape[0]
        for name, layer in sorted(_layers(params, model, modality).items())[:-1]
    )
    network = MLP(hidden, len(params["classes"].mean))
    logarithm = jnp.log(jnp.maximum(features, _LEAST_FEATURE))
    return networks.apply(network, params["networks"][model.modalities[modality]], logarithm)


def _layers(params: Params, model: Jmvae, modality: int) -> Params:
    return params["networks"][model.modalities[modality]]["params"]


def mixture(classes: Belief, weights: jax.Array) -> Belief:
    """The Gaussian with the moments of a mixture of the classes.

    Args:
      classes: `[C, D]` joint posterior of each class.
      weights: `[C]` of sum 1.
    """
    chex.assert_shape(weights, classes.mean.shape[:1], custom_message="weights")
    checks.require_probabilities("weights", weights)
    mean = weights @ classes.mean
    spread = classes.std**2 + (classes.mean - mean[None]) ** 2
    return Belief(mean, jnp.sqrt(weights @ spread))


def _moments(belief: Belief) -> jax.Array:
    """`[..., 2D + 1]` mean, mean square, and 1, all linear in the weights of a mixture."""
    square = belief.std**2 + belief.mean**2
    one = jnp.ones((*belief.mean.shape[:-1], 1))
    return jnp.concatenate([belief.mean, square, one], axis=-1)


def moments_inverse(classes: Belief) -> jax.Array:
    """`[C, 2D + 1]` linear map from the moments of a mixture of `[C, D]` classes to its weights.

    With more than `2D + 1` classes the weights do not follow from the moments; the map takes those
    of least squares.
    """
    return jnp.linalg.pinv(_moments(classes).T)


def weights(params: Params, belief: Belief) -> jax.Array:
    """The classes' probabilities that a belief holds.

    Args:
      params: of the filter; only `inverse` and `unseen` are used.
      belief: `[D]`. That of an unseen PoI leaves all classes equally likely.

    Returns:
      `[C]` probabilities of `LEAST_WEIGHT` at least.
    """
    checks.require_finite("belief.mean", belief.mean)
    checks.require_positive("belief.std", belief.std)
    found = jnp.maximum(params["inverse"] @ _moments(belief), LEAST_WEIGHT)
    unseen = params["unseen"]
    apart = jnp.maximum(jnp.abs(belief.mean - unseen.mean), jnp.abs(belief.std - unseen.std))
    # Another program may have rounded the same entry otherwise.
    is_unseen = jnp.all(apart <= 1e-5 * unseen.std)
    return jnp.where(is_unseen, 1 / len(found), found / jnp.sum(found))


def entropy(weights: jax.Array) -> jax.Array:
    """Entropy of `[..., C]` probabilities, `[...]` in nats."""
    return -jnp.sum(jax.scipy.special.xlogy(weights, weights), axis=-1)


def start(params: Params, config: FilterConfig) -> FitState:
    """The state before the first gradient step: the networks alone are trained."""
    return supervised.start(params["networks"], supervised.adam(config.learning_rate, config.steps))


def train(
    key: Key,
    state: FitState,
    params: Params,
    model: Jmvae,
    bank: tuple[jax.Array, ...],
    config: FilterConfig,
    steps: int,
) -> tuple[FitState, jax.Array]:
    """Trains a filter on random histories of looks for some gradient steps.

    Args:
      key: random key.
      state: from `start` or an earlier call; its parameters are the filter's `networks`.
      params: from `init`.
      model: shape of the JMVAE.
      bank: for each modality `[C, S, D_m]` detections of every class.
      config: looks of a history, batch, learning rate, and the steps of the whole training.
      steps: how many of them to take.

    Returns:
      The next state and the `[steps]` losses.
    """
    checks.require_one_each("bank", bank, model.modalities)
    classes = params["classes"]

    def loss(of_networks: Params, drawn, step: jax.Array) -> jax.Array:
        del step
        true_class, sensor, looks = drawn
        trained = {**params, "networks": of_networks}
        flat = [evidence(trained, model, x.reshape(len(x), -1), m) for m, x in enumerate(looks)]
        found = jnp.stack(flat).reshape(len(bank), -1, *sensor.shape)
        is_used = sensor[None, None] == jnp.arange(len(bank))[:, None, None, None]
        added = jnp.sum(jnp.where(is_used, found, 0.0), axis=0)
        shares = jax.nn.softmax(jnp.cumsum(added, axis=1), axis=0)
        beliefs = jax.vmap(jax.vmap(lambda w: mixture(classes, w), -1, -1), -1, -1)(shares)
        truth = jax.tree.map(lambda x: x[true_class].T[:, None], classes)
        return jnp.mean(_divergence(truth, beliefs))

    drawn = _draw(key, bank, (steps, config.looks, config.batch))
    optimiser = supervised.adam(config.learning_rate, config.steps)
    return supervised.fit(state, loss, drawn, optimiser, config.steps)


def _divergence(truth: Belief, beliefs: Belief) -> jax.Array:
    """`[T, B]` `KL(truth || belief)` of `[D, 1, B]` and `[D, T, B]` Gaussians."""
    shape = beliefs.mean.shape
    parts = (truth.mean, 2 * jnp.log(truth.std), beliefs.mean, 2 * jnp.log(beliefs.std))
    flat = [jnp.broadcast_to(part, shape) for part in parts]
    return jax.vmap(jax.vmap(gaussian.kl_divergence, -1, -1), -1, -1)(*flat)


def _draw(key: Key, bank: tuple[jax.Array, ...], shape: tuple[int, int, int]):
    """Classes `[steps, B]`, sensors `[steps, T, B]`, and each modality's `[steps, D_m, T, B]`."""
    class_key, sensor_key, *row_keys = jax.random.split(key, 2 + len(bank))
    steps, _, batch = shape
    classes = jax.random.randint(class_key, (steps, batch), 0, bank[0].shape[0])
    sensors = jax.random.randint(sensor_key, shape, 0, len(bank))
    looks = tuple(
        jnp.moveaxis(x[classes[:, None], jax.random.randint(k, shape, 0, x.shape[1])], -1, 1)
        for x, k in zip(bank, row_keys, strict=True)
    )
    return classes, sensors, looks

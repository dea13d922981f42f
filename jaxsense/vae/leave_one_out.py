"""The JMVAE on scans themselves, without detectors or labels: leave-one-out reconstruction.

A training example is one PoI at which every sensor has looked several times. Each look is decoded
from a latent that only the other looks have been encoded to, so the latent holds what the looks
share: what the PoI is. What they do not share, from where and in which light each was taken, is
left to the variance of the decoders. As in the JMVAE (Suzuki et al. 2017, Sec. 3.3), divergences
draw the posteriors of fewer looks to the posterior of all: of every single look, and of sets of one
look by each sensor. The posterior of several looks reads the means of what a network finds in each,
so it takes any number of looks by each sensor in any order.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxsense.config import JmvaeConfig
from jaxsense.core import networks
from jaxsense.core.networks import MLP, Params
from jaxsense.core.supervised import Problem
from jaxsense.core.types import Belief, Key, product, pytree
from jaxsense.vae import detectors, gaussian
from jaxsense.vae.detectors import Classifier
from jaxsense.vae.frames import Scaling
from jaxsense.vae.jmvae import Jmvae, annealed_beta
from jaxsense.vae.readout import Readout

_EMBEDDING = 64  # numbers that a network finds in a look
_FIRST_ALPHA = 0.1  # weight of divergences at first, with a fixed joint posterior
_ALPHA_START, _ALPHA_RAMP = 0.4, 0.2  # of the training
_LOG_VARIANCES = -10.0, 6.0
_TRIES, _MOVES = 16, 30  # of k-means

Drawn = tuple[jax.Array, jax.Array]
"""Rows `[steps, B]`, and noise `[steps, M, D, B, K]`."""

Groups = tuple[Float[Array, "P K _"], ...]
"""For each modality `[P, K, F_m]`: K looks at each of P PoIs, in the frame of the sensor."""


def init(key: Key, model: Jmvae) -> Params:
    """Random parameters, `{"encoders": {NAME: ...}, "embeddings", "decoders", "joint"}`."""
    number = len(model.modalities)
    joint_key, *keys = jax.random.split(key, 1 + 3 * number)

    def of_each(first: int, network: Callable[[int], MLP], sizes: Sequence[int]) -> Params:
        return {
            name: networks.init(keys[first * number + m], network(m), sizes[m])
            for m, name in enumerate(model.modalities)
        }

    return {
        "encoders": of_each(0, lambda _: model.encoder, model.feature_sizes),
        "embeddings": of_each(1, lambda _: _embedding(model), model.feature_sizes),
        "decoders": of_each(2, model.decoder, [model.latent_size] * number),
        "joint": networks.init(joint_key, _joint(model), number * _EMBEDDING),
    }


def _embedding(model: Jmvae) -> MLP:
    """The network from one look to what the posterior of several looks reads of it."""
    return MLP(model.hidden[:1], _EMBEDDING)


def _joint(model: Jmvae) -> MLP:
    """The network from the means of these to the posterior of all looks."""
    return MLP(model.hidden[-1:], 2 * model.latent_size)


def posterior(params: Params, model: Jmvae, looks: tuple[Float[Array, "K _"], ...]) -> Belief:
    """Posterior `q(z | all looks)` at one PoI, from `[K, F_m]` looks by each modality."""
    means = [
        jnp.mean(_embed(params, model, m, x.T), axis=1, keepdims=True) for m, x in enumerate(looks)
    ]
    mean, log_variance = _of_means(params, model, means)
    return Belief(mean[:, 0], jnp.exp(0.5 * log_variance[:, 0]))


def losses(
    noise: Float[Array, "M D B K"],
    params: Params,
    model: Jmvae,
    looks: Groups,
    *,
    alpha: Float[Array, ""] | float,
    beta: Float[Array, ""] | float,
    has_begun: Float[Array, ""] | float,
    reconstruction_weights: tuple[float, ...],
) -> Float[Array, " B"]:
    """Losses of a batch of PoIs.

    For each PoI with looks `x_mk`, `sum_mk -w_m / F_m log p(x_mk | z_mk)` up to a constant, with
    `z_mk` drawn from `q(z | all looks but x_mk)` and p a Gaussian of the variance at which the
    looks of the batch by this sensor are likeliest; plus `beta` times the divergences from the
    prior of the posterior of all looks and, as a mean over looks for each sensor, of these
    posteriors; plus `alpha` times the divergences of the posterior of all looks from those of
    single looks and of sets of one by each sensor.

    Args:
      noise: standard normal draws.
      model: its shape; the features of a modality are a look in the frame of its sensor.
      looks: K looks, two or more, by each sensor at each of B PoIs.
      alpha: weight of the divergences to the posteriors of fewer looks.
      beta: weight of the divergences from the prior.
      has_begun: from 0, where the divergences' gradient to the posterior of all looks is stopped,
        to 1.
    """
    number = looks[0].shape[1]
    columns = [jnp.moveaxis(x, -1, 0) for x in looks]  # [F, B, K]
    found = [_embed(params, model, m, x) for m, x in enumerate(columns)]
    means = [x.mean(axis=-1) for x in found]
    mean, log_variance = _of_means(params, model, means)
    total = beta * gaussian.kl_divergence(mean, log_variance)
    fixed = jax.lax.stop_gradient((mean, log_variance))

    def draws(mean_of_few: jax.Array, log_variance_of_few: jax.Array) -> jax.Array:
        few = mean_of_few, log_variance_of_few
        drawn = gaussian.kl_divergence(mean[..., None], log_variance[..., None], *few)
        follows = gaussian.kl_divergence(fixed[0][..., None], fixed[1][..., None], *few)
        weighted = has_begun * alpha * drawn + (1 - has_begun) * _FIRST_ALPHA * follows
        return jnp.sum(weighted, axis=-1)

    for m, x in enumerate(columns):
        left = (means[m][..., None] * number - found[m]) / (number - 1)
        others = [jnp.broadcast_to(each[..., None], left.shape) for each in means]
        others[m] = left
        mean_of_others, log_variance_of_others = _of_means(params, model, others)
        from_prior = gaussian.kl_divergence(mean_of_others, log_variance_of_others)
        total += beta * jnp.mean(from_prior, axis=-1)
        z = gaussian.sample(noise[m], mean_of_others, log_variance_of_others)
        name = model.modalities[m]
        decoded = _columns(model.decoder(m), params["decoders"][name], z)
        error = jnp.sum((x - decoded) ** 2, axis=0)
        # The variance is at its optimum, where its own gradient is 0.
        variance = jax.lax.stop_gradient(jnp.mean(error) / len(x))
        of_looks = jnp.sum(error, axis=-1) / (len(x) * variance) + number * jnp.log(variance)
        total += 0.5 * reconstruction_weights[m] * of_looks
        total += draws(*_split(_columns(model.encoder, params["encoders"][name], x)))
    return total + draws(*_of_means(params, model, found))


def problem(config: JmvaeConfig, groups: Groups, model: Jmvae) -> Problem[Drawn]:
    """The fit of the JMVAE to groups of looks, each sensor's in its frame."""

    def draw(key: Key, number: int) -> Drawn:
        row_key, noise_key = jax.random.split(key)
        batch, looks = config.batch, groups[0].shape[1]
        rows = jax.random.randint(row_key, (number, batch), 0, len(groups[0]))
        size = (number, len(groups), model.latent_size, batch, looks)
        return rows, jax.random.normal(noise_key, size)

    def loss(params: Params, drawn: Drawn, step: Int[Array, ""]) -> Float[Array, ""]:
        rows, noise = drawn
        share = step / config.steps
        of_each = losses(
            noise,
            params,
            model,
            tuple(x[rows] for x in groups),
            alpha=config.alpha,
            beta=annealed_beta(step, config),
            has_begun=jnp.clip((share - _ALPHA_START) / _ALPHA_RAMP, 0.0, 1.0),
            reconstruction_weights=config.reconstruction_weights,
        )
        return jnp.mean(of_each)

    return Problem(config.steps, config.learning_rate, draw, loss)


@pytree
class Encoder:
    """A detector that has learned without labels: the encoder of single looks.

    Attributes:
      params: of the encoder.
      scaling: the frame in which it sees windows.
      presence: a detector of one label, any PoI.
      readout: reads class probabilities from posteriors.
      prior: `[D]` belief before any look.
      sharpness: `[]` factor on the log-probabilities of the labels, see `calibrate`.
      label_of_class: label of each class, which names what it has learned.
    """

    params: Params
    scaling: Scaling
    presence: Classifier
    readout: Readout
    prior: Belief
    sharpness: Float[Array, ""]
    model: Jmvae = struct.field(pytree_node=False)
    label_of_class: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def num_labels(self) -> int:
        """D_m."""
        return max(self.label_of_class) + 1

    @property
    def window_size(self) -> int:
        """F."""
        return self.presence.window_size

    @property
    def threshold(self) -> Float[Array, ""]:
        """See `Detector`."""
        return self.presence.threshold

    def logits(self, window: Float[Array, " F"], distance: Float[Array, ""]) -> Float[Array, " O"]:
        """See `Detector.logits`; labels are read from the posterior of the look."""
        odds = self.presence.logits(window, distance)[-1:]
        return jnp.concatenate([self.sharpness * self._of_labels(window), odds])

    def _of_labels(self, window: Float[Array, " F"]) -> Float[Array, " D_m"]:
        output = networks.apply(self.model.encoder, self.params, self.scaling(window))
        mean, log_variance = _split(output)
        posterior = Belief(mean, jnp.exp(0.5 * log_variance))
        of_class = self.readout.class_probabilities(posterior, self.prior)
        has_label = jnp.array(self.label_of_class)[:, None] == jnp.arange(self.num_labels)[None]
        return jnp.log(jnp.sum(jnp.where(has_label, of_class[:, None], 0.0), axis=0))


def calibrate(encoder: Encoder, windows: Float[Array, "S F"], classes: Int[Array, " S"]) -> Encoder:
    """An encoder whose sharpness makes what all looks at the PoIs show most likely.

    A posterior is learned, so its moments are slightly off, and with them small probabilities.

    Args:
      encoder: trained.
      windows: single looks that nothing was trained on.
      classes: what all looks at their PoIs show together.
    """
    found = jax.vmap(encoder._of_labels, out_axes=-1)(windows)
    labels = jnp.array(encoder.label_of_class)[classes]
    return dataclasses.replace(encoder, sharpness=detectors.sharpness(found, labels))


def centres(key: Key, points: Float[Array, "S D"], number: int) -> Float[Array, "{number} D"]:
    """Centres of clusters: of several k-means (Lloyd 1982), those nearest to the points.

    Starts are spread as in k-means++ (Arthur and Vassilvitskii 2007).
    """
    found, far = jax.lax.map(lambda k: _k_means(k, points, number), jax.random.split(key, _TRIES))
    return found[jnp.argmin(far)]


def nearest(points: Float[Array, "S D"], centres: Float[Array, "K D"]) -> Int[Array, " S"]:
    """Index of the nearest centre to each point."""
    return jnp.argmin(_distances(points, centres), axis=1).astype(jnp.int32)


def named(
    members: Int[Array, " S"], classes: Int[Array, " S"], num_classes: int
) -> Int[Array, " C"]:
    """The cluster of each class, no two the same: those that share most points first.

    Args:
      members: cluster of each point.
      classes: class of each point.
      num_classes: C, the number of classes and of clusters; static.
    """
    counts = jnp.zeros((num_classes, num_classes), jnp.int32).at[classes, members].add(1)

    def name(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, found = carry
        poi_class, cluster = jnp.unravel_index(jnp.argmax(left), left.shape)
        left = left.at[poi_class].set(-1).at[:, cluster].set(-1)
        return left, found.at[poi_class].set(cluster)

    found = jnp.zeros(num_classes, jnp.int32)
    return jax.lax.fori_loop(0, num_classes, name, (counts, found))[1]


def _k_means(key: Key, points: jax.Array, number: int) -> tuple[jax.Array, jax.Array]:
    """Centres of one k-means, and the `[]` mean square distance of the points from them."""
    first_key, *keys = jax.random.split(key, number)
    chosen = points[jax.random.randint(first_key, (1,), 0, len(points))]
    for next_key in keys:
        far = jnp.min(_distances(points, chosen), axis=1)
        row = jax.random.categorical(next_key, jnp.log(far + 1e-12))
        chosen = jnp.concatenate([chosen, points[row][None]])

    def move(centres: jax.Array, _: None) -> tuple[jax.Array, None]:
        is_member = jax.nn.one_hot(nearest(points, centres), number)
        counts = jnp.sum(is_member, axis=0)[:, None]
        moved = product(is_member.T, points)
        return jnp.where(counts > 0, moved / jnp.maximum(counts, 1), centres), None

    found, _ = jax.lax.scan(move, chosen, None, _MOVES)
    return found, jnp.mean(jnp.min(_distances(points, found), axis=1))


def _distances(points: jax.Array, centres: jax.Array) -> jax.Array:
    """`[S, K]` squared distances."""
    return jnp.sum((points[:, None] - centres[None]) ** 2, axis=-1)


def _columns(network: MLP, params: Params, x: jax.Array) -> jax.Array:
    """Applies a network to `[F, ...]` with any number of examples."""
    found = networks.apply(network, params, x.reshape(len(x), -1))
    return found.reshape(-1, *x.shape[1:])


def _split(output: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and log-variance, `[D, ...]` each."""
    mean, log_variance = jnp.split(output, 2)
    return mean, jnp.clip(log_variance, *_LOG_VARIANCES)


def _embed(params: Params, model: Jmvae, m: int, x: jax.Array) -> jax.Array:
    of_modality = params["embeddings"][model.modalities[m]]
    return jax.nn.relu(_columns(_embedding(model), of_modality, x))


def _of_means(params: Params, model: Jmvae, means: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
    return _split(_columns(_joint(model), params["joint"], jnp.concatenate(means)))

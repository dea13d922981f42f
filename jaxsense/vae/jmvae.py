"""The joint multi-modal VAE (JMVAE) for any tuple of modalities.

Suzuki, Nakayama and Matsuo 2017, as used in Korthals et al. 2018, Sec. II. Every non-empty subset
of the modalities has an encoder, or only subsets up to a size and the full set. The encoder of the
full set is the joint encoder, to which a Kullback-Leibler divergence draws every other.
"""

import dataclasses
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsense.config import JmvaeConfig
from jaxsense.config.section import require_32_bits
from jaxsense.core import checks, networks, supervised
from jaxsense.core.networks import MLP, Params
from jaxsense.core.supervised import Problem
from jaxsense.core.types import Belief, Features, Key, Samples
from jaxsense.vae import gaussian

_CONVERGES = "must be finite; scale features to a deviation of 1, or lower learning_rate"

Drawn = tuple[jax.Array, tuple[jax.Array, ...]]
"""Noise `[steps, D, B]`, and for each modality features `[steps, D_m, B]`."""


@dataclasses.dataclass(frozen=True)
class Jmvae:
    """Shape of a JMVAE: modalities and layer sizes, no parameters; static under `jit`.

    Attributes:
      modalities: names, in the order of the features.
      feature_sizes: D_m of each modality.
      latent_size: D.
      hidden: sizes of the hidden layers of every encoder and decoder.
      max_subset: largest subset with an encoder, next to the full set; all by default. The
        posterior of another subset is the product of those of its modalities.
    """

    modalities: tuple[str, ...]
    feature_sizes: tuple[int, ...]
    latent_size: int
    hidden: tuple[int, ...]
    max_subset: int | None = None

    def __post_init__(self):
        for name in ("modalities", "feature_sizes", "hidden"):
            checks.require_type(name, getattr(self, name), tuple, "which JAX can hash")
        checks.require_one_each("feature_sizes", self.feature_sizes, self.modalities)
        encoders = {self.encoder_name(subset) for subset in self.subsets}
        if not self.modalities or len(encoders) < len(self.subsets):
            expected = "must be one name or more, none twice, and none with a +, which joins names"
            raise ValueError(f"modalities = {self.modalities}: {expected}")
        most = () if self.max_subset is None else (self.max_subset,)
        sizes = {"feature_sizes": self.feature_sizes, "hidden": self.hidden, "max_subset": most}
        for name, numbers in {**sizes, "latent_size": (self.latent_size,)}.items():
            for size in numbers:
                checks.require_number(name, size)

    @property
    def subsets(self) -> tuple[tuple[int, ...], ...]:
        """The subsets of the modalities that have an encoder, the full set last."""
        number = len(self.modalities)
        largest = number - 1 if self.max_subset is None else min(self.max_subset, number - 1)
        sizes = (*range(1, largest + 1), number)
        return tuple(s for size in sizes for s in itertools.combinations(range(number), size))

    @property
    def encoder(self) -> MLP:
        """The network from features to the mean and log-variance of a posterior."""
        return MLP(self.hidden, 2 * self.latent_size)

    def decoder(self, modality: int) -> MLP:
        """The network from a latent to features."""
        return MLP(self.hidden, self.feature_sizes[modality])

    def encoder_name(self, subset: tuple[int, ...]) -> str:
        """Name of a subset's encoder, for example "camera+lidar"."""
        return "+".join(self.modalities[m] for m in subset)


@checks.typed
def init(key: Key, model: Jmvae, *, scale: float = 1.0) -> Params:
    """Random parameters, `{"encoders": {NAME: ...}, "decoders": {NAME: ...}}`.

    With a `scale` of 0.6 on all weights, features of hundreds of numbers need far fewer steps.
    """
    checks.require_positive("scale", scale)

    def scaled(key: Key, network: MLP, inputs: int) -> Params:
        return jax.tree.map(lambda x: scale * x, networks.init(key, network, inputs))

    encoder_key, decoder_key = jax.random.split(key)
    encoder_keys = jax.random.split(encoder_key, len(model.subsets))
    decoder_keys = jax.random.split(decoder_key, len(model.modalities))
    encoders = {
        model.encoder_name(subset): scaled(
            k, model.encoder, sum(model.feature_sizes[m] for m in subset)
        )
        for k, subset in zip(encoder_keys, model.subsets, strict=True)
    }
    decoders = {
        name: scaled(decoder_keys[m], model.decoder(m), model.latent_size)
        for m, name in enumerate(model.modalities)
    }
    return {"encoders": encoders, "decoders": decoders}


@checks.typed
def encode(
    params: Params, model: Jmvae, features: Features
) -> tuple[Float[Array, " D"], Float[Array, " D"]]:
    """Mean and log-variance of the posterior `q(z | present features)`.

    Args:
      features: for each modality `[D_m]`, or None where it is missing.
    """
    checks.require_one_each("features", features, model.modalities)
    if all(feature is None for feature in features):
        raise ValueError(f"features = {features}: must hold one modality or more")
    for name, size, feature in zip(model.modalities, model.feature_sizes, features, strict=True):
        if feature is not None:
            checks.require_shape(f"features of {name}", feature, (size,))
            checks.require_finite(f"features of {name}", feature)
    subset = tuple(m for m, feature in enumerate(features) if feature is not None)
    if subset in model.subsets:
        return _encode(params, model, subset, features)
    alone = [_encode(params, model, (m,), features) for m in subset]
    return gaussian.product(*map(jnp.stack, zip(*alone, strict=True)))


def _encode(
    params: Params, model: Jmvae, subset: tuple[int, ...], features: tuple[Array | None, ...]
) -> tuple[Array, Array]:
    """`[D]` mean and log-variance from `[D_m]` features, or `[D, B]` from `[D_m, B]`."""
    joined = jnp.concatenate([x for m, x in enumerate(features) if m in subset and x is not None])
    of_subset = params["encoders"][model.encoder_name(subset)]
    mean, log_var = jnp.split(networks.apply(model.encoder, of_subset, joined), 2)
    return mean, log_var


@checks.typed
def decode(params: Params, model: Jmvae, z: Float[Array, " D"]) -> tuple[Float[Array, "_"], ...]:
    """Mean of `p(features | z)`, `[D_m]` for each modality."""
    checks.require_shape("z", z, (model.latent_size,))
    return _decode(params, model, z)


def _decode(params: Params, model: Jmvae, z: jax.Array) -> tuple[jax.Array, ...]:
    """`[D_m]` from `[D]` latents, or `[D_m, B]` from `[D, B]`."""
    return tuple(
        networks.apply(model.decoder(m), params["decoders"][name], z)
        for m, name in enumerate(model.modalities)
    )


def posterior(params: Params, model: Jmvae, features: Features) -> Belief:
    """The posterior `q(z | present features)` as a belief, see `encode`."""
    mean, log_var = encode(params, model, features)
    return Belief(mean, jnp.exp(0.5 * log_var))


def losses(
    noise: Float[Array, "D B"],
    params: Params,
    model: Jmvae,
    features: tuple[Float[Array, "_ B"], ...],
    *,
    alpha: float | jax.Array,
    beta: float | jax.Array,
    reconstruction_weights: tuple[float, ...],
) -> tuple[Float[Array, " B"], dict[str, Float[Array, " B"]]]:
    """Negative JMVAE-kl objective of each example, the last axis of all arrays.

    Suzuki et al. 2017, Sec. 3.3:
    `-E[sum_m w_m log p(x_m|z)] + beta KL(q(z|all) || N(0, I)) + alpha sum_s KL(q(z|all) || q(z|s))`
    where z is one reparameterised draw from `q(z|all)`, p a Gaussian of unit variance without its
    constant, and s every proper subset of the modalities that has an encoder. A weight w_m is the
    same as a variance of 1 / w_m.

    Args:
      noise: standard normal draws, for z.
      features: of every modality.
      alpha: weight of the divergences to the subsets' encoders.
      beta: weight of the divergence to the prior.

    Returns:
      Losses, and their parts: `reconstruction`, which is weighted, `prior` and `subsets`.
    """
    batch = noise.shape[-1]
    for x, size in zip(features, model.feature_sizes, strict=True):
        chex.assert_shape(x, (size, batch))
    *others, every = model.subsets
    mean, log_var = _encode(params, model, every, features)
    decoded = _decode(params, model, gaussian.sample(noise, mean, log_var))
    reconstruction = jnp.zeros(batch)
    for x, decoded_mean, weight in zip(features, decoded, reconstruction_weights, strict=True):
        reconstruction += weight * 0.5 * jnp.sum((x - decoded_mean) ** 2, axis=0)
    prior, subsets = gaussian.kl_divergence(mean, log_var), jnp.zeros(batch)
    for subset in others:
        of_subset = _encode(params, model, subset, features)
        subsets += gaussian.kl_divergence(mean, log_var, *of_subset)
    parts = {"reconstruction": reconstruction, "prior": prior, "subsets": subsets}
    return reconstruction + beta * prior + alpha * subsets, parts


def problem(config: JmvaeConfig, bank: Samples, model: Jmvae) -> Problem[Drawn]:
    """The fit of a JMVAE to features.

    A training example is one look by each modality at the same class, independent given the class.
    """

    def draw(key: Key, number: int) -> Drawn:
        shape = number, config.batch
        columns = [jnp.moveaxis(x, -1, 0) for x in bank]
        class_key, noise_key, *row_keys = jax.random.split(key, 2 + len(columns))
        classes = jax.random.randint(class_key, shape, 0, bank[0].shape[0])
        features = [
            jnp.moveaxis(x[:, classes, jax.random.randint(k, shape, 0, x.shape[-1])], 1, 0)
            for x, k in zip(columns, row_keys, strict=True)
        ]
        noise = jax.random.normal(noise_key, (number, model.latent_size, shape[1]))
        return noise, tuple(features)

    def loss(params: Params, drawn: Drawn, step: Int[Array, ""]) -> Float[Array, ""]:
        noise, features = drawn
        weights, beta = config.reconstruction_weights, annealed_beta(step, config)
        total, _ = losses(
            noise,
            params,
            model,
            features,
            alpha=config.alpha,
            beta=beta,
            reconstruction_weights=weights,
        )
        return jnp.mean(total)

    return Problem(config.steps, config.learning_rate, draw, loss)


@checks.typed
def train(
    key: Key, params: Params, model: Jmvae, bank: Samples, config: JmvaeConfig
) -> tuple[Params, Float[Array, "{config.steps}"]]:
    """Trains a JMVAE on features.

    Args:
      bank: for each modality `[C, S, D_m]` features of looks at every class. Each example is a look
        by every modality at one class. Rows that belong together, such as views of one object, are
        classes with a look each: `[N, 1, D_m]`.
      config: weights, batch, learning rate and number of steps; the other settings are not used.
        With `beta` 1 and `annealing` 0 the loss is the negative bound of Suzuki et al. 2017, up to
        a constant.

    Returns:
      The parameters and the loss of each step, of which the last is NaN if a parameter is not
      finite: inside `jit`, which raises no error, check the losses.

    Raises:
      ValueError: if a modality has no features, or some of another shape or not finite, or if the
        loss diverges.
      ConfigError: in JAX's 64-bit mode.
    """
    require_32_bits()
    _require_bank(bank, model)
    fitted = problem(config, bank, model)
    state = supervised.start(params, fitted)
    number = min(config.steps, 100)  # whose draws are in memory together
    chunks = -(-config.steps // number)
    keys = jax.random.split(key, chunks) if chunks > 1 else key[None]

    def chunk(state: supervised.FitState, key: Key) -> tuple[supervised.FitState, jax.Array]:
        return supervised.fit(key, state, fitted, number)

    state, losses = jax.lax.scan(chunk, state, keys)
    checks.require_finite("losses", losses, _CONVERGES)
    return state.params, losses.reshape(-1)[: config.steps]


def _require_bank(bank: Samples, model: Jmvae) -> None:
    """Raises `ValueError` unless each modality has finite features of looks at the same classes."""
    checks.require_one_each("bank", bank, model.modalities)
    for name, size, features in zip(model.modalities, model.feature_sizes, bank, strict=True):
        of_modality = f"bank of {name}"
        checks.require_shape(of_modality, features, (*np.shape(bank[0])[:1], None, size))
        checks.require_number(f"rows in the {of_modality}", len(features) * features.shape[1])
        checks.require_finite(of_modality, features)
    if len(bank[0]) == 1 < min(len(bank), bank[0].shape[1]):
        expected = "must be two or more; give rows [N, D] as x[:, None], not x[None]"
        raise ValueError(f"bank has one class with {bank[0].shape[1]} looks: {expected}")


def annealed_beta(step: Int[Array, ""], config: JmvaeConfig) -> Float[Array, ""]:
    """Beta at a gradient step: exponential decay from `initial_beta` to `beta`, then constant.

    With a low beta from the start, all classes may end up on one line, a local optimum that leaves
    the other latent dimensions empty.
    """
    # With `annealing` = 0, beta is constant.
    annealing_steps = jnp.maximum(config.annealing * config.steps, 1e-6)
    remaining = jnp.where(config.annealing > 0, jnp.maximum(1.0 - step / annealing_steps, 0.0), 0.0)
    return config.beta * (config.initial_beta / config.beta) ** remaining


@checks.typed
def log_likelihood(
    key: Key,
    params: Params,
    model: Jmvae,
    features: Features,
    reconstruction_weights: Float[Array, " M"] | tuple[float, ...],
    samples: int = 200,
) -> Float[Array, ""]:
    """Estimate of `log p(present features)` in nats, by importance sampling with their posterior.

    Burda, Grosse and Salakhutdinov 2016, Eq. 8. On average the estimate is too low; more samples
    bring it closer. For the likelihood of features given others, subtract that of the others.

    Args:
      features: for each modality `[D_m]`, or None where it is missing.
      reconstruction_weights: of the training, the inverse variance of each modality's features
        given the latents.
      samples: number of latents to draw; static.
    """
    checks.require_number("samples", samples)
    checks.require_one_each("reconstruction_weights", reconstruction_weights, model.modalities)
    given = tuple(reconstruction_weights)
    checks.require_positive("reconstruction_weights", jnp.stack(given))
    belief = posterior(params, model, features)

    def log_weight(noise: Float[Array, " D"]) -> Float[Array, ""]:
        z = belief.mean + belief.std * noise
        decoded = decode(params, model, z)
        of_features = sum(
            _log_normal((x - mean) * jnp.sqrt(weight)) + 0.5 * x.shape[-1] * jnp.log(weight)
            for x, mean, weight in zip(features, decoded, given, strict=True)
            if x is not None
        )
        return of_features + _log_normal(z) - _log_normal(noise) + jnp.sum(jnp.log(belief.std))

    noise = jax.random.normal(key, (samples, model.latent_size))
    return jax.nn.logsumexp(jax.vmap(log_weight)(noise)) - jnp.log(samples)


def _log_normal(x: Float[Array, " D"]) -> Float[Array, ""]:
    """Log density of independent standard normals."""
    return -0.5 * jnp.sum(x**2 + jnp.log(2 * jnp.pi))

"""How likely features are under a JMVAE."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsense.core import checks
from jaxsense.core.networks import Params
from jaxsense.core.types import Features, Key
from jaxsense.vae import jmvae
from jaxsense.vae.jmvae import Jmvae


def log_likelihood(
    key: Key,
    params: Params,
    model: Jmvae,
    features: Features,
    reconstruction_weights: Float[Array, " M"] | tuple[float, ...],
    samples: int = 200,
) -> Float[Array, ""]:
    """Estimates `log p(present features)` by importance sampling, with their posterior.

    Burda, Grosse and Salakhutdinov 2016, Eq. 8. On average the estimate is too low; more samples
    bring it closer. For the likelihood of features given others, subtract that of the others.

    Args:
      key: random key.
      params: from `jmvae.train`.
      model: the shape.
      features: for each modality `[D_m]`, or None where it is missing.
      reconstruction_weights: of the training, the inverse variance of each modality's features
        given the latents.
      samples: number of latents to draw; static.

    Returns:
      In nats.

    Raises:
      ValueError: if no modality is present, `reconstruction_weights` has not one above 0 for each,
        or `samples` is not positive.
    """
    checks.require_key(key)
    checks.require_number("samples", samples)
    checks.require_one_each("reconstruction_weights", reconstruction_weights, model.modalities)
    given = tuple(reconstruction_weights)
    checks.require_positive("reconstruction_weights", jnp.stack(given))
    posterior = jmvae.posterior(params, model, features)

    def log_weight(noise: Float[Array, " D"]) -> Float[Array, ""]:
        z = posterior.mean + posterior.std * noise
        decoded = jmvae.decode(params, model, z)
        of_features = sum(
            _log_normal((x - mean) * jnp.sqrt(weight)) + 0.5 * x.shape[-1] * jnp.log(weight)
            for x, mean, weight in zip(features, decoded, given, strict=True)
            if x is not None
        )
        return of_features + _log_normal(z) - _log_normal(noise) + jnp.sum(jnp.log(posterior.std))

    noise = jax.random.normal(key, (samples, model.latent_size))
    return jax.nn.logsumexp(jax.vmap(log_weight)(noise)) - jnp.log(samples)


def _log_normal(x: Float[Array, " D"]) -> Float[Array, ""]:
    """Log density of independent standard normals."""
    return -0.5 * jnp.sum(x**2 + jnp.log(2 * jnp.pi))

"""The networks of a variant and its loss, of which `vae.leave_one_out` is one case."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from benchmarks.raw.looks import Seen
from benchmarks.raw.variants import Variant
from jaxsense import Key
from jaxsense.core import networks
from jaxsense.core.networks import MLP, Params
from jaxsense.vae import gaussian

_EMBEDDING = 64
_LOG_VARIANCES = -10.0, 6.0
_FIRST_ALPHA = 0.1

Columns = tuple[Float[Array, "F B K"], ...]
"""Numbers of looks with the batch last, for each sensor."""

Gaussian = tuple[Float[Array, "D ..."], Float[Array, "D ..."]]
"""Mean and log-variance."""


class Model:
    """The networks of a variant.

    As in the library, the posterior of several looks reads the means of what a network finds in
    each, and every sensor has an encoder of single looks.
    """

    def __init__(self, variant: Variant, sizes: tuple[int, ...]):
        """Networks for looks of F_m numbers each."""
        self.variant = variant
        self.latent_size = variant.jmvae.latent_size
        self._rows = variant.rows(sizes)
        self.inputs = tuple(map(len, self._rows))
        hidden, outputs = variant.jmvae.hidden, 2 * self.latent_size
        self.alone = MLP(hidden, outputs)
        self.embedding = MLP(hidden[:-1] or hidden, _EMBEDDING)
        self.joint = MLP(hidden[-1:], outputs)
        self.private = MLP(hidden, 2 * variant.private)
        self.decoders = [MLP(hidden, size) for size in self.inputs]

    def init(self, key: Key) -> dict[str, list[Params]]:
        """Random parameters."""
        keys = iter(jax.random.split(key, 1 + 4 * len(self.inputs)))
        whole = self.latent_size + self.variant.private
        of_looks = {"alone": self.alone, "embedding": self.embedding}
        of_looks |= {"private": self.private} if self.variant.private else {}
        params = {
            name: [networks.init(next(keys), network, size) for size in self.inputs]
            for name, network in of_looks.items()
        }
        params["decoders"] = [networks.init(next(keys), d, whole) for d in self.decoders]
        joint_size = _EMBEDDING * len(self.inputs)
        return {**params, "joint": [networks.init(next(keys), self.joint, joint_size)]}

    def columns(self, seen: Seen) -> Columns:
        """Looks with the batch last, and with repeated numbers.

        Args:
          seen: `[B, K, F_m]` of each sensor.
        """
        return tuple(
            jnp.moveaxis(x[..., rows] if len(rows) != x.shape[-1] else x, -1, 0)
            for x, rows in zip(seen, self._rows, strict=True)
        )

    def posterior(self, params: Params, looks: Columns) -> Gaussian:
        """Posterior of all looks at each PoI, `[D, B]`."""
        return self._of_means(params, [x.mean(axis=-1) for x in self._embed(params, looks)])

    def of_single(self, params: Params, looks: Columns, m: int) -> Gaussian:
        """Posteriors of single looks by one sensor, `[D, B, K]`."""
        return _split(_apply(self.alone, params["alone"][m], looks[m]))

    def sources(self, params: Params, looks: Columns) -> list[Gaussian]:
        """For each sensor the posteriors that its looks are decoded from, `[D, B, K]`."""
        return self._sources(params, self._embed(params, looks))

    def loss(
        self,
        key: Key,
        params: Params,
        looks: Columns,
        beta: jax.Array,
        has_begun: jax.Array,
    ) -> Float[Array, ""]:
        """Mean loss of a batch.

        With `leaves_out`, see `leave_one_out.losses`. Without, all looks are decoded from one
        posterior, which is that of `jmvae.losses` for one look by each sensor.

        Args:
          key: random key.
          params: of the networks.
          looks: K by each sensor at B PoIs.
          beta: `[]` weight of the divergences from the prior.
          has_begun: `[]` from 0, where posteriors of fewer looks follow, to 1, where they draw.
        """
        variant, config = self.variant, self.variant.jmvae
        found = self._embed(params, looks)
        whole = self._of_means(params, [x.mean(axis=-1) for x in found])
        total = beta * _divergence(whole)
        fixed = jax.lax.stop_gradient(whole)
        keys = jax.random.split(key, (len(looks), 2))

        def draws(few: Gaussian) -> jax.Array:
            drawn, follows = (_divergence(_each(x), few) for x in (whole, fixed))
            weighted = has_begun * config.alpha * drawn + (1 - has_begun) * _FIRST_ALPHA * follows
            return jnp.sum(weighted, axis=-1)

        for m, (x, few) in enumerate(zip(looks, self._sources(params, found), strict=True)):
            noise_key = keys[m, 0] if variant.leaves_out else keys[0, 0]
            if variant.leaves_out:
                total += beta * jnp.mean(_divergence(few), axis=-1)
            z = gaussian.sample(jax.random.normal(noise_key, few[0].shape), *few)
            if variant.private:
                of_look = _split(_apply(self.private, params["private"][m], x))
                total += beta * jnp.sum(_divergence(of_look), axis=-1)
                noise = jax.random.normal(keys[m, 1], of_look[0].shape)
                z = jnp.concatenate([z, gaussian.sample(noise, *of_look)])
            decoded = _apply(self.decoders[m], params["decoders"][m], z)
            weight = 0.5 * config.reconstruction_weights[m]
            total += weight * jnp.sum(self._errors(x, decoded), axis=-1)
            total += draws(self.of_single(params, looks, m))
        if variant.pairs:
            total += draws(self._of_means(params, found))
        return jnp.mean(total)

    def _embed(self, params: Params, looks: Columns) -> list[jax.Array]:
        """`[E, B, K]` of each sensor."""
        return [
            jax.nn.relu(_apply(self.embedding, p, x))
            for p, x in zip(params["embedding"], looks, strict=True)
        ]

    def _of_means(self, params: Params, means: list[jax.Array]) -> Gaussian:
        return _split(_apply(self.joint, params["joint"][0], jnp.concatenate(means)))

    def _sources(self, params: Params, found: list[jax.Array]) -> list[Gaussian]:
        number, sources = found[0].shape[-1], []
        means = [x.mean(axis=-1, keepdims=True) for x in found]
        given = [jnp.broadcast_to(x, (*x.shape[:-1], number)) for x in means]
        for m, x in enumerate(found):
            own = given[m]
            if self.variant.leaves_out:
                own = (own * number - x) / (number - 1)
            sources.append(self._of_means(params, [*given[:m], own, *given[m + 1 :]]))
        return sources

    def _errors(self, x: jax.Array, decoded: jax.Array) -> jax.Array:
        """`[B, K]` -2 log-likelihoods up to a constant, of each look or of each of its numbers."""
        error = jnp.sum((x - decoded) ** 2, axis=0)
        if self.variant.learns_variance:
            # The variance is at its optimum, where its own gradient is 0.
            variance = jax.lax.stop_gradient(jnp.mean(error) / len(x))
            error = error / variance + len(x) * jnp.log(variance)
        return error / len(x) if self.variant.is_mean else error


def hidden(params: Params, x: Float[Array, "F B"]) -> list[Float[Array, "_ B"]]:
    """What each hidden layer of an `MLP` puts out.

    Args:
      params: of the network.
      x: its inputs.
    """
    *layers, _ = params["params"].values()
    found = []
    for layer in layers:
        x = jax.nn.relu(layer["kernel"].T @ x + layer["bias"][:, None])
        found.append(x)
    return found


def _apply(network: MLP, params: Params, x: jax.Array) -> jax.Array:
    found = networks.apply(network, params, x.reshape(len(x), -1))
    return found.reshape(-1, *x.shape[1:])


def _split(output: jax.Array) -> Gaussian:
    mean, log_variance = jnp.split(output, 2)
    return mean, jnp.clip(log_variance, *_LOG_VARIANCES)


def _each(x: Gaussian) -> Gaussian:
    return x[0][..., None], x[1][..., None]


def _divergence(p: Gaussian, q: Gaussian | None = None) -> jax.Array:
    """Divergence of Gaussians whose dimensions are the first axis, from the prior by default."""
    (mean, log_variance), (mean_2, log_variance_2) = p, q or (jnp.float32(0), jnp.float32(0))
    distance = (mean - mean_2) ** 2 * jnp.exp(-log_variance_2)
    ratio = jnp.exp(log_variance - log_variance_2)
    return 0.5 * jnp.sum(ratio + distance - 1 - log_variance + log_variance_2, axis=0)

"""What is trained: the budget that all models share, what is asked of each, and our JMVAE."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.digits.data import Digits, Views
from jaxsense import vae
from jaxsense.config import JmvaeConfig
from jaxsense.core.networks import Params
from jaxsense.vae import Jmvae

Subset = tuple[int, ...]
"""Indices of the views that are seen."""


@dataclasses.dataclass(frozen=True)
class Budget:
    """Settings that all models share.

    Attributes:
      latent_size: D.
      hidden: sizes of the hidden layers of every encoder and decoder.
      variance: of each feature given z; the decoders yield the means.
      alpha: weight of the divergences to the encoders of fewer views, in JMVAEs.
      steps: of Adam.
      batch: digits in a step.
      learning_rate: of the first step; it falls to zero along a cosine.
    """

    latent_size: int = 16
    hidden: tuple[int, ...] = (64, 64)
    variance: float = 0.5
    alpha: float = 0.1
    steps: int = 1000
    batch: int = 64
    learning_rate: float = 2e-3


class Trained(Protocol):
    """A trained model."""

    def means(self, views: Views, seen: Subset) -> np.ndarray:
        """`[N, D]` means of the posteriors given some views.

        Args:
          views: all views of N digits.
          seen: those that are given.
        """
        ...

    def sample(self, views: Views, seen: Subset) -> np.ndarray:
        """`[N, D]`, a draw from each posterior given some views, as in `means`."""
        ...

    def joint(self, views: Views) -> tuple[np.ndarray, np.ndarray]:
        """Posteriors given all views, equal mixtures of J Gaussians.

        Args:
          views: all views of N digits.

        Returns:
          `[J, N, D]` means and log-variances.
        """
        ...

    def decode(self, z: np.ndarray) -> Views:
        """Means of the features of all views.

        Args:
          z: `[N, D]` latents.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Run:
    """A training.

    Attributes:
      trained: the model.
      seconds: of training.
      compiling: seconds of compiling, once for all seeds.
    """

    trained: Trained
    seconds: float
    compiling: float = 0.0


class Kind(Protocol):
    """A model to train."""

    def runs(self, digits: Digits, budget: Budget, seeds: range) -> Iterator[Run]:
        """Trains once for each seed.

        Args:
          digits: to train on.
          budget: settings.
          seeds: of initial weights, batches and noise.
        """
        ...


def init_as_pytorch(key: jax.Array, model: Jmvae) -> Params:
    """Initial parameters as PyTorch draws them: all uniform, up to `1 / sqrt(inputs)`.

    Args:
      key: random key.
      model: the shape.
    """
    params = vae.init(key, model)
    layers = jax.tree.structure(params, is_leaf=_is_layer)
    keys = jax.tree.unflatten(layers, jax.random.split(key, layers.num_leaves))

    def draw(layer: Mapping[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
        inputs, outputs = layer["kernel"].shape
        drawn = jax.random.uniform(key, (inputs + 1, outputs), minval=-1.0) / jnp.sqrt(inputs)
        return {"kernel": drawn[1:], "bias": drawn[0]}

    return jax.tree.map(draw, params, keys, is_leaf=_is_layer)


def _is_layer(part: object) -> bool:
    return isinstance(part, Mapping) and "kernel" in part


@dataclasses.dataclass(frozen=True)
class Ours:
    """Our JMVAE.

    Attributes:
      max_subset: see `Jmvae`.
      init: `(key, model) -> initial parameters`.
    """

    max_subset: int | None
    init: Callable[[jax.Array, Jmvae], Params]

    def runs(self, digits: Digits, budget: Budget, seeds: range) -> Iterator[Run]:
        """Trains once for each seed, see `Kind`; all by one program."""
        model = Jmvae(
            digits.names, digits.sizes, budget.latent_size, budget.hidden, self.max_subset
        )
        config = JmvaeConfig(
            alpha=budget.alpha,
            beta=1.0,
            annealing=0.0,
            reconstruction_weights=(1 / budget.variance,) * len(digits.names),
            steps=budget.steps,
            batch=budget.batch,
            learning_rate=budget.learning_rate,
        )

        def train(key: jax.Array, bank: tuple[jax.Array, ...]) -> Params:
            init_key, train_key = jax.random.split(key)
            return vae.train(train_key, self.init(init_key, model), model, bank, config)[0]

        bank = tuple(jax.device_put(x[:, None]) for x in digits.train)
        begin = time.perf_counter()
        program = jax.jit(train).lower(jax.random.key(0), bank).compile()
        compiling = time.perf_counter() - begin
        for seed in seeds:
            begin = time.perf_counter()
            params = jax.block_until_ready(program(jax.random.key(seed), bank))
            yield Run(_Trained(params, model, seed), time.perf_counter() - begin, compiling)


@dataclasses.dataclass(frozen=True)
class _Trained:
    params: Params
    model: Jmvae
    seed: int

    def means(self, views: Views, seen: Subset) -> np.ndarray:
        return self._posterior(views, seen)[0]

    def sample(self, views: Views, seen: Subset) -> np.ndarray:
        mean, log_variance = self._posterior(views, seen)
        noise = np.random.default_rng((self.seed, *seen)).standard_normal(mean.shape, np.float32)
        return mean + np.exp(0.5 * log_variance) * noise

    def joint(self, views: Views) -> tuple[np.ndarray, np.ndarray]:
        mean, log_variance = self._posterior(views, tuple(range(len(views))))
        return mean[None], log_variance[None]

    def decode(self, z: np.ndarray) -> Views:
        return jax.tree.map(np.asarray, _decode(self.params, self.model, z))

    def _posterior(self, views: Views, seen: Subset) -> tuple[np.ndarray, np.ndarray]:
        given = tuple(jnp.asarray(x) if m in seen else None for m, x in enumerate(views))
        mean, log_variance = _encode(self.params, self.model, given)
        return np.asarray(mean), np.asarray(log_variance)


_encode = jax.vmap(vae.encode, (None, None, 0))
_decode = jax.jit(jax.vmap(vae.decode, (None, None, 0)), static_argnums=1)

OURS: Mapping[str, Kind] = {"jaxsense JMVAE": Ours(1, init_as_pytorch)}
"""Ours by name, with the same encoders and the same distribution of initial weights as theirs."""

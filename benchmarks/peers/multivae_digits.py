"""MultiVae's JMVAE, MVAE, MMVAE and MoPoE on the digits, with our layers, in a plain loop."""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from multivae.data.datasets import MultimodalBaseDataset  # pyright: ignore[reportMissingImports]
from multivae.models import (  # pyright: ignore[reportMissingImports]
    JMVAE,
    MMVAE,
    MVAE,
    JMVAEConfig,
    MMVAEConfig,
    MoPoE,
    MoPoEConfig,
    MVAEConfig,
)

from benchmarks.digits.data import Digits, Views
from benchmarks.digits.models import Budget, Kind, Run, Subset
from benchmarks.peers.multivae import Decoder, Encoder, JointEncoder
from jaxsense.run import devices
from jaxsense.vae import Jmvae

_TRIAL = 20  # steps that find out how many threads are faster

Name = Literal["JMVAE", "MVAE", "MMVAE", "MoPoE"]


@dataclasses.dataclass(frozen=True)
class Theirs:
    """A model of MultiVae.

    Attributes:
      name: of the model.
    """

    name: Name

    def runs(self, digits: Digits, budget: Budget, seeds: range) -> Iterator[Run]:
        """Trains once for each seed, with as many threads as are faster, see `Kind`."""
        threads = self._threads(digits, budget)
        for seed in seeds:
            torch.set_num_threads(threads)
            torch.manual_seed(seed)
            begin = time.perf_counter()
            network = self._network(digits, budget)
            _train(network, digits, budget, budget.steps)
            yield Run(
                _Trained(network.eval(), self.name, digits.names), time.perf_counter() - begin
            )

    def _threads(self, digits: Digits, budget: Budget) -> int:
        def seconds(threads: int) -> float:
            torch.set_num_threads(threads)
            network = self._network(digits, budget)
            _train(network, digits, budget, 2)
            begin = time.perf_counter()
            _train(network, digits, budget, min(budget.steps, _TRIAL))
            return time.perf_counter() - begin

        return min(sorted({1, devices.cores()}), key=seconds)

    def _network(self, digits: Digits, budget: Budget) -> Any:
        shape = Jmvae(digits.names, digits.sizes, budget.latent_size, budget.hidden)
        of_each = dict(zip(digits.names, digits.sizes, strict=True))
        parts: dict[str, Any] = {
            "encoders": {name: Encoder(size, shape) for name, size in of_each.items()},
            "decoders": {name: Decoder(size, shape) for name, size in of_each.items()},
        }
        common = {
            "n_modalities": len(of_each),
            "latent_dim": budget.latent_size,
            "input_dims": {name: (size,) for name, size in of_each.items()},
            "decoder_dist_params": {n: {"scale": budget.variance**0.5} for n in of_each},
        }
        if self.name == "JMVAE":
            config = JMVAEConfig(**common, alpha=budget.alpha, warmup=1)
            return JMVAE(config, **parts, joint_encoder=JointEncoder(shape))
        if self.name == "MVAE":
            return MVAE(MVAEConfig(**common, warmup=1), **parts)
        if self.name == "MMVAE":
            # As the others: Gaussians, a standard normal prior, and one draw for each posterior.
            same = {"prior_and_posterior_dist": "normal", "learn_prior": False, "K": 1}
            return MMVAE(MMVAEConfig(**common, **same), **parts)
        return MoPoE(MoPoEConfig(**common), **parts)


def _train(network: Any, digits: Digits, budget: Budget, steps: int) -> None:
    """Trains with Adam and a cosine, as ours; faster than MultiVae's own trainer."""
    network.train()
    optimiser = torch.optim.Adam(network.parameters(), lr=budget.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    views = {name: torch.tensor(x) for name, x in zip(digits.names, digits.train, strict=True)}
    for _ in range(steps):
        rows = torch.randint(len(digits.train_labels), (budget.batch,))
        optimiser.zero_grad()
        batch = MultimodalBaseDataset({name: x[rows] for name, x in views.items()})
        network(batch).loss.backward()
        optimiser.step()
        schedule.step()


@dataclasses.dataclass(frozen=True)
class _Trained:
    network: Any
    name: Name
    views: tuple[str, ...]

    def means(self, views: Views, seen: Subset) -> np.ndarray:
        return self._encode(views, seen, return_mean=True)

    def sample(self, views: Views, seen: Subset) -> np.ndarray:
        return self._encode(views, seen)

    @torch.no_grad()
    def joint(self, views: Views) -> tuple[np.ndarray, np.ndarray]:
        inputs = self._inputs(views)
        if self.name == "JMVAE":
            found = self.network.joint_encoder(inputs.data)
            mixture = found.embedding[None], found.log_covariance[None]
        elif self.name == "MVAE":
            found = self.network.compute_mu_log_var_subset(inputs, [*self.views])
            mixture = tuple(x[None] for x in found)
        elif self.name == "MMVAE":
            found = [self.network.encoders[name](inputs.data[name]) for name in self.views]
            mixture = (
                torch.stack([x.embedding for x in found]),
                torch.stack([x.log_covariance for x in found]),
            )
        else:
            found = self.network.inference(inputs)
            mixture = found["mus"], found["logvars"]
        mean, log_variance = (x.numpy() for x in mixture)
        return mean, log_variance

    @torch.no_grad()
    def decode(self, z: np.ndarray) -> Views:
        latents = torch.tensor(z)
        return tuple(
            self.network.decoders[name](latents).reconstruction.numpy() for name in self.views
        )

    @torch.no_grad()
    def _encode(self, views: Views, seen: Subset, **options: bool) -> np.ndarray:
        given = [self.views[m] for m in seen]
        return self.network.encode(self._inputs(views), cond_mod=given, **options).z.numpy()

    def _inputs(self, views: Views) -> MultimodalBaseDataset:
        return MultimodalBaseDataset(
            {name: torch.tensor(x) for name, x in zip(self.views, views, strict=True)}
        )


KINDS: Mapping[str, Kind] = {
    f"MultiVae {name}": Theirs(name) for name in ("JMVAE", "MVAE", "MMVAE", "MoPoE")
}
"""MultiVae's models by name."""

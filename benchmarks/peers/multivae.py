"""MultiVae's JMVAE (PyTorch), with our layers, in a plain training loop."""

from collections.abc import Callable

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from multivae.data.datasets import MultimodalBaseDataset  # pyright: ignore[reportMissingImports]
from multivae.models import JMVAE, JMVAEConfig  # pyright: ignore[reportMissingImports]
from multivae.models.nn import BaseJointEncoder  # pyright: ignore[reportMissingImports]
from pythae.models.base.base_utils import ModelOutput  # pyright: ignore[reportMissingImports]
from pythae.models.nn import BaseDecoder, BaseEncoder  # pyright: ignore[reportMissingImports]

from benchmarks.measure import Options, Side
from jaxsense.config import JmvaeConfig
from jaxsense.run import devices
from jaxsense.vae.jmvae import Jmvae

_STEPS, _STEPS_QUICK = 200, 2


def sides(
    model: Jmvae, config: JmvaeConfig, bank: list[np.ndarray], options: Options
) -> list[Side]:
    """The training with one thread and with one for each core.

    Args:
      model: the shape.
      config: weights, batch and learning rate.
      bank: for each modality `[C, S, D_m]` detections.
      options: sizes.

    Returns:
      The ways to run it.
    """
    steps = _STEPS_QUICK if options.quick else _STEPS
    train = _make_training(model, config, bank, steps)

    def side(threads: int) -> Side:
        def run() -> None:
            torch.set_num_threads(threads)
            train()

        return Side(run, steps * config.batch, config.batch)

    return [side(threads) for threads in sorted({1, devices.cores()})]


def _make_training(
    model: Jmvae, config: JmvaeConfig, bank: list[np.ndarray], steps: int
) -> Callable[[], None]:
    """A call that makes some gradient steps; it is faster than MultiVae's own trainer."""
    names = model.modalities
    network = JMVAE(
        JMVAEConfig(
            n_modalities=len(names),
            latent_dim=model.latent_size,
            input_dims={n: (d,) for n, d in zip(names, model.feature_sizes, strict=True)},
            alpha=config.alpha,
            beta=config.beta,
            warmup=1,
        ),
        encoders={n: Encoder(d, model) for n, d in zip(names, model.feature_sizes, strict=True)},
        decoders={n: Decoder(d, model) for n, d in zip(names, model.feature_sizes, strict=True)},
        joint_encoder=JointEncoder(model),
    )
    network.train()
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    features = [torch.tensor(np.array(x)) for x in bank]
    num_classes = len(bank[0])

    def train() -> None:
        for _ in range(steps):
            classes = torch.randint(num_classes, (config.batch,))
            rows = [torch.randint(x.shape[1], (config.batch,)) for x in features]
            batch = {n: x[classes, r] for n, x, r in zip(names, features, rows, strict=True)}
            optimiser.zero_grad()
            network(MultimodalBaseDataset(batch)).loss.backward()
            optimiser.step()

    return train


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> torch.nn.Sequential:
    """Dense layers with ReLU, and a linear last layer."""
    layers: list[torch.nn.Module] = []
    for before, after in zip((inputs, *hidden[:-1]), hidden, strict=True):
        layers += [torch.nn.Linear(before, after), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers, torch.nn.Linear(hidden[-1], outputs))


class Encoder(BaseEncoder):
    """An encoder of one modality with our layers."""

    def __init__(self, size: int, model: Jmvae):
        super().__init__()
        self.latent_dim = model.latent_size
        self.layers = _layers(size, model.hidden, 2 * model.latent_size)

    def forward(self, x: torch.Tensor) -> ModelOutput:
        """Posteriors given `[B, D_m]` features."""
        mean, log_var = self.layers(x).chunk(2, dim=-1)
        return ModelOutput(embedding=mean, log_covariance=log_var)


class JointEncoder(BaseJointEncoder):
    """An encoder of all modalities with our layers."""

    def __init__(self, model: Jmvae):
        super().__init__()
        self.latent_dim = model.latent_size
        self.names = model.modalities
        self.layers = _layers(sum(model.feature_sizes), model.hidden, 2 * model.latent_size)

    def forward(self, x: dict[str, torch.Tensor]) -> ModelOutput:
        """Posteriors given the features of all modalities by name."""
        joined = torch.cat([x[name] for name in self.names], dim=-1)
        mean, log_var = self.layers(joined).chunk(2, dim=-1)
        return ModelOutput(embedding=mean, log_covariance=log_var)


class Decoder(BaseDecoder):
    """A decoder of one modality with our layers."""

    def __init__(self, size: int, model: Jmvae):
        super().__init__()
        self.layers = _layers(model.latent_size, model.hidden, size)

    def forward(self, z: torch.Tensor) -> ModelOutput:
        """Means of the features given `[B, D]` latents."""
        return ModelOutput(reconstruction=self.layers(z))

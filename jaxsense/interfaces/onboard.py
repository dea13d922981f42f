"""The functions of a run that a robot needs, for export: what missions play, each for one look."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxsense.config import Config
from jaxsense.core.types import Belief
from jaxsense.dqn.policies import POLICIES, Known
from jaxsense.dqn.team_mdp import Team
from jaxsense.mission import maps, memory
from jaxsense.mission.choice import ask, choose, times_to_new_looks
from jaxsense.models import Models, make_agent, make_jmvae
from jaxsense.sim import sensors
from jaxsense.vae import jmvae

_ENDS = "N for none"


@dataclasses.dataclass(frozen=True)
class Input:
    """An input of a function.

    Attributes:
      shape: its axes; one that is named, such as "pois", has any size, the same in all inputs.
      about: its meaning, with units, order and frame.
      dtype: "float32", "int32" or "bool".
    """

    shape: tuple[int | str, ...]
    about: str
    dtype: str = "float32"


@dataclasses.dataclass(frozen=True)
class Function:
    """A function of one example.

    Attributes:
      about: what it does, in one line.
      inputs: by name, in the order of `apply`.
      outputs: meaning of each output, by name.
      apply: `(models, *inputs) -> {name: output}`.
    """

    about: str
    inputs: dict[str, Input]
    outputs: dict[str, str]
    apply: Callable[..., dict[str, jax.Array]]


def functions(config: Config) -> dict[str, Function]:
    """All functions, by name.

    For each modality M `detect_M`, `weigh_M` and, for a map that all share, `write_M`; where each
    robot has a map of its own, `tell_M` in its place, and `merge`; for each encoder of the JMVAE an
    `encode_M`, for example `encode_camera+lidar`, if it reads features; `classify`; and `decide`.

    Args:
      config: all settings.
    """
    model, own_maps = make_jmvae(config), config.mission.communication.own_maps
    found = {}
    for m, name in enumerate(model.modalities):
        found |= {f"detect_{name}": _detect(config, m), f"weigh_{name}": _weigh(m)}
        found |= (
            {f"tell_{name}": _tell(config, m)} if own_maps else {f"write_{name}": _write(config, m)}
        )
    if own_maps:
        found["merge"] = _merge(config)
    for subset in () if config.jmvae.reads_scans else model.subsets:
        found[f"encode_{model.encoder_name(subset)}"] = _encode(config, subset)
    return {**found, "classify": _classify(config), "decide": _decide(config)}


def _detect(config: Config, m: int) -> Function:
    sensor, least = sensors.make(config)[m], config.mission.least_confidence
    search = config.mission.localisation.search

    def apply(
        models: Models, readings: jax.Array, bearing: jax.Array, distance: jax.Array
    ) -> dict[str, jax.Array]:
        found = models.detect(m, sensor, readings, bearing, distance, search)
        is_confident = jnp.max(found.features) >= least
        return {
            "is_known": found.is_known,
            "is_there": found.is_there,
            "detects": found.is_there & is_confident,
            "features": found.features,
        }

    kind = "distances in metres" if sensor.measures_distance else "readings"
    order = "in the order of `angles` in `sensors`"
    bright = "" if sensor.channels != 3 else ", linear RGB from 0 to 1"
    inputs = {
        "readings": Input(
            sensor.shape,
            f"{kind} of all rays of a scan, {order}{bright}; resample other scans first",
        ),
        "bearing": Input(
            (),
            "of the PoI in the sensor's frame (x ahead, y left), in radians, positive to the left",
        ),
        "distance": Input((), "expected from the sensor to the PoI's centre, in metres"),
    }
    outputs = {
        "is_known": "whether the detector has learned from such looks, see `learned`, and the scan "
        "was recorded around the bearing; if not, what is there stays open",
        "is_there": "whether the scan shows the PoI",
        "detects": f"whether it is there and a label has a probability of at least {float(least):g}"
        ": only then write the look",
        "features": "probability of each label, in the order of `labels`; equal if it is not there",
    }
    return Function("What a look says, by gate and detector.", inputs, outputs, apply)


def _weigh(m: int) -> Function:
    def apply(models: Models, apart: jax.Array) -> dict[str, jax.Array]:
        return {
            "weight": models.novelty.weight(apart, m),
            "to_go": models.novelty.to_go(apart, m),
        }

    apart = Input(("looks",), "distances from earlier looks by this sensor at the PoI, in metres")
    outputs = {
        "weight": "share of the look that is new evidence, above 0 and up to 1",
        "to_go": "metres straight away from the earlier looks to where half of a look is new",
    }
    about = "How much of a look is new after earlier ones; give an infinite distance for none."
    return Function(about, {"apart": apart}, outputs, apply)


def _write(config: Config, m: int) -> Function:
    def apply(
        models: Models,
        mean: jax.Array,
        std: jax.Array,
        seen: jax.Array,
        features: jax.Array,
        weight: jax.Array,
    ) -> dict[str, jax.Array]:
        after = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return {"new_mean": after.mean, "new_std": after.std}

    model = make_jmvae(config)
    inputs = {
        **_belief(model.latent_size),
        "seen": Input((len(model.modalities),), "which sensors have looked at it before", "bool"),
        "features": Input((model.feature_sizes[m],), "from `detect`"),
        "weight": Input((), "from `weigh`"),
    }
    outputs = {f"new_{name}": about for name, about in _BELIEF.items()}
    return Function("The belief about a PoI after a look.", inputs, outputs, apply)


def _tell(config: Config, m: int) -> Function:
    def apply(models: Models, features: jax.Array, weight: jax.Array) -> dict[str, jax.Array]:
        return {"evidence": maps.log_likelihood(models, features, m, weight)}

    inputs = {
        "features": Input((make_jmvae(config).feature_sizes[m],), "from `detect`"),
        "weight": Input((), "from `weigh`"),
    }
    outputs = {"evidence": "logarithm of each class's likelihood given the look, up to a constant"}
    about = "The evidence of a look, for the sum of a robot's own looks."
    return Function(about, inputs, outputs, apply)


def _merge(config: Config) -> Function:
    def apply(models: Models, sums: jax.Array) -> dict[str, jax.Array]:
        of_poi = jax.vmap(lambda total: memory.belief_of(models.fusion, total))
        return vars(of_poi(jnp.sum(sums, axis=0)))

    sums = Input(
        ("robots", "pois", len(config.arena.classes)),
        "sum of the evidence of each robot's own looks at each PoI, from `tell`, as far as this "
        "robot knows: its own sums, and the latest that it has received; 0 for no looks",
    )
    about = "A robot's map, from what each robot has said of its own looks."
    return Function(about, {"sums": sums}, _BELIEF, apply)


def _encode(config: Config, subset: tuple[int, ...]) -> Function:
    model = make_jmvae(config)

    def apply(models: Models, *features: jax.Array) -> dict[str, jax.Array]:
        given = dict(zip(subset, features, strict=True))
        of_each = tuple(given.get(m) for m in range(len(model.modalities)))
        return vars(jmvae.posterior(models.jmvae, model, of_each))

    inputs = {
        model.modalities[m]: Input((model.feature_sizes[m],), "features, from its `detect`")
        for m in subset
    }
    return Function("The JMVAE's belief after a look by each of these.", inputs, _BELIEF, apply)


def _classify(config: Config) -> Function:
    def apply(models: Models, mean: jax.Array, std: jax.Array) -> dict[str, jax.Array]:
        belief = Belief(mean, std)
        probabilities = jax.vmap(models.fusion.class_probabilities)(belief)
        return {
            "probabilities": probabilities,
            "most_likely": jnp.argmax(probabilities, axis=1).astype(jnp.int32),
            "plausible": jax.vmap(models.plausible_classes)(belief),
        }

    outputs = {
        "probabilities": "of each class, in the order of `classes`",
        "most_likely": "index of the most likely class",
        "plausible": "which classes the belief leaves open",
    }
    inputs = _belief("pois", config.jmvae.latent_size)
    return Function("What the map says about the classes.", inputs, outputs, apply)


def _decide(config: Config) -> Function:
    policy, settings = POLICIES["latent"], config.mission
    key = jax.random.key(0)  # the policy draws nothing

    def apply(
        models: Models,
        mean: jax.Array,
        std: jax.Array,
        looked_from: jax.Array,
        robot: jax.Array,
        *of_team: jax.Array,
    ) -> dict[str, jax.Array]:
        team, pois = Team(*of_team), mean.shape[0]
        ways = team.poses[:, None, None, :2] - jnp.swapaxes(looked_from, 0, 1)[team.modality]
        apart = jnp.linalg.norm(ways, axis=-1)
        known = Known(
            belief=Belief(mean, std),
            # The policy of a run reads neither.
            looks=jnp.zeros((pois, len(config.modalities)), jnp.int32),
            log_posterior=jnp.zeros((pois, len(config.arena.classes))),
            team=team,
            times=times_to_new_looks(config.team.travel, models.novelty, team, apart),
            robot=robot,
        )
        opinion = ask(key, policy, models, known)
        return {"action": choose(settings, opinion, known), "values": opinion.values}

    pois: int | str = config.arena.num_pois
    if make_agent(config).plays(pois + 1):
        pois = "pois"
    frame = "in one frame of the map that all robots share"
    inputs = {
        **_belief(pois, config.jmvae.latent_size),
        "looked_from": Input(
            (pois, len(config.modalities), "looks", 2),
            f"places of earlier looks by each sensor at each PoI, x and y in metres {frame}; "
            "infinite for none; missions remember the last 32, and in a robot's own map all that "
            "it knows of",
        ),
        "robot": Input((), "index of the robot that chooses", "int32"),
        "positions": Input((pois, 2), f"of the PoIs, x and y in metres, {frame}"),
        "present": Input((pois,), "PoIs that this robot has not given up", "bool"),
        "poses": Input(
            ("robots", 3), f"of the robots, x and y in metres and yaw in radians, {frame}"
        ),
        "modality": Input(("robots",), "index of each robot's sensor in `modalities`", "int32"),
        "works": Input(("robots",), "robots that have neither ended by NOP nor failed", "bool"),
        "target": Input(("robots",), f"PoI that each robot heads for, {_ENDS}", "int32"),
    }
    outputs = {
        "action": "PoI to look at next; N for NOP, which ends the robot's part; -1 if a value is "
        "not a number",
        "values": "the policy's value of each action, NOP's last; the rules choose among the best",
    }
    return Function(
        "The robot's choice, by its policy and the rules of missions.", inputs, outputs, apply
    )


_BELIEF = {"mean": "of the new belief", "std": "standard deviation of the new belief"}


def _belief(*shape: int | str) -> dict[str, Input]:
    return {
        "mean": Input(shape, "of the belief about each PoI in the latent space"),
        "std": Input(shape, "standard deviation of that belief, above 0"),
    }

"""`python -m jaxsense.export RUN`: trained models as one file for robots without JAX.

The file is a zip archive of data: each function as an ONNX file, and a `contents.json` that
describes inputs and outputs. A robot runs it with two files of this package, which need neither JAX
nor jaxsense: `interfaces/robot.py` plays the functions, and `recorded/resampling.py` turns the
scans of other sensors into those that `detect` reads.
"""

import io
import json
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxsense.config import Config, ConfigError
from jaxsense.config.mission import Search
from jaxsense.config.options import Positional
from jaxsense.config.scene import MAX_BEARING
from jaxsense.config.section import Checked
from jaxsense.core.types import Belief
from jaxsense.dqn.policies import POLICIES, Known
from jaxsense.dqn.team import Team, to_go
from jaxsense.interfaces.common import extra
from jaxsense.looks import beyond_training
from jaxsense.mission import maps
from jaxsense.mission.decide import action_of
from jaxsense.mission.state import ATTEMPTS, RECENT_LOOKS
from jaxsense.models import Models, make_agent, make_travel
from jaxsense.run import cli, devices, files, output, rundir
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor
from jaxsense.tasks.registry import PREFIX

PROGRAM = "jaxsense.export"

Arrays = dict[str, jax.Array]
Struct = jax.ShapeDtypeStruct
Function = tuple[Callable[..., Arrays], dict[str, Struct]]
"""`(models, *inputs) -> {name: output}` for one look or choice, and its inputs by name."""

_POIS, _ROBOTS, _LOOKS = export.symbolic_shape(
    "pois, robots, looks", constraints=["pois >= 1", "robots >= 1", "looks >= 1"]
)
_FRAME = "in one frame of the map that all robots share"
_MEANING = {
    "readings": "of a whole scan, in the order of `angles`: distances in metres, infinite or 0 for "
    "none, or linear RGB from 0 to 1; resample other scans",
    "bearing": "of the PoI in the sensor's frame (x ahead, y left), in radians, positive leftwards",
    "distance": "expected from the sensor to the PoI's centre, in metres",
    "is_known": "whether the detector has learned from such looks, see `learned`, and the scan was "
    "recorded around the bearing; if not, what is there stays open",
    "is_there": "whether the scan shows the PoI",
    "detects": "whether it is there and a label is probable enough: only then write the look",
    "features": "probability of each label, in the order of `labels`; equal if it is not there",
    "apart": "distances from earlier looks by this sensor at the PoI, in metres; infinite for none",
    "weight": "share of the look that is new evidence, above 0 and up to 1",
    "to_go": "metres straight away from the earlier looks to where half of a look is new",
    "mean": "of the belief about a PoI in the latent space",
    "std": "standard deviation of that belief, above 0",
    "seen": "which sensors have looked at it before",
    "new_mean": "of the new belief",
    "new_std": "standard deviation of the new belief",
    "evidence": "logarithm of each class's likelihood given the look, up to a constant",
    "sums": "sum of the evidence of each robot's own looks at each PoI, from `tell`: the robot's "
    "own, and the latest that it has received; 0 for no looks",
    "probabilities": "of each class, in the order of `classes`",
    "most_likely": "index of the most likely class",
    "plausible": "which classes the belief leaves open",
    "looked_from": "places of earlier looks by each sensor at each PoI, infinite for none; x and y "
    f"in metres, {_FRAME}; robots remember `remembered_looks`",
    "robot": "index of the robot that chooses",
    "positions": f"of the PoIs, x and y in metres, {_FRAME}",
    "present": "PoIs that this robot has not given up",
    "poses": f"of the robots, x and y in metres and yaw in radians, {_FRAME}",
    "modality": "index of each robot's sensor in `modalities`",
    "works": "robots that have neither ended by NOP nor failed",
    "target": "PoI that each robot heads for, N for none",
    "action": "PoI to look at next; N for NOP, the robot's end; -1 if a value is not a number",
    "values": "the policy's value of each action, NOP's last; the highest is taken",
}
"""Of inputs and outputs."""


def functions(config: Config) -> dict[str, Function]:
    """All functions that a robot needs, by name, see `docs/interfaces.md`."""
    found = {"classify": _classify(config), "decide": _decide(config)}
    for m, sensor in enumerate(sensors.make(config)):
        of_sensor = _functions_of(config, m, sensor)
        found |= {f"{kind}_{sensor.name}": function for kind, function in of_sensor.items()}
    if config.mission.communication.own_maps:
        found["merge"] = _merge, {"sums": _real(_ROBOTS, _POIS, len(config.arena.classes))}
    return found


def _real(*shape: Any) -> Struct:
    return Struct(shape, jnp.float32)


def _functions_of(config: Config, m: int, sensor: Sensor) -> dict[str, Function]:
    """What a robot does with looks by a sensor."""

    def detect(
        models: Models, readings: jax.Array, bearing: jax.Array, distance: jax.Array
    ) -> Arrays:
        """What a look says."""
        search = Search(*config.mission.localisation.search)
        found = models.detect(m, sensor, readings, bearing, distance, search)
        is_confident = jnp.max(found.features) >= config.mission.least_confidence
        return {**vars(found), "detects": found.is_there & is_confident}

    def weigh(models: Models, apart: jax.Array) -> Arrays:
        """How much of a look is new after earlier ones."""
        novelty = models.novelty
        return {"weight": novelty.weight(apart, m), "to_go": novelty.to_go(apart, m)}

    def tell(models: Models, features: jax.Array, weight: jax.Array) -> Arrays:
        """The evidence of a look, for the sum of a robot's own looks."""
        return {"evidence": maps.evidence_of(models, features, m, weight).log_likelihood}

    def write(
        models: Models, mean: jax.Array, std: jax.Array, seen: jax.Array, *look: jax.Array
    ) -> Arrays:
        """The belief about a PoI after a look."""
        features, weight = look
        after = models.fusion.update(Belief(mean, std), seen, features, m, weight)
        return {"new_mean": after.mean, "new_std": after.std}

    own_maps = config.mission.communication.own_maps
    belief = dict.fromkeys(("mean", "std"), _real(config.jmvae.latent_size))
    seen = {"seen": Struct((len(config.modalities),), bool)}
    look = {"features": _real(len(config.labels(sensor.name))), "weight": _real()}
    scan = {"readings": _real(*sensor.shape), "bearing": _real(), "distance": _real()}
    return {
        "detect": (detect, scan),
        "weigh": (weigh, {"apart": _real(_LOOKS)}),
        **({"tell": (tell, look)} if own_maps else {"write": (write, belief | seen | look)}),
    }


def _merge(models: Models, sums: jax.Array) -> Arrays:
    """A robot's map, from what each robot has said of its own looks."""
    of_poi = jax.vmap(lambda total: maps.belief_of(models.fusion, total))
    return vars(of_poi(jnp.sum(sums, axis=0)))


def _classify(config: Config) -> Function:
    def classify(models: Models, *belief: jax.Array) -> Arrays:
        """What the map says about the classes."""
        read = Belief(*belief)
        probabilities = jax.vmap(models.fusion.class_probabilities)(read)
        return {
            "probabilities": probabilities,
            "most_likely": jnp.argmax(probabilities, axis=1).astype(jnp.int32),
            "plausible": jax.vmap(models.plausible_classes)(read),
        }

    return classify, dict.fromkeys(("mean", "std"), _real(_POIS, config.jmvae.latent_size))


def _decide(config: Config) -> Function:
    key = jax.random.key(0)  # the policy draws nothing
    modalities, classes = len(config.modalities), len(config.arena.classes)

    def decide(
        models: Models,
        mean: jax.Array,
        std: jax.Array,
        looked_from: jax.Array,
        robot: jax.Array,
        *of_team: jax.Array,
    ) -> Arrays:
        """The robot's choice: the action of the highest value."""
        team = Team(*of_team)
        travel = make_travel(config)
        apart = lambda place, poi, m: jnp.linalg.norm(looked_from[poi, m] - place[None], axis=-1)  # noqa: E731
        known = Known(
            belief=Belief(mean, std),
            # The policy of a run reads neither.
            looks=jnp.zeros((mean.shape[0], modalities), jnp.int32),
            log_posterior=jnp.zeros((mean.shape[0], classes)),
            team=team,
            times=travel.times(team, to_go(models.novelty, travel, team, apart)),
            robot=robot,
        )
        values = POLICIES["latent"](key, models, known)
        return {"action": action_of(values, known), "values": values}

    pois = config.arena.num_pois
    pois = _POIS if make_agent(config).plays(pois + 1) else pois
    return decide, {
        "mean": _real(pois, config.jmvae.latent_size),
        "std": _real(pois, config.jmvae.latent_size),
        "looked_from": _real(pois, modalities, _LOOKS, 2),
        "robot": Struct((), jnp.int32),
        "positions": _real(pois, 2),
        "present": Struct((pois,), bool),
        "poses": _real(_ROBOTS, 3),
        "modality": Struct((_ROBOTS,), jnp.int32),
        "works": Struct((_ROBOTS,), bool),
        "target": Struct((_ROBOTS,), jnp.int32),
    }


def archive(config: Config, models: Models) -> bytes:
    """Returns the content of the file.

    Raises:
      ModuleNotFoundError: if the extra `export` is not installed.
      NotImplementedError: if a custom sensor, fusion or agent computes what has no translation.
      ValueError: if the archive is larger than `robot.load` reads.
    """
    with extra("export"):
        from jaxsense.interfaces import robot, translate  # noqa: PLC0415
    content, programs = io.BytesIO(), {}
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as files:
        for name, (apply, inputs) in functions(config).items():
            onnx, outputs = translate.program(name, apply, models, inputs)
            files.writestr(f"{name}.onnx", onnx)
            ends = {"inputs": _described(inputs), "outputs": _described(outputs)}
            programs[name] = {"about": apply.__doc__, **ends}
        contents = json.dumps({**_description(config, models), "programs": programs}, indent=2)
        files.writestr("contents.json", contents + "\n")
    robot.load(content)  # a robot, far away, would only see that it cannot
    return content.getvalue()


def _described(arrays: dict[str, Struct]) -> dict[str, dict[str, object]]:
    return {
        name: {
            "shape": [n if isinstance(n, int) else str(n) for n in array.shape],
            "dtype": array.dtype.name,
            "about": _MEANING[name],
        }
        for name, array in arrays.items()
    }


def _description(config: Config, models: Models) -> dict[str, object]:
    """Everything a reader of the file needs except the programs."""
    prior, viewpoint = models.fusion.prior, config.viewpoint
    own_maps = config.mission.communication.own_maps
    return {
        "modalities": config.modalities,
        "robots": config.carried,
        "classes": config.arena.classes,
        "labels": {name: config.labels(name) for name in config.modalities},
        "label_of_class": {name: config.label_of_class(name) for name in config.modalities},
        "num_pois": config.arena.num_pois,
        "unseen": {name: np.asarray(x).tolist() for name, x in vars(prior).items()},
        "sensors": {sensor.name: _of_sensor(sensor) for sensor in sensors.make(config)},
        "learned": {
            name: {limit: np.nan_to_num(x).tolist() for limit, x in vars(domain).items()}
            for name, domain in zip(config.modalities, models.domains, strict=True)
        },
        "viewpoint": {
            "min_distance": float(viewpoint.min_distance),
            "max_distance": float(viewpoint.max_distance),
            "max_bearing": round(math.radians(MAX_BEARING), 6),
        },
        "mission": {"attempts": ATTEMPTS},
        "remembered_looks": maps.MOST_LOOKS if own_maps else RECENT_LOOKS,
        "versions": {"jaxsense": __version__},
    }


def _of_sensor(sensor: Sensor) -> dict[str, object]:
    """Directions of rays and width of the window that a detector reads, in radians; height in m."""
    rays = min((sensor.window - 1) * sensor.stride, len(sensor.angles) - 1)
    first = (len(sensor.angles) - 1 - rays) // 2
    return {
        "angles": [round(float(angle), 6) for angle in sensor.angles],
        "height": float(sensor.height),
        "window": round(float(abs(sensor.angles[first + rays] - sensor.angles[first])), 6),
    }


class Arguments(Checked):
    """Writes detectors, fusion and policies of a run into one file for robots without JAX.

    Attributes:
      run: The directory of a finished run, e.g. `runs/20261123-190025-default`, or `latest` for the
        newest one in `runs/`, or `pretrained:PRESET` for models that come with jaxsense.
      out: File to write, which must not exist yet; by default `exported.zip` in the run's
        directory, or `PRESET.zip` in the current directory.
      trust: Trust the run's `config.json`: run the code of custom sensors that it names.
    """

    run: Positional[Path]
    out: Path | None = None
    trust: bool = False


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    arguments = cli.parse(PROGRAM, Arguments, argv)
    run, path = arguments.run, arguments.out
    is_run = run.exists() or not str(run).startswith(PREFIX)
    try:
        devices.start(1)
        run = rundir.newest(run) if is_run else run
        config, models = rundir.load(run, arguments.trust)
        for what in beyond_training(config):
            cli.warn(PROGRAM, what)
        preset = str(run).removeprefix(PREFIX)
        path = path or (run / "exported.zip" if is_run else Path(f"{preset}.zip"))
        # Before seconds of work.
        if path.name in os.listdir(path.parent):
            raise ConfigError("out", str(path), "already exists; must be a new file")
        files.write(path, content := archive(config, models), is_new=True)
    except (ValueError, ModuleNotFoundError, NotImplementedError) as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        cli.fail(PROGRAM, f"out = {str(path)!r}: cannot be written ({error.strerror or error})")
    played = "a robot plays it with jaxsense/interfaces/robot.py"
    output.say(f"{path}: {len(content) / 1e3:.0f} kB; {played}")


if __name__ == "__main__":
    output.run(main)

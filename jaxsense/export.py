"""`python -m jaxsense.export RUN`: trained models as one file for robots without JAX.

The file is a zip archive of data: each function as an ONNX file, and a `contents.json` that
describes inputs and outputs. A robot runs it with two files of this package, which need neither JAX
nor jaxsense: `interfaces/robot.py` plays the functions, and `recorded/resampling.py` turns the
scans of other sensors into those that `detect` reads.
"""

import dataclasses
import io
import json
import math
import sys
import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np

from jaxsense.config import Config, ConfigError
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.interfaces.extras import extra
from jaxsense.interfaces.graph import OPSET, Constants, as_onnx
from jaxsense.interfaces.onboard import functions
from jaxsense.interfaces.translate import arrays_of, program
from jaxsense.mission.memory import MOST_LOOKS
from jaxsense.mission.state import RECENT_LOOKS
from jaxsense.models import Models
from jaxsense.run import cli, devices, files, output, rundir
from jaxsense.run.version import __version__
from jaxsense.sim import sensors
from jaxsense.sim.sensors import Sensor
from jaxsense.tasks.pretrained import PREFIX

PROGRAM = "jaxsense.export"


def archive(config: Config, models: Models) -> bytes:
    """Returns the content of the file.

    Args:
      config: settings of the run.
      models: its trained models.

    Raises:
      ModuleNotFoundError: if the extra `export` is not installed.
      NotImplementedError: if a custom sensor, fusion or agent computes what has no translation.
      ValueError: if the archive is larger than `robot.load` reads.
    """
    with extra("export"):
        from jaxsense.interfaces import robot  # noqa: PLC0415
    content, described, constants = io.BytesIO(), {}, Constants(arrays_of(models))
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as files:
        for name, function in functions(config).items():
            inputs = {key: (each.dtype, each.shape) for key, each in function.inputs.items()}
            found = program(function.apply, models, inputs, constants)
            onnx = as_onnx(name, function.about, found.graph, constants.arrays, found.outputs)
            files.writestr(f"{name}.onnx", onnx)
            described[name] = {
                "about": function.about,
                "inputs": {
                    key: _described(*inputs[key], each.about)
                    for key, each in function.inputs.items()
                },
                "outputs": {
                    key: _described(*each, function.outputs[key])
                    for key, each in found.outputs.items()
                },
            }
        contents = json.dumps({**_description(config, models), "programs": described}, indent=2)
        files.writestr("contents.json", contents + "\n")
    robot.load(content)  # a robot, far away, would only see that it cannot
    return content.getvalue()


def _description(config: Config, models: Models) -> dict[str, object]:
    """Everything a reader of the file needs except the programs."""
    prior, mission, viewpoint = models.fusion.prior, config.mission, config.viewpoint
    return {
        "modalities": config.modalities,
        "robots": config.carried,
        "classes": config.arena.classes,
        "labels": {name: config.labels(name) for name in config.modalities},
        "label_of_class": {name: config.label_of_class(name) for name in config.modalities},
        "class_means": np.asarray(models.fusion.classes.mean).tolist(),
        "num_pois": config.arena.num_pois,
        "pois": {
            "radius": float(config.arena.poi_radius),
            "height": float(config.arena.poi_height),
            "about": "of the PoIs that the detectors know, in metres; half the side of boxes",
        },
        "unseen": {name: np.asarray(x).tolist() for name, x in vars(prior).items()},
        "sensors": {sensor.name: _of_sensor(sensor) for sensor in sensors.make(config)},
        "learned": {
            name: {limit: np.nan_to_num(x).tolist() for limit, x in vars(domain).items()}
            for name, domain in zip(config.modalities, models.domains, strict=True)
        },
        "viewpoint": {
            "min_distance": float(viewpoint.min_distance),
            "max_distance": float(viewpoint.max_distance),
            "max_bearing": round(math.radians(float(viewpoint.max_bearing)), 6),
            "about": "from where the detectors have learned to look at a PoI: distances of its "
            "centre, in metres, and the largest bearing to either side, in radians",
        },
        "mission": {"attempts": int(mission.attempts), "redecides": bool(mission.redecides)},
        "remembered_looks": MOST_LOOKS if mission.communication.own_maps else RECENT_LOOKS,
        "opset": OPSET,
        "versions": {"jaxsense": __version__},
    }


def _of_sensor(sensor: Sensor) -> dict[str, object]:
    """How a scan is given to `detect`."""
    rays = min((sensor.window - 1) * sensor.stride, len(sensor.angles) - 1)
    first = (len(sensor.angles) - 1 - rays) // 2
    last = first + rays
    return {
        "readings": "distances in metres, infinite or 0 for none"
        if sensor.measures_distance
        else "linear RGB from 0 to 1"
        if sensor.channels == 3
        else "readings",
        "angles": [round(float(angle), 6) for angle in sensor.angles],
        "height": float(sensor.height),
        "window": round(float(abs(sensor.angles[last] - sensor.angles[first])), 6),
        "about": "one reading for each ray; `angles` are the rays' directions in the sensor's "
        "frame (x ahead, y left), in radians, positive to the left; `height` is that of the rays "
        "above the floor, in metres; `window` is how wide a part of the scan the detector reads, "
        "in radians",
    }


def _described(dtype: str, shape: tuple[int | str, ...], about: str) -> dict[str, object]:
    """An array, with the names of axes of any size, such as "pois"."""
    return {"shape": shape, "dtype": dtype, "about": about}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Writes detectors, encoders and policies of a run into one file for robots without JAX."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, e.g. `runs/20261123-190025-default`, or `latest` for the
    newest one in `runs/`, or `pretrained:PRESET` for models that come with jaxsense."""
    out: Path | None = None
    """File to write, which must not exist yet; by default `exported.zip` in the run's directory, or
    `PRESET.zip` in the current directory."""
    trust: bool = False
    """Trust the run's `config.json`: run the code of custom sensors that it names."""

    def __post_init__(self):
        check_fields(self)


def load(run: Path, trust: bool = False) -> tuple[Config, Models, Path]:
    """Settings and models of a run, and where its archive goes by default.

    Args:
      run: its directory, `latest`, or `pretrained:PRESET`.
      trust: whether to run the code of custom sensors.

    Raises:
      ConfigError: if there is no such run, or no such models.
    """
    if (given := str(run)).startswith(PREFIX) and not run.exists():
        return *rundir.load(run), Path(f"{given.removeprefix(PREFIX)}.zip")
    run = rundir.newest(run)
    return *rundir.load(run, trust), run / "exported.zip"


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    path = arguments.out
    try:
        devices.start(1)
        config, models, by_default = load(arguments.run, arguments.trust)
        path = path or by_default
        with files.new(path) as file:
            file.write(content := archive(config, models))
    except FileExistsError:
        cli.fail(PROGRAM, str(ConfigError("out", str(path), "already exists; must be a new file")))
    except (ValueError, ModuleNotFoundError, NotImplementedError) as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        cli.fail(PROGRAM, f"out = {str(path)!r}: cannot be written ({error.strerror or error})")
    played = "a robot plays it with jaxsense/interfaces/robot.py"
    output.say(f"{path}: {len(content) / 1e3:.0f} kB; {played}")


if __name__ == "__main__":
    output.run(main)

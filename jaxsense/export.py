"""`python -m jaxsense.export RUN_DIR`: a run's models as one file that runs without jaxsense.

The file is a zip archive of `jax.export` artefacts and a `contents.json` with their names, inputs
and outputs. `examples/run_exported.py` shows how to run them.
"""

import dataclasses
import importlib
import importlib.metadata
import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Annotated, Protocol

import jax
import numpy as np
from jax import export

from jaxsense.config import Config, ConfigError
from jaxsense.config.checks import check_fields
from jaxsense.config.options import Name
from jaxsense.interfaces.onboard import Function, functions
from jaxsense.models import Models
from jaxsense.run import cli, files, rundir
from jaxsense.run.version import __version__

PROGRAM = "jaxsense.export"
PLATFORMS = ("cpu", "cuda", "tpu")
"""Platforms that the programs of a file run on."""


class _Aval(Protocol):
    """Shape and dtype of an input or an output."""

    shape: tuple[object, ...]
    dtype: np.dtype


def exported(function: Function) -> export.Exported:
    """A function for a batch of any size, lowered for all of `PLATFORMS`."""
    one = [jax.ShapeDtypeStruct((1, *x.shape), x.dtype) for x in function.inputs.values()]
    sizes = [f"batch, {function.any_size.get(name, '...')}" for name in function.inputs]
    inputs = export.symbolic_args_specs(one, sizes)
    return export.export(jax.jit(jax.vmap(function.apply)), platforms=PLATFORMS)(*inputs)


def archive(config: Config, models: Models) -> bytes:
    """Returns the content of the file.

    Args:
      config: settings of the run.
      models: its trained models.
    """
    content, programs = io.BytesIO(), {}
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as files:
        for name, function in functions(config, models).items():
            program = exported(function)
            files.writestr(f"{name}.bin", program.serialize())
            outputs = jax.tree.unflatten(program.out_tree, program.out_avals)
            programs[name] = {
                "about": function.about,
                "inputs": {
                    name: _described(aval)
                    for name, aval in zip(function.inputs, program.in_avals, strict=True)
                },
                "outputs": {name: _described(aval) for name, aval in outputs.items()},
            }
        contents = json.dumps({**_description(config, models), "programs": programs}, indent=2)
        files.writestr("contents.json", contents + "\n")
    return content.getvalue()


def _description(config: Config, models: Models) -> dict[str, object]:
    """Everything a reader of the file needs except the programs."""
    arena = config.arena
    versions = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib")}
    prior = models.fusion.prior
    return {
        "modalities": config.modalities,
        "robots": config.carried,
        "classes": arena.classes,
        "labels": {name: config.labels(name) for name in config.modalities},
        "label_of_class": {name: config.label_of_class(name) for name in config.modalities},
        "class_means": np.asarray(models.fusion.classes.mean).tolist(),
        "num_pois": arena.num_pois,
        "unseen": {name: np.asarray(x).tolist() for name, x in vars(prior).items()},
        "platforms": PLATFORMS,
        "versions": {"jaxsense": __version__, **versions},
    }


def _described(aval: _Aval) -> dict[str, object]:
    """Dtype and shape, with the names of axes of any size, such as "batch"."""
    shape = [n if isinstance(n, int) else str(n) for n in aval.shape]
    return {"shape": shape, "dtype": aval.dtype.name}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Writes a run's detectors, encoders and policies into one file that runs without jaxsense."""

    run: Annotated[Path, Name("RUN")]
    """The directory of a finished run, e.g. `runs/20261123-190025-default`, or `latest` for the
    newest one in `runs/`."""
    out: Path | None = None
    """File to write; it must not exist yet. By default `exported.zip` in the run's directory."""
    trust: bool = False
    """Run the code of custom sensors that the run's `config.json` names."""

    def __post_init__(self):
        check_fields(self)


def main(argv: list[str] | None = None) -> None:
    """Runs the program."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    path = arguments.out
    try:
        run = cli.find_run(arguments.run)
        path = path or run / "exported.zip"
        config, models = rundir.load(run, arguments.trust)
        with files.new(path) as file:
            file.write(content := archive(config, models))
    except FileExistsError:
        cli.fail(PROGRAM, str(ConfigError("out", str(path), "already exists; must be a new file")))
    except ConfigError as error:
        cli.fail(PROGRAM, str(error))
    except OSError as error:
        cli.fail(PROGRAM, f"out = {str(path)!r}: cannot be written ({cli.reason(error)})")
    print(f"{path}: {len(content) / 1e3:.0f} kB, for {', '.join(PLATFORMS)}")


if __name__ == "__main__":
    cli.run(main)

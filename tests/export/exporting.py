"""Settings and models for tests of exported files, and processes that play them."""

import dataclasses
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig
from jaxsense.core.types import Belief
from jaxsense.interfaces import robot
from jaxsense.models import make_in_place
from jaxsense.recorded import resampling
from jaxsense.vae.novelty import Novelty

EXAMPLE = Path(__file__).parents[2] / "examples" / "run_exported.py"
COPIED = EXAMPLE, Path(robot.__file__), Path(resampling.__file__)
"""What a robot needs besides an archive."""
CONFIG = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(hidden=(8,)),
    jmvae=JmvaeConfig(hidden=(8,)),
)
ALONE = """
import sys

absent = sys.argv.pop(1).split(",")

class Only:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"{name} is not here", name=name)

sys.meta_path.insert(0, Only())
sys.path.insert(0, sys.argv.pop(1))
"""
RUN_ALL = """
import numpy as np
from robot import load
contents, programs = load(sys.argv[1])
inputs, found = np.load(sys.argv[2]), {}
for name, about in contents["programs"].items():
    given = {key: inputs[f"{name}/{key}"] for key in about["inputs"] if f"{name}/{key}" in inputs}
    if not given:
        continue
    rows = [programs[name](**{key: x[row] for key, x in given.items()})
            for row in range(len(next(iter(given.values()))))]
    found |= {f"{name}/{key}": np.stack([row[key] for row in rows]) for key in rows[0]}
np.savez(sys.argv[3], **found)
"""
ABSENT = "jaxsense,jax,jaxlib,onnx"


def run_alone(code, *arguments, absent=ABSENT, copied=COPIED):
    """Runs code where nothing is there but what a robot needs."""
    with tempfile.TemporaryDirectory() as folder:
        for file in copied:
            shutil.copy(file, folder)
        command = [sys.executable, "-I", "-c", ALONE + code, absent, folder, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False)


def played(path, inputs, folder):
    """What a robot's programs give for `{NAME/KEY: array}`, alone."""
    given, found = folder / "in.npz", folder / "out.npz"
    np.savez(given, **inputs)
    done = run_alone(RUN_ALL, path, given, found)
    assert done.returncode == 0, done.stderr
    return dict(np.load(found))


def with_classes(models, config):
    """The models, with classes at random places in the latent space."""
    means = jax.random.normal(jax.random.key(1), models.fusion.classes.mean.shape)
    classes = Belief(means, jnp.ones_like(means))
    return dataclasses.replace(
        models,
        fusion=make_in_place(config, models.jmvae, classes),
        novelty=Novelty(jnp.array([5.0, 20.0]), jnp.array([0.3, 0.9])),
    )

"""Settings for tests of exported files, and inputs of their programs."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxsense.config import PRESETS, DetectorConfig, JmvaeConfig

EXAMPLE = Path(__file__).parents[2] / "examples" / "run_exported.py"
CONFIG = dataclasses.replace(
    PRESETS["smoke"],
    detector=DetectorConfig(hidden=(8,)),
    jmvae=JmvaeConfig(hidden=(8,)),
)


def drawn(rng, contents, name, sizes):
    """Plausible inputs of a program."""
    given = {}
    most = {"robot": sizes["robots"], "target": sizes["pois"] + 1}
    for key, about in contents["programs"][name]["inputs"].items():
        shape = tuple(sizes.get(n, n) for n in about["shape"])
        found = rng.uniform(0.1, 1.0, shape)
        if about["dtype"] == "int32":
            found = rng.integers(0, most.get(key, len(contents["modalities"])), shape)
        elif about["dtype"] == "bool":
            found = found > 0.3
        elif key == "features":  # probabilities
            found = found / found.sum()
        elif key in ("bearing", "distance"):  # as far as was learned
            found = 0.3 * found if key == "bearing" else found + 0.2
        given[key] = np.asarray(found, about["dtype"])
    return given

import os
from pathlib import Path

import filelock
import pytest
from smoke import SMOKE

os.environ["JAX_PLATFORMS"] = "cpu"

import jax

jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """A directory of this session, the same for all workers."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def cache(shared) -> list[str]:
    """Options with which programs are compiled once for all runs."""
    return ["--cache", str(shared / "cache")]


@pytest.fixture(scope="session")
def smoke_run(shared, cache) -> Path:
    """A finished run with `SMOKE`, made by whichever worker needs it first; to be read only."""
    from jaxsense import train

    path = shared / "smoke"
    with filelock.FileLock(shared / "smoke.lock"):
        if not (path / "summary.json").exists():
            train.main([*SMOKE, *cache, "--out", str(path)])
    return path

import atexit
import gc
import os
import shutil
import signal
import tempfile
from pathlib import Path

# In the environment, so that processes which tests start have them too.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
# Compiling takes most of the time of the tests, and with the newer code generator twice as long.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["XLA_FLAGS"] = " ".join(
    (
        "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters",
        # The parts of a program are linked for longer than two cores save.
        "--xla_cpu_parallel_codegen_split_count=1",
        # They have all other passes run again after each level of nested loops.
        "--xla_disable_hlo_passes=while-loop-invariant-code-motion,while-loop-constant-sinking",
    )
)
# Before JAX creates its backend, as the programs do: more than any test runs side by side.
os.environ["NPROC"] = str(max(8, os.cpu_count() or 1))
# Each operation would carry the lines of Python that it comes from through all of compiling.
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
# What one worker, or a process that a test starts, has compiled serves all others.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxsense-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

import filelock
import pytest
import xdist

# A script may have started this in the background, where Ctrl-C is not for it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Tracing makes and drops millions of small objects, and each collection looks through all that
# lives: a tenth to a quarter of the time of tests.
gc.set_threshold(100_000, 50, 50)

SLOW = 3600  # s


def pytest_sessionstart(session):
    """Imports JAX, which takes seconds, where tests run and not in the process that starts them."""
    if not xdist.is_xdist_controller(session):
        import jax

        jax.config.update("jax_num_cpu_devices", 2)


def pytest_sessionfinish():
    """At its end, pytest would look five times through gigabytes of compiled programs."""
    gc.freeze()


def pytest_collection_modifyitems(items):
    """Slow tests may take longer."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW))


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
    from smoke import SMOKE

    from jaxsense import train

    path = shared / "smoke"
    with filelock.FileLock(shared / "smoke.lock"):
        if not (path / "summary.json").exists():
            train.main([*SMOKE, *cache, "--out", str(path)])
    return path

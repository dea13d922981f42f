import jax
import pytest


@pytest.fixture(scope="package", autouse=True)
def fast_compilation():
    """Compiling takes nearly all of the time of these tests."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)

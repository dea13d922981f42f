"""How the stages of a run hang together."""

import jax
import pytest

from jaxsense import examine, pipeline
from jaxsense.config import PRESETS
from jaxsense.monitor import Monitor


def test_a_program_that_cannot_be_traced_ends_the_run_with_its_error(monkeypatch):
    def broken(*args, **settings):
        raise ArithmeticError("no such policy")

    monkeypatch.setattr(examine, "latent_space", broken)
    with pytest.raises(ArithmeticError, match="no such policy"):
        pipeline.run(jax.random.key(0), PRESETS["smoke"], Monitor())

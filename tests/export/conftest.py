import dataclasses

import jax
import jax.numpy as jnp
import pytest
from exporting import CONFIG
from smoke import save_models
from untrained import untrained

from jaxsense import export
from jaxsense.core.novelty import Novelty
from jaxsense.core.types import Belief
from jaxsense.models import make_in_place
from jaxsense.run.rundir import RunDirectory, Settings


@pytest.fixture(scope="session")
def models():
    """Models, with classes at random places in the latent space."""
    found = untrained(CONFIG)
    means = jax.random.normal(jax.random.key(1), found.fusion.classes.mean.shape)
    return dataclasses.replace(
        found,
        fusion=make_in_place(CONFIG, found.jmvae, Belief(means, jnp.ones_like(means))),
        novelty=Novelty(jnp.array([5.0, 20.0]), jnp.array([0.3, 0.9])),
    )


@pytest.fixture(scope="session")
def run(models, tmp_path_factory):
    """The directory of a run that trained nothing."""
    path = tmp_path_factory.mktemp("runs") / "run"
    with RunDirectory.create(path, Settings("smoke", 0, CONFIG)) as created:
        save_models(created, models)
    return path


@pytest.fixture(scope="session")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "exported.zip"
    export.main([str(run), "--out", str(path)])
    return path

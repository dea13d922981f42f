import jax
import pytest
from exporting import CONFIG, with_classes
from smoke import save_models

from jaxsense import export
from jaxsense.models import init
from jaxsense.run.rundir import RunDirectory, Settings


@pytest.fixture(scope="session")
def models():
    return with_classes(init(jax.random.key(0), CONFIG), CONFIG)


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

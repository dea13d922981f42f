"""A missing package is named in one line, and the site is built without any."""

import importlib
import sys

import pytest

import jaxsense.interfaces

EXTRAS = {
    "gymnax": ("gymnax", "gymnax"),
    "rejax": ("gymnax", "rejax"),
    "gymnasium": ("gymnasium", "gymnasium"),
    "stable_baselines3": ("gymnasium", "sb3"),
    "jaxmarl": ("jaxmarl", "jaxmarl"),
    "pettingzoo": ("gymnasium", "pettingzoo"),
}


class Mocked:
    """What stands for a package where the site is built without it; see `autodoc_mock_imports`."""

    __path__ = ()

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Mocked()

    def __mro_entries__(self, bases):
        return ()

    def __call__(self, *args, **more):
        return Mocked()

    def __getitem__(self, key):
        return Mocked()

    def __contains__(self, key):
        return False


PARTS = (
    "gymnasium", "gymnasium.vector", "gymnasium.vector.utils", "gymnax", "gymnax.environments",
    "jaxmarl", "jaxmarl.environments", "pettingzoo", "pettingzoo.utils", "rejax",
    "stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env",
)  # fmt: skip


@pytest.fixture
def anew(monkeypatch):
    """Imports an interface as for the first time, and forgets it at the end."""
    kept = dict(sys.modules)
    for name in EXTRAS:
        monkeypatch.delitem(sys.modules, f"jaxsense.interfaces.{name}", raising=False)
        monkeypatch.delattr(jaxsense.interfaces, name, raising=False)
    yield lambda name: importlib.import_module(f"jaxsense.interfaces.{name}")
    for name in EXTRAS:
        vars(jaxsense.interfaces).pop(name, None)
        if f"jaxsense.interfaces.{name}" not in kept:
            sys.modules.pop(f"jaxsense.interfaces.{name}", None)


@pytest.mark.parametrize("module", EXTRAS)
def test_a_missing_package_is_named_with_its_extra(anew, monkeypatch, module):
    package, extra = EXTRAS[module]
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError) as error:
        anew(module)
    assert str(error.value) == f"{package} is not installed: pip install 'jaxsense[{extra}]'"


@pytest.mark.parametrize("module", EXTRAS)
def test_the_site_is_built_without_the_packages(anew, monkeypatch, module):
    for name in PARTS:
        monkeypatch.setitem(sys.modules, name, Mocked())
    assert anew(module).__doc__

"""A missing package is named in one line, with the extra that holds it."""

import importlib
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "package", "extra"),
    [
        ("gymnax", "gymnax", "gymnax"),
        ("rejax", "gymnax", "rejax"),
        ("gymnasium", "gymnasium", "gymnasium"),
        ("stable_baselines3", "gymnasium", "sb3"),
        ("jaxmarl", "jaxmarl", "jaxmarl"),
        ("pettingzoo", "pettingzoo", "pettingzoo"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(monkeypatch, module, package, extra):
    for name in list(sys.modules):
        if name.partition(".")[0] == package:
            monkeypatch.setitem(sys.modules, name, None)
        if name.startswith("jaxsense.interfaces."):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    # An import leaves the module on its package as well.
    interfaces = importlib.import_module("jaxsense.interfaces")
    for name in (
        "gymnax",
        "rejax",
        "gymnasium",
        "stable_baselines3",
        "jaxmarl",
        "pettingzoo",
    ):
        monkeypatch.delattr(interfaces, name, raising=False)
    with pytest.raises(ModuleNotFoundError) as error:
        importlib.import_module(f"jaxsense.interfaces.{module}")
    assert str(error.value) == f"{package} is not installed: pip install 'jaxsense[{extra}]'"


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
    "jaxmarl", "jaxmarl.environments", "pettingzoo", "rejax", "stable_baselines3",
    "stable_baselines3.common", "stable_baselines3.common.vec_env",
)  # fmt: skip


@pytest.mark.parametrize(
    "module", ["gymnax", "rejax", "gymnasium", "stable_baselines3", "jaxmarl", "pettingzoo"]
)
def test_the_site_is_built_without_the_packages(monkeypatch, module):
    for name in list(sys.modules):
        if name.startswith("jaxsense.interfaces."):
            monkeypatch.delitem(sys.modules, name)
    for name in PARTS:
        monkeypatch.setitem(sys.modules, name, Mocked())
    interfaces = importlib.import_module("jaxsense.interfaces")
    for name in ("gymnax", "rejax", "gymnasium", "stable_baselines3", "jaxmarl", "pettingzoo"):
        monkeypatch.delattr(interfaces, name, raising=False)
    assert importlib.import_module(f"jaxsense.interfaces.{module}").__doc__

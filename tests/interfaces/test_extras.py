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

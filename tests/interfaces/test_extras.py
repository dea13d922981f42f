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

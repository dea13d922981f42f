"""A missing package is named in one line, and the site is built without any."""

import runpy
import sys
from pathlib import Path

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


@pytest.mark.parametrize("module", EXTRAS)
def test_a_missing_package_is_named_with_its_extra(monkeypatch, module):
    package, extra = EXTRAS[module]
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, package, None)
    for name in EXTRAS:  # some import others
        monkeypatch.delitem(sys.modules, f"jaxsense.interfaces.{name}", raising=False)
        monkeypatch.delattr(jaxsense.interfaces, name, raising=False)
    with pytest.raises(ModuleNotFoundError) as error:
        runpy.run_path(str(Path(jaxsense.interfaces.__file__).with_name(f"{module}.py")))
    assert str(error.value) == f"{package} is not installed: pip install 'jaxsense[{extra}]'"

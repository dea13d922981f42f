"""Names and arguments that snippets of pages, notebooks and examples use; nothing of them runs."""

import ast
import importlib
import inspect
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


def programs(path):
    """The Python programs of a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        return ["\n".join("".join(x["source"]) for x in cells if x["cell_type"] == "code")]
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL) if path.suffix == ".md" else [text]


def imported(tree):
    """What a program imports from the package, by the names that it gives it."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for each in node.names:
                top = each.name.partition(".")[0]
                found[each.asname or top] = module(each.name) and module(
                    each.name if each.asname else top
                )
        elif isinstance(node, ast.ImportFrom):
            owner = module(node.module)
            for each in node.names:
                found[each.asname or each.name] = owner and (
                    getattr(owner, each.name, None) or module(f"{node.module}.{each.name}")
                )
    return {name: meant for name, meant in found.items() if meant is not None}


def module(name):
    """A module of the package; None for others, and if a library is missing that it needs."""
    if name.partition(".")[0] != "jaxsense":
        return None
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if str(error.name).partition(".")[0] == "jaxsense":
            raise
        return None


def looked_up(node, names):
    """What an expression of names and dots means; None unless it begins with a name of `names`.

    Raises:
      AttributeError: if a module or class lacks a name.
    """
    if isinstance(node, ast.Name):
        return names.get(node.id)
    if not isinstance(node, ast.Attribute):
        return None
    owner = looked_up(node.value, names)
    if not isinstance(owner, ModuleType | type):
        return None
    if isinstance(owner, type) and node.attr in getattr(owner, "__annotations__", ()):
        return None
    return getattr(owner, node.attr)


def unfitting(tree):
    """The shortest expression with a name that the package lacks, or arguments that do not fit."""
    names, found = imported(tree), []
    for node in ast.walk(tree):
        try:
            looked_up(node, names)
            if isinstance(node, ast.Call) and (function := looked_up(node.func, names)):
                bind(function, node)
        except (AttributeError, TypeError) as error:
            found.append(f"{ast.unparse(node)}: {error}")
    return sorted(set(found), key=len)[:1]


def bind(function, call):
    """Raises a TypeError if the arguments of a call do not fit, as far as it names them."""
    if any(isinstance(x, ast.Starred) for x in call.args) or None in [x.arg for x in call.keywords]:
        return
    try:
        signature = inspect.signature(function)
    except ValueError:  # it has none
        return
    signature.bind(*call.args, **{word.arg: word.value for word in call.keywords})


PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "examples").rglob("*.py")),
    *sorted((ROOT / "examples").rglob("*.ipynb")),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_use_what_the_package_has(page):
    for program in programs(page):
        assert not unfitting(ast.parse(program))


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("import jaxsense\njaxsense.made_up()", "No jaxsense attribute made_up"),
        ("from jaxsense import vae\nvae.Jmvae.nothing", "no attribute 'nothing'"),
        ("import jaxsense\njaxsense.make('noisy-v0', robot='lidar')", "unexpected keyword"),
        ("import jaxsense as j\nj.make()", "missing a required argument"),
    ],
)
def test_what_does_not_fit_is_found(program, expected):
    (found,) = unfitting(ast.parse(program))
    assert expected in found

"""How Sphinx builds the site: `sphinx-build -W --keep-going -b html docs docs/_build/html`."""

import importlib.util
import pkgutil
import re
import sys
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import jaxsense

sys.path.insert(0, str(Path(__file__).parent))
import generate

generate.write()

project = "jaxsense"
author = "the jaxsense authors"
copyright = f"2026, {author}"
release = version = jaxsense.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
# A reference within jaxsense that leads nowhere is a warning.
nitpicky = True
# Type variables have no page.
nitpick_ignore_regex = [
    ("py:.*", r"(?!jaxsense).*"),
    ("py:(class|obj)", r".*\.([BDEMRST](_co)?|Row|Result|Annotated)"),
]

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3

# Docstrings put code between single backquotes.
default_role = "literal"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# As a list in the class: a field whose default is a function would be described twice otherwise.
napoleon_use_ivar = True
napoleon_attr_annotations = False
autodoc_member_order = "bysource"
# Every pytree has the `replace` of flax.
# Names that the package only passes on have a page of their own.
autodoc_default_options = {"exclude-members": "replace", "ignore-module-all": True}
autodoc_typehints_format = "short"
# What only some extras need, and what is too large for building the site.
autodoc_mock_imports = [
    name
    for name in (
        "gymnasium",
        "gymnax",
        "jaxmarl",
        "onnx",
        "onnxruntime",
        "pettingzoo",
        "rejax",
        "spox",
        "stable_baselines3",
        "tensorboardX",
        "torch",
    )
    if importlib.util.find_spec(name) is None
]
python_use_unqualified_type_names = True
maximum_signature_line_length = 88

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"jaxsense {release}"
html_logo = "_static/logo.svg"
html_favicon = "_static/logo.svg"
html_theme_options = {"navigation_with_keys": True}
html_static_path = ["_static"]
html_css_files = ["site.css"]


packages = ["jaxsense"] + [
    module.name for module in pkgutil.walk_packages(jaxsense.__path__, "jaxsense.") if module.ispkg
]
# Of each package, the names that it passes on, and where they are defined and described.
autosummary_context = {
    "public_names": {
        package: sorted(
            (f"{package}.{each.name}", each.home)
            for each in generate.exports(package)
            if not each.name.startswith("_")
        )
        for package in packages
    }
}


def keep_colons(app, what: str, name: str, value, options, lines: list[str]) -> None:
    """Keeps napoleon from reading the first words of an attribute's docstring as its type."""
    if what in ("attribute", "data"):
        lines[:0] = ["..", ""]  # an empty comment, which holds no colon


def inline_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Writes MathML, which browsers show without a script, offline as well."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block_math(translator: HTML5Translator, node: nodes.math_block) -> None:
    """The same for a formula on lines of its own."""
    formula = convert(node.astext(), display="block")
    translator.body.append(f'<div class="math">{formula}</div>')
    raise nodes.SkipNode


# A module or a package of jaxsense, as pages link to it for readers on GitHub.
SOURCE = re.compile(r"\]\(\.\./(jaxsense(?:/(?!_)\w+)*)(?:\.py)?\)")
# The same under the name of one of its classes or functions.
NAMED = re.compile(r"(\[`(?:\w+\.)*(\w+)`\])\(\.\./(jaxsense(?:/\w+)+)\.py\)")


# What pages link to for readers on code hosts, and the page of the site in its place.
MADE = {
    "](../jaxsense/config)": "](site/settings.md)",
    "](../jaxsense/summary/blocks.py)": "](site/summary.md)",
    "](../jaxsense/__init__.pyi)": "](site/api.md)",
    **{f"](../{file}": f"](site/{page}" for page, file in generate.OUTSIDE.items()},
}


def link_to_reference(app: Sphinx, name: str, source: list[str]) -> None:
    """Links to the reference where a page links to a source file."""

    def to_definition(found: re.Match[str]) -> str:
        text, name, module = found[1], found[2], found[3].replace("/", ".")
        is_defined = name in (each.defined for each in generate.definitions(module))
        return f"{text}(#{module}.{name})" if is_defined else found[0]

    for link, page in MADE.items():
        source[0] = source[0].replace(link, page)
    source[0] = NAMED.sub(to_definition, source[0])
    source[0] = SOURCE.sub(lambda found: f"](#{found[1].replace('/', '.')})", source[0])


def setup(app: Sphinx) -> None:
    """Registers what this file adds to Sphinx."""
    app.connect("source-read", link_to_reference)
    app.connect("autodoc-process-docstring", keep_colons, priority=400)
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))

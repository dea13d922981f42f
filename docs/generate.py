"""Pages that the code makes, for the site alone: settings, public names, keys of `summary.json`.

`conf.py` writes them to `docs/site` when Sphinx starts; Git ignores that folder.
"""

import ast
import dataclasses
import functools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import jaxsense
from jaxsense.config import PRESETS, Config, Shape, as_plain
from jaxsense.config.options import about, docs, flat
from jaxsense.config.section import Section, described, fields_of
from jaxsense.summary.blocks import BLOCKS

DOCS = Path(__file__).parent
SOURCE = Path(jaxsense.__file__).parent


def settings() -> str:
    """All settings, a table for each section, and what the presets change."""
    parts = []
    for name, section in _sections("", Config()):
        title, text = f"`{name}`" if name else "Top level", _sentence_case(about(section))
        parts.append(f"## {title}\n\n{text}\n\n{_table_of_section(name, section)}")
    parts.append("## Presets\n\nWhat each preset changes of `default`:\n")
    default = flat(as_plain(PRESETS["default"]))
    for preset, config in PRESETS.items():
        changed = {n: x for n, x in flat(as_plain(config)).items() if x != default.get(n)}
        if rows := [(f"`{name}`", _value(value)) for name, value in changed.items()]:
            table = _table(("setting", "value"), rows)
            parts.append(f"### Preset `{preset}`\n\n{table}")
    return "\n".join(parts)


def _sections(name: str, section: Section) -> Iterator[tuple[str, Section]]:
    """A section and those in it, each with its name."""
    yield name, section
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if isinstance(value, Section):
            yield from _sections(f"{name}.{field.name}".lstrip("."), value)


def _table_of_section(name: str, section: Section) -> str:
    rows = []
    for field, kind, limits, _ in fields_of(type(section)):
        value = getattr(section, field)
        if not isinstance(value, Section):
            mark = " †" if field in section.LEAVES else ""
            full = f"{name}.{field}".lstrip(".")
            meaning = docs(type(section))[field]
            rows.append((f"`{full}`{mark}", _value(value), described(kind, limits), meaning))
    return _table(("setting", "default", "allowed", "meaning"), rows)


def _value(value: object) -> str:
    """A value as people read it."""
    match value:
        case bool():
            text = "on" if value else "off"
        case Shape():
            text = f"{value.primitive} {_value(value.half_sides)}"
        case Mapping():
            text = "; ".join(f"{name}: {_value(each)}" for name, each in value.items())
        case tuple():
            text = ", ".join(map(_value, value))
        case int() if value >= 10_000:
            text = f"{value:,}"
        case float():
            text = f"{value:g}"
        case str():
            text = f"`{value}`"
        case _:
            text = "" if value is None else str(value)
    return text or "none"


def _sentence_case(text: str) -> str:
    return text[:1].upper() + text[1:]


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    # A bar would end the cell.
    safe = [[cell.replace("|", r"\|") for cell in row] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in [head, ("---",) * len(head), *safe])


PACKAGES = (
    "",
    "config",
    "sim",
    "vae",
    "dqn",
    "mission",
    "training",
    "tasks",
    "recorded",
    "interfaces",
)
"""Packages whose names are public; the first is `jaxsense` itself."""
_EXTRAS = "gymnasium", "gymnax", "rejax", "stable_baselines3", "jaxmarl", "pettingzoo"
_DEFINITION = ast.FunctionDef | ast.ClassDef


@dataclasses.dataclass(frozen=True)
class Public:
    """A name that a package exports.

    Attributes:
      name: in the package.
      module: that defines it, such as "jaxsense.vae.jmvae".
      defined: its name there; None if it is the module itself.
      about: first sentence of its docstring.
    """

    name: str
    module: str
    defined: str | None
    about: str

    @property
    def home(self) -> str:
        """Its whole name where it is defined."""
        return self.module if self.defined is None else f"{self.module}.{self.defined}"


def api() -> str:
    """All public names, a table for each package."""
    parts = []
    for package in PACKAGES:
        name = f"jaxsense.{package}".rstrip(".")
        about = _paragraph(ast.get_docstring(_parsed(name)))
        names = exports(name)
        for module in [each for each in names if each.defined is None and package]:
            names += definitions(module.module, module.name)
        for module in _EXTRAS if package == "interfaces" else ():
            names += definitions(f"{name}.{module}", module)
        rows = [(f"[`{each.name}`](../{_file(each.module)})", each.about) for each in names]
        parts.append(f"## `{name}`\n\n{about}\n\n{_table(('name', 'what it is'), rows)}")
    return "\n".join(parts)


def exports(package: str) -> list[Public]:
    """What a package exports, in the order in which it imports it.

    Args:
      package: its whole name.
    """
    found = []
    for node in ast.walk(_parsed(package, stub=True)):
        if isinstance(node, ast.ImportFrom):
            base = ".".join([package] * node.level + [node.module or ""]).strip(".")
            for alias in node.names:
                if alias.asname and (alias.asname[0] != "_" or alias.asname == "__version__"):
                    found.append(_public(alias.asname, base, alias.name))
    return found


def _public(name: str, module: str, defined: str) -> Public:
    """What a module passes on or defines under a name."""
    for node, following in _pairs(_parsed(module).body):
        if isinstance(node, ast.ImportFrom) and node.module and node.module != module:
            for alias in node.names:
                if (alias.asname or alias.name) == defined:
                    return _public(name, node.module, alias.name)
        if isinstance(node, _DEFINITION) and node.name == defined:
            return Public(name, module, defined, _paragraph(ast.get_docstring(node)))
        if defined in _assigned(node):
            match following:
                case ast.Expr(ast.Constant(str(text))):
                    return Public(name, module, defined, _paragraph(text))
    # A module of the package, unless the package passes on something of the same name.
    inner = f"{module}.{defined}"
    return Public(name, inner, None, _paragraph(ast.get_docstring(_parsed(inner))))


def definitions(module: str, prefix: str = "") -> list[Public]:
    """Public functions and classes of a module.

    Args:
      module: its whole name.
      prefix: what precedes their names, with a dot.
    """
    names = [
        node.name
        for node in _parsed(module).body
        if isinstance(node, _DEFINITION) and not node.name.startswith("_")
    ]
    return [_public(f"{prefix}.{name}".lstrip("."), module, name) for name in names]


def _pairs(body: list[ast.stmt]) -> Iterator[tuple[ast.stmt, ast.stmt | None]]:
    """Each statement and the next one."""
    return zip(body, [*body[1:], None], strict=True)


def _assigned(node: ast.stmt) -> list[str]:
    """Names that a statement assigns."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]


@functools.cache
def _parsed(module: str, *, stub: bool = False) -> ast.Module:
    """The source of a module; with `stub` its stub, if it has one."""
    path = _path(module)
    path = path / "__init__.py" if path.is_dir() else path
    types_ = path.with_suffix(".pyi")
    return ast.parse((types_ if stub and types_.exists() else path).read_text(encoding="utf-8"))


def _path(module: str) -> Path:
    """The file of a module, or the directory of a package."""
    directory = SOURCE.parent.joinpath(*module.split("."))
    return directory if directory.is_dir() else directory.with_suffix(".py")


def _file(module: str) -> str:
    """The path of a module in the repository."""
    return _path(module).relative_to(SOURCE.parent).as_posix()


def _paragraph(text: str | None) -> str:
    """The first sentence of a docstring."""
    first = " ".join((text or "").split("\n\n")[0].split())
    found = re.match(r".*?[.](?=\s|$)", first)
    return found[0] if found else first


def keys() -> str:
    """All keys of `summary.json`."""
    rows = [
        (f"`{place}{metric.key}`", metric.label, metric.meaning)
        for place, block in BLOCKS.items()
        for metric in block.values()
    ]
    return _table(("key", "name", "meaning"), rows)


SETTINGS = """# Settings

Each setting is an option of `python -m jaxsense.train`, with `-` in place of `_`:

    python -m jaxsense.train --arena.num-pois 4 --mdp.partly-seen-starts

The name alone turns a setting on; `no-` before its last part turns it off. In Python, settings
are frozen dataclasses: `dataclasses.replace(config, arena=dataclasses.replace(config.arena,
num_pois=4))`. Defaults are those of preset `default`; [the end of this page](#presets) lists
what the other presets change. Settings marked † only enter the arithmetic: changing them
recompiles nothing, and JAX may trace them.
"""
API = """# API

Every public name, with the first sentence of its docstring. [The reference](../reference.rst)
has the rest.

## What is stable

Versions follow [Semantic Versioning](https://semver.org). These change only with a new minor
version as long as the major version is 0, and after that only with a new major version:

- the names on this page, the arguments of the functions and the fields of the classes behind
  them;
- `jaxsense.train.main`, `jaxsense.evaluate.main`, and `main` and `load` of `jaxsense.export`;
- `read` and `RecordedLooks` of `jaxsense.recorded`;
- `reset` and `run_episode` of `jaxsense.dqn.episodes`, and `best` and `Trained` of
  `jaxsense.dqn.policies`;
- [settings](settings.md), [commands](../getting-started.md#first-steps) and their options;
- the keys of [`summary.json`](summary.md);
- the names and the content of [tasks](../tasks.md): a task that changes gets a new version in
  its name;
- what [an exported archive](../interfaces.md#export) holds.

Everything else may change in any version. `jaxsense.load` refuses a run that it cannot read.
"""
SUMMARY = """# Keys of summary.json

The keys are a public contract. A run's `report.html` explains those that the run has. [Getting
started](../getting-started.md#summaryjson) says how to read them.
"""
OUTSIDE = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "benchmarks.md": "benchmarks/RESULTS.md",
}
"""Pages of the site that are files outside of `docs`."""


def _outside(file: str) -> str:
    """A file outside of `docs`, with links that work on the site."""
    text = (DOCS.parent / file).read_text(encoding="utf-8")
    text = re.sub(r"\]\((?:\.\./)?docs/", "](../", text)
    text = re.sub(r"\]\((?:\.\./)?jaxsense/", "](../jaxsense/", text)
    for page, other in OUTSIDE.items():
        text = text.replace(f"]({other}", f"]({page}")
    return text


PAGES = {
    "settings.md": lambda: f"{SETTINGS}\n{settings()}",
    "api.md": lambda: f"{API}\n{api()}",
    "summary.md": lambda: f"{SUMMARY}\n{keys()}",
    **{page: functools.partial(_outside, file) for page, file in OUTSIDE.items()},
}
"""Each page of `docs/site`, and what makes it."""


def write() -> None:
    """Writes the pages that have changed, so that Sphinx reads only those again."""
    folder = DOCS / "site"
    folder.mkdir(exist_ok=True)
    for name, text in ((name, make()) for name, make in PAGES.items()):
        if not (folder / name).exists() or (folder / name).read_text(encoding="utf-8") != text:
            (folder / name).write_text(text, encoding="utf-8")

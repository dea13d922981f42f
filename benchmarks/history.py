"""Whether the code that rows measured has changed since the commits that they name."""

import ast
import json
import subprocess
import symtable
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "jaxsense"
_BENCHMARKS = "benchmarks"
_COMPILED = ("run/devices.py:compiler_options",)
_CHECKS = f"{PACKAGE}/core/checks.py"
_SPREAD = ("run/devices.py:spread", "run/kept.py:trace")
_BODIES = ("sim/amiro.py", "sim/arena.py")
_MOTION = (*_BODIES, "mission/groups.py", "mission/motion.py", "mission/navigation.py")
_RAYS = (*_BODIES, "sim/raycast.py", "sim/sensors.py")
_CHOICES = ("dqn/policies.py", "dqn/reference.py", "dqn/rewards.py", "dqn/rules.py")
_BELIEFS = (
    *(f"vae/{name}.py" for name in ("bayes", "calibration", "detectors", "filter", "fusion")),
    *(f"vae/{name}.py" for name in ("gate", "gaussian", "latent", "novelty", "readout")),
    *(f"vae/jmvae.py:{name}" for name in ("posterior", "decode")),
)
_STEPS = (*_CHOICES, "core", "looks.py", "mission", "models.py", "sim", *_BELIEFS)
_PLAYER = ("run/batches.py", "run/films.py", "run/ledger.py", "run/missions.py")
_MISSIONS = (
    *_STEPS,
    *_PLAYER,
    *(f"run/devices.py:{name}" for name in ("side_by_side", "put_everywhere", "fetched")),
    "run/compilation.py:Program",
)
_MAP = ("dqn/map_mdp.py", "vae/filter.py", "vae/fusion.py")
_LEARNING = (*_MAP, "dqn/losses.py", "dqn/map_agent.py", "dqn/replay.py", "dqn/training.py")


def _measured_by(*rows: str, code: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Rows with their code and the functions of their names, which measure them."""
    return {row: (*code, f"{_BENCHMARKS}/missions.py:{row}") for row in rows}


WHOLE = "whole commands"
"""Stands for a row that measures the whole package."""
CODE: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("physics", "physics_batch", "physics_warp"), _BODIES),
    "physics_devices": (*_BODIES, *_SPREAD),
    **dict.fromkeys(("physics_solver", "physics_solver_batch", "physics_solver_warp"), _BODIES),
    **dict.fromkeys(("physics_contacts", "physics_contacts_warp"), _MOTION),
    **dict.fromkeys(("rays", "rays_warp", "rays_warp_bvh"), _RAYS),
    **_measured_by("resets_many", "missions_under_way", "missions_many_under_way", code=_STEPS),
    **_measured_by(
        "missions_under_way_devices", "missions_many_under_way_devices", code=(*_STEPS, *_SPREAD)
    ),
    **_measured_by("missions", "missions_many", code=_MISSIONS),
    **_measured_by("missions_devices", "missions_many_devices", code=(*_MISSIONS, *_SPREAD)),
    "jmvae": ("core/networks.py", "core/supervised.py", "vae/gaussian.py", "vae/jmvae.py:train"),
    **dict.fromkeys(("dqn_rejax", "dqn_sb3", "dqn_seeds"), _LEARNING),
    **dict.fromkeys(("time_to_optimal_rejax", "time_to_optimal_sb3"), _LEARNING),
    "dqn_live": (*_LEARNING, "looks.py", "sim", "vae/detectors.py"),
    "team_mdp": (*_MAP, "dqn/team_mdp.py"),
    WHOLE: (".",),
}
"""Files and folders of the package that each row measures, besides what compiles all of them; of a
file, everything or the function or class behind the colon. Of missions also what measures them."""


def is_whole() -> bool:
    """Whether this is a checkout that holds all earlier commits."""
    return (ROOT / ".git").exists() and _git("rev-parse", "--is-shallow-repository") == "false\n"


def commits() -> list[str]:
    """Hashes of the present commit and of all before it."""
    return (_git("rev-list", "HEAD") or "").split()


def has_changed(row: str, commit: str) -> bool:
    """Whether the code that a row measures has changed, in more than what `program` leaves out.

    Args:
      row: its name.
      commit: that it was measured by.

    Raises:
      ValueError: if the commit is not in the history.
    """
    for place in (*_COMPILED, *CODE[row]):
        whole = place if place.startswith(f"{_BENCHMARKS}/") else f"{PACKAGE}/{place}"
        path, _, function = whole.partition(":")
        paths = _git("diff", "--name-only", commit, "--", path)
        if paths is None:
            raise ValueError(f"commit = {commit!r} of row {row}: must be one of the history")
        modules = [x for x in paths.split() if x.endswith(".py") and x != _CHECKS]
        if any(_has_changed(commit, path, function) for path in modules):
            return True
    return False


def _has_changed(commit: str, path: str, function: str) -> bool:
    """Whether a module has; a new one counts where others use it, which then have changed."""
    before, file = _git("show", f"{commit}:{path}"), ROOT / path
    if before is None or not file.exists():
        return before is not None
    return program(before, function) != program(file.read_text(encoding="utf-8"), function)


def note(path: Path, measures: str | None = None) -> None:
    """Notes in a file whether the code it measures has changed, if the history is here to tell.

    Args:
      path: of rows, as `python -m benchmarks` writes them, or of something else with a commit.
      measures: row whose code something else measures.
    """
    if not is_whole():
        return
    content = json.loads(path.read_text(encoding="utf-8"))
    if measures is None:
        noted = [{**row, "changed": has_changed(row["row"], row["commit"])} for row in content]
    else:
        noted = {**content, "changed": has_changed(measures, content["commit"])}
    path.write_text(json.dumps(noted, indent=2) + "\n", encoding="utf-8")


def program(source: str, function: str = "") -> str:
    """What a module computes, without comments, docstrings, imports, types and checks.

    Checks of arguments run while JAX traces a function; its program has none of them.

    Args:
      source: its text.
      function: the only one that counts, with what it uses of the module; all by default.
    """
    tree: ast.Module = _WithoutChecks().visit(ast.parse(source))
    if function:
        tree.body = _used_by(function, tree.body)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = None  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            # What is imported for types alone cannot be told from the rest.
            node.body = [each for each in node.body if not _is_text(each)]
    return ast.dump(tree)


_CHECKING = ("_check", "_require", "require_")


class _WithoutChecks(ast.NodeTransformer):
    """Leaves out statements that only check or raise an error, and functions of nothing else.

    A check is a call of a function of `core.checks` or chex, or of one that is named as such.
    """

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        if getattr(node, "body", None) == []:
            node.body = [ast.Pass()]  # pyright: ignore[reportAttributeAccessIssue]
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        match node.value:
            case ast.Call(func=ast.Attribute(value=ast.Name(id="checks" | "chex"))):
                return None
            case ast.Call(func=ast.Name(id=name)) if name.startswith(_CHECKING):
                return None
        return node

    def visit_For(self, node: ast.For) -> ast.For | None:
        self.generic_visit(node)
        return node if node.orelse or not _is_empty(node.body) else None

    def visit_If(self, node: ast.If) -> ast.If | None:
        self.generic_visit(node)
        names = any(isinstance(each, ast.NamedExpr) for each in ast.walk(node.test))
        # Before it raises, it may say why.
        *words, last = node.body
        refuses = _is_empty([last]) or _is_error(last)
        checks_only = refuses and all(isinstance(each, ast.Assign) for each in words)
        return None if checks_only and not node.orelse and not names else node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef | None:
        returns = any(isinstance(x, ast.Return) and x.value for x in ast.walk(node))
        if node.name.startswith(_CHECKING) and not returns:
            return None
        self.generic_visit(node)
        return None if node.name == "__post_init__" and _is_empty(node.body) else node


def _is_empty(body: list[ast.stmt]) -> bool:
    return all(isinstance(each, ast.Pass) for each in body)


def _is_error(node: ast.stmt) -> bool:
    """Whether a statement raises an error, not what ends a loop."""
    match node:
        case ast.Raise(exc=ast.Call(func=ast.Name(id=name))):
            return name.endswith("Error")
    return False


def _used_by(function: str, statements: list[ast.stmt]) -> list[ast.stmt]:
    """The statements that define a function and what it uses."""
    names, used = {function}, list[ast.stmt]()
    while found := [x for x in statements if x not in used and names & _defined(x)]:
        used += found
        names |= {name for each in found for name in _used(each)}
    return [x for x in statements if x in used]


def _used(node: ast.stmt) -> set[str]:
    """Names of the module that a statement uses, not those of its functions' own variables."""
    return _globals(symtable.symtable(ast.unparse(node), "module", "exec"))


def _globals(scope: symtable.SymbolTable) -> set[str]:
    is_module = scope.get_type() == "module"
    symbols = [x for x in scope.get_symbols() if x.is_referenced()]
    own = {x.get_name() for x in symbols if is_module or x.is_global()}
    return own.union(*map(_globals, scope.get_children()))


def _defined(node: ast.stmt) -> set[str]:
    """Names that a statement of a module defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = [node.target] if isinstance(node, ast.AnnAssign) else []
    targets += node.targets if isinstance(node, ast.Assign) else []
    named = (each for target in targets for each in ast.walk(target))
    return {each.id for each in named if isinstance(each, ast.Name)}


def _is_text(node: ast.stmt) -> bool:
    """Whether a statement is a string or an import."""
    is_string = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_string or isinstance(node, ast.Import | ast.ImportFrom)


def _git(*words: str) -> str | None:
    """What git prints; None if it fails."""
    git = ["git", "-C", str(ROOT), *words]
    found = subprocess.run(git, capture_output=True, encoding="utf-8", check=False)
    return None if found.returncode else found.stdout

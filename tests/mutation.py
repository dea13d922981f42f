"""Mutation testing: breaks one line of the package at a time and prints what the tests let pass.

    python tests/mutation.py                                    # 60 mutants of the whole package
    python tests/mutation.py jaxsense/vae jaxsense/models.py --number 20

The same seed draws the same lines while the package stays as it is. Mutants that no test could miss
or notice are left out: annotations, decorators, texts, assertions of shapes, the `strict` of a zip,
floating-point constants, and the numbers among settings and constants. Each mutant meets the tests
of its module, then those of its package, then all that import the package, until one fails.
"""

import argparse
import ast
import contextlib
import copy
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PROGRAMS = ("show", "train.py", "evaluate.py")  # drawn from if named
LAST = "tests/test_same_numbers.py"  # trains once, and compares all figures
TEST_SECONDS = 200
RUNNING: set[int] = set()  # process groups
ORDERS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
PAIRS = (
    *((ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn), (ast.And, ast.Or)),
    *((ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr)),
)
SWAPS = (
    *((a, b) for a in ORDERS for b in ORDERS if a is not b),
    *PAIRS,
    *((b, a) for a, b in PAIRS),
    *((ast.FloorDiv, ast.Mult), (ast.Mod, ast.FloorDiv), (ast.Pow, ast.Mult)),
)
NAMES = (
    *(("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("any", "all")),
    *(("zeros", "ones"), ("sin", "cos"), ("floor", "ceil")),
)
RENAMED = {**dict(NAMES), **{b: a for a, b in NAMES}}
Change = tuple[ast.expr | ast.stmt, ast.expr | str]


class Mutant(NamedTuple):
    """Another text for the bytes from `start` to `end` of a module."""

    module: Path
    line: int
    start: int
    end: int
    text: str

    def describe(self, root: Path) -> str:
        """The place, and what is there before and after.

        Args:
          root: The checkout.
        """
        before = (root / self.module).read_bytes()[self.start : self.end].decode()
        return f"{self.module}:{self.line}: " + " ".join(f"{before}  ->  {self.text}".split())


def changes(node: ast.AST, is_setting: bool) -> Iterator[Change]:
    """Expressions and statements, each with what may stand in its place.

    Args:
      node: An expression or a statement, with `test` or without.
      is_setting: Whether it is outside of functions.
    """

    def but(**fields: object) -> Change:
        changed = copy.copy(node)
        vars(changed).update(fields)
        return node, changed

    match node:
        case ast.Compare(ops=[op]):
            yield from (but(ops=[b()]) for a, b in SWAPS if type(op) is a)
        case ast.BinOp(op=op) | ast.BoolOp(op=op) | ast.AugAssign(op=op):
            if not (is_setting and isinstance(op, ast.BitOr)):  # an alias of types
                yield from (but(op=b()) for a, b in SWAPS if type(op) is a)
        case ast.UnaryOp(operand=operand) if not isinstance(operand, ast.Constant):
            yield node, operand
        case ast.Constant(value=bool(value)):
            yield but(value=not value)
        case ast.Constant(value=int(value)) if not is_setting:
            yield from (but(value=value + shift) for shift in (-1, 1))
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield test, ast.UnaryOp(ast.Not(), test)
        case ast.Expr(value=ast.Call()) | ast.Raise(exc=ast.expr()):
            yield node, "pass"
        case ast.Call(func=ast.Attribute(attr="replace"), keywords=given) if all(
            keyword.arg for keyword in given
        ):
            yield from (but(keywords=given[:i] + given[i + 1 :]) for i in range(len(given)))
        case ast.Attribute(attr=name) if name in RENAMED:
            yield but(attr=RENAMED[name])
        case ast.Name(id=name) if name in RENAMED:
            yield but(id=RENAMED[name])


def _places(node: ast.AST, is_setting: bool = True) -> Iterator[tuple[ast.AST, bool]]:
    """The nodes of a tree to change, and whether they are outside of functions."""
    yield node, is_setting
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not _is_left_out(child):
                inside = isinstance(node, ast.FunctionDef)
                yield from _places(child, is_setting and not inside)


def _is_left_out(node: ast.AST) -> bool:
    match node:
        case ast.JoinedStr() | ast.Assert() | ast.keyword(arg="strict"):
            return True
        case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id="chex")))):
            return True
    return False


def mutants(module: Path, source: str) -> Iterator[Mutant]:
    """All mutants of a module.

    Args:
      module: Its path in the checkout.
      source: Its text.
    """
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, is_setting in _places(ast.parse(source)):
        for old, new in changes(node, is_setting):
            assert old.end_lineno is not None
            assert old.end_col_offset is not None
            yield Mutant(
                module,
                old.lineno,
                starts[old.lineno - 1] + old.col_offset,
                starts[old.end_lineno - 1] + old.end_col_offset,
                new if isinstance(new, str) else _text(new),
            )


def _text(new: ast.AST) -> str:
    text = ast.unparse(new)
    return f"({text})" if isinstance(new, ast.expr) else text


def draw(root: Path, modules: list[Path], number: int, seed: int) -> list[Mutant]:
    """Mutants of lines drawn at random, one of each.

    Args:
      root: The checkout.
      modules: Modules, as paths in it.
      number: How many lines; fewer if there are not so many.
      seed: Of the draw.
    """
    lines = defaultdict(list)
    for module in modules:
        for mutant in mutants(module, (root / module).read_text()):
            lines[module, mutant.line].append(mutant)
    chance = random.Random(seed)
    drawn = chance.sample(sorted(lines), min(number, len(lines)))
    return [chance.choice(lines[line]) for line in drawn]


def tests_of(root: Path, module: Path) -> list[str]:
    """Test files for a module, the nearest first.

    Args:
      root: The checkout.
      module: Its path in it.
    """
    package = Path(module.parts[1]).stem
    imports = re.compile(rf"jaxsense\.{package}\b|from jaxsense import\b.*\b{package}\b")

    def distance(test: Path) -> int:
        near = test.parent in (root / "tests", root / "tests" / package)
        if near and f"_{module.stem}_" in f"{test.stem}_":
            return 0
        if test.parent.name == package or f"{test.stem}_".startswith(f"test_{package}_"):
            return 1
        if test == root / LAST:
            return 2
        return 3 if imports.search(test.read_text()) else 4

    found = sorted((distance(test), test) for test in (root / "tests").rglob("test_*.py"))
    return [str(test.relative_to(root)) for away, test in found if away < 4]


def run_tests(
    root: Path, tests: list[str], *options: str, limit: float | None = None
) -> int | None:
    """Status of pytest, or None if it takes too long.

    Args:
      root: A checkout.
      tests: Test files in it.
      *options: Options of pytest.
      limit: Seconds.
    """
    command = [sys.executable, "-m", "pytest", "-o", "addopts=", "-m", "not slow", "-q", "-x"]
    command += ["-p", "no:cacheprovider", "--timeout", str(TEST_SECONDS)]
    command += ["--basetemp", str(root.parent / f"{root.name}.tmp"), *options, *tests]
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(root), environment.get("PYTHONPATH", "")])
    environment["JAX_COMPILATION_CACHE_DIR"] = str(root.parent / "cache")
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    with (root.parent / f"{root.name}.log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=root, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        RUNNING.add(process.pid)
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            _kill(process.pid)


def _kill(pid: int) -> None:
    """Ends pytest and the programs that it has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    RUNNING.discard(pid)


def is_killed(root: Path, mutant: Mutant, limit: float) -> bool:
    """Whether a test fails on a mutant in time.

    Args:
      root: A checkout, which is as before afterwards.
      mutant: What to change in it.
      limit: Seconds.

    Raises:
      RuntimeError: If pytest finds no tests.
    """
    path = root / mutant.module
    whole = path.read_bytes()
    path.write_bytes(whole[: mutant.start] + mutant.text.encode() + whole[mutant.end :])
    try:
        status = run_tests(root, tests_of(root, mutant.module), limit=limit)
    finally:
        path.write_bytes(whole)
    said = (root.parent / f"{root.name}.log").read_text() if status in (4, 5) else ""
    # A conftest that cannot import the mutant fails like every test would.
    if said and "while loading conftest" not in said:
        raise RuntimeError(said)
    return status not in (0, None)


def modules_of(root: Path, names: list[str]) -> list[Path]:
    """Modules of the named files and folders, or of the package.

    Args:
      root: The checkout.
      names: Paths in it.
    """
    left_out = () if names else PROGRAMS
    paths = [root / name for name in names or ["jaxsense"]]
    files = {file for path in paths for file in (path.rglob("*.py") if path.is_dir() else [path])}
    modules = sorted(file.relative_to(root) for file in files if file.name != "__init__.py")
    return [module for module in modules if module.parts[1] not in left_out]


def main() -> None:
    """Tries mutants side by side, and prints the survivors and the share that was killed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="PATH", help="modules and folders of jaxsense/")
    parser.add_argument("--number", type=int, default=60, help="mutants (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (default: 0)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="at the same time")
    parser.add_argument("--limit", type=float, default=300, help="seconds for each (default: 300)")
    parser.add_argument("--trust", action="store_true", help="do not run the tests unbroken first")
    parser.add_argument("--list", action="store_true", help="only print the mutants")
    given = parser.parse_args()
    drawn = draw(ROOT, modules_of(ROOT, given.names), given.number, given.seed)
    if given.list:
        print(*(mutant.describe(ROOT) for mutant in drawn), sep="\n")
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    tried, killed = Counter(), Counter()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        copies: queue.Queue[Path] = queue.Queue()
        ignored = shutil.ignore_patterns(".*", "runs", "_build", "generated", "__pycache__")
        for i in range(given.jobs):
            copies.put(Path(shutil.copytree(ROOT, Path(folder) / str(i), ignore=ignored)))

        def attempt(mutant: Mutant) -> bool:
            root = copies.get()
            try:
                return is_killed(root, mutant, given.limit)
            finally:
                copies.put(root)

        try:
            # The tests must pass unbroken; they leave compiled programs behind for the others.
            tests = sorted({test for mutant in drawn for test in tests_of(ROOT, mutant.module)})
            options = "-n", str(given.jobs), "--dist", "loadfile"
            if not given.trust and run_tests(Path(folder) / "0", tests, *options) != 0:
                sys.exit((Path(folder) / "0.log").read_text())
            for mutant, is_dead in zip(drawn, pool.map(attempt, drawn), strict=True):
                package = str(Path(*mutant.module.parts[:2]))
                tried[package] += 1
                killed[package] += is_dead
                if not is_dead:
                    print("survived", mutant.describe(ROOT), flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for pid in list(RUNNING):
                _kill(pid)
            raise
    for package in sorted(tried):
        print(f"{package}: {killed[package]} of {tried[package]} killed")
    print(f"{killed.total()} of {tried.total()} killed, {killed.total() / tried.total():.1%}")


if __name__ == "__main__":
    main()

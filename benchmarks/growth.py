"""`python -m benchmarks.growth`: fails if a run needs much more than in the last baseline.

Trains the preset `smoke` with this tree and with that of `.ci/baseline.json`, in turn, on this
machine and each with an empty cache. Whoever lets a figure grow on purpose renews the baseline and
says why.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks import history, pipeline

_BASELINE = pipeline.ROOT / ".ci" / "baseline.json"
_MOST = 1.1  # times the baseline
_OPERATION = r"(?m)^\s*(%[\w:#, %]+ = |return)"
# What `jaxsense.run.kept.Kept` has written names classes of its own tree.
_COUNT = """
import json, pickle, re, sys
from pathlib import Path
from jax import export
from jaxsense.run import files

traced, found, operation = sys.argv[1:]
numbers = {}
for path in Path(traced).glob("*.stablehlo"):
    _, flat = pickle.loads(files.without_digest(path.read_bytes()))
    module = export.deserialize(bytearray(flat)).mlir_module()
    numbers[path.name.rpartition("-")[0]] = len(re.findall(operation, module))
Path(found).write_text(json.dumps(numbers), encoding="utf-8")
"""


@dataclasses.dataclass(frozen=True)
class Needs:
    """What a run needs.

    Attributes:
      cpu_s: seconds of all cores.
      memory_mib: at the peak.
      operations: of each traced program, by its name.
    """

    cpu_s: float
    memory_mib: float
    operations: dict[str, int]

    @property
    def figures(self) -> dict[str, float]:
        """Each figure by its name."""
        return {
            "CPU seconds": self.cpu_s,
            "peak memory [MiB]": self.memory_mib,
            "programs": len(self.operations),
            "operations of all programs": sum(self.operations.values()),
            **{f"operations of {name}": number for name, number in self.operations.items()},
        }


def train(tree: Path, place: Path) -> Needs:
    """Trains once in a tree of the source."""
    words = ["jaxsense.train", "--preset", "smoke", "--quiet"]
    words += ["--cache", str(place / "cache"), "--out", str(place / "run")]
    needs = pipeline.run(tree, words, place)
    traced, found = place / "cache" / "traced", place / "operations.json"
    pipeline.python(tree, ("-c", _COUNT, str(traced), str(found), _OPERATION), place)
    operations = json.loads(found.read_text(encoding="utf-8"))
    if not operations:
        sys.exit(f"{traced}: must hold the programs of a training")
    return Needs(needs.cpu_s, 1024 * needs.memory_gib, operations)


def least(before: list[Needs], after: list[Needs]) -> tuple[Needs, Needs]:
    """Figures of the pairs in which each has grown least, as machines change their speed."""
    pairs = list(zip(before, after, strict=True))
    cpu_s = min(((old.cpu_s, new.cpu_s) for old, new in pairs), key=lambda x: x[1] / x[0])
    memory = min(
        ((old.memory_mib, new.memory_mib) for old, new in pairs), key=lambda x: x[1] / x[0]
    )
    operations = before[0].operations, after[0].operations
    old, new = map(Needs, cpu_s, memory, operations)
    return old, new


def compare(before: Needs, now: Needs) -> list[str]:
    """Prints both, and returns the names of the figures that are new or have grown."""
    found = []
    for name, new in sorted(now.figures.items()):
        old = before.figures.get(name, 0.0)
        print(f"{name:50} {old:10,.0f} {new:10,.0f}")
        if new > _MOST * old:
            found.append(name)
    return found


def grown(old: Path, now: Path, place: Path, pairs: int) -> list[str]:
    """Trains two trees in turn, and names the figures of the later one that have grown.

    Where one has, both are trained again, up to as often, as machines are noisy.

    Args:
      old: the earlier tree.
      now: the later one.
      place: an empty directory.
      pairs: trainings of each tree.
    """
    before, after, found = list[Needs](), list[Needs](), list[str]()
    for i in range(2 * pairs):
        # The first of a pair has the machine in another state than the second.
        for name, tree, needs in (("old", old, before), ("now", now, after))[:: (-1) ** i]:
            (place / f"{i}-{name}").mkdir()
            needs.append(train(tree, place / f"{i}-{name}"))
        if i + 1 >= pairs:
            print(f"{'':50} {'before':>10} {'now':>10}")
            found = compare(*least(before, after))
            if not found:
                break
    return found


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=2, help="runs of each tree")
    pairs = parser.parse_args().pairs
    baseline = json.loads(_BASELINE.read_text(encoding="utf-8"))
    commit = baseline["commit"]
    has_commit = ["git", "-C", str(pipeline.ROOT), "cat-file", "-e", f"{commit}^{{commit}}"]
    if subprocess.run(has_commit, capture_output=True, check=False).returncode:
        if history.is_whole():
            sys.exit(f"{_BASELINE}: commit = {commit!r}: must be in the history")
        print(f"this checkout does not hold {commit}, the baseline: nothing is compared")
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        old = place / "baseline"
        old.mkdir()
        pipeline.unpack(commit, old)
        found = grown(old, pipeline.ROOT, place, pairs)
    if found:
        sys.exit(
            f"{', '.join(found)}: more than {_MOST} times that of {commit[:10]}; renew "
            f"{_BASELINE.relative_to(pipeline.ROOT)} and say why, or find the cause"
        )


if __name__ == "__main__":
    main()

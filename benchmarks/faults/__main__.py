"""`python -m benchmarks.faults`: makes runs go wrong, and prints what became of them."""

import dataclasses
import itertools
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks import measure, studies
from benchmarks.faults.child import NAN_STEP, TRAININGS
from benchmarks.faults.runs import Process, Runs, lines, require, summary, wait_for
from benchmarks.faults.table import table
from jaxsense.config import PRESETS
from jaxsense.config.checks import check_fields, limited
from jaxsense.run import cli

PROGRAM = "benchmarks.faults"

STAGES = (
    "survey", "detector_camera-advance", "detections", "jmvae-advance", "latent_space",
    "dqn-advance", "policies", "mission-go_on", "write",
)  # fmt: skip
"""Where faults strike: the programs of `jaxsense.run.programs`, and the plots."""
PRESSED = {"ctrl-c": "Ctrl-C", "ctrl-c-twice": "Ctrl-C twice", "sigterm": "SIGTERM"}
STOPPED = "jmvae-advance", "dqn-advance", "mission-go_on"
"""Where a run is stopped whose checkpoints are then damaged."""
POISONED = {
    "survey": "scans",
    "detections": "features",
    "detector_camera-advance": "parameters of a detector",
    "jmvae-advance": "parameters of the JMVAE",
    "dqn-advance": "parameters of a Q-network, and so Q-values",
    "class_beliefs": "class beliefs",
}
SMOKE = ["--preset", "smoke", "--quiet"]
IN_ONE_SECOND = ["20250101-000000-smoke", "20250101-000000-smoke-2"]


def killed(runs: Runs, name: str, arguments: list[str], seed: int) -> None:
    """`kill -9` at a random moment of a run that has begun and not ended, then `--resume`."""
    path, share = runs.path(name), random.Random(seed).uniform(0.0, 1.0)
    seconds = runs.seconds(*arguments)
    while True:
        process = runs.start(*arguments, "--out", str(path))
        wait_for(path / "config.json", process)
        begin = time.monotonic()
        process.kill_after(share * seconds)
        is_killed = process.finish().returncode == -signal.SIGKILL
        if is_killed and not (path / "summary.json").exists():
            break
        shutil.rmtree(path)
        # It ended first: other runs no longer slow it down.
        seconds = 0.9 * (time.monotonic() - begin)
    runs.check_resumed(path, *arguments)


def stopped(runs: Runs, fault: str, stage: str, *more: str) -> None:
    """A signal in a stage: status 130, one line, and the run continues."""
    path, arguments = runs.path(f"{fault} {stage} {len(more)}"), [*SMOKE, *more]
    ended = runs.train(*arguments, "--out", str(path), child=(fault, stage))
    require(ended.returncode == 130, f"{fault} in {stage}: status {ended.returncode}")
    require(len(lines(ended.stderr)) == 1, f"{fault} in {stage}: {ended.stderr}")
    runs.check_resumed(path, *arguments)


def disk_full(runs: Runs, stage: str) -> None:
    """No room: one line, and the run continues when there is room."""
    path = runs.path(f"disk {stage}")
    ended = runs.train(*SMOKE, "--out", str(path), child=("disk", stage))
    require(ended.returncode == 2, f"disk full in {stage}: {ended.returncode} {ended.stderr}")
    (line,) = lines(ended.stderr)
    require("cannot write" in line, line)
    runs.check_resumed(path, *SMOKE)


def not_finite(runs: Runs, stage: str, number: int) -> None:
    """NaN in one array: caught, with its stage named, and the run continues from what was sound."""
    path = runs.path(f"nan {stage} {number}")
    ended = runs.train(*SMOKE, "--out", str(path), child=(f"nan{number}", stage))
    require(ended.returncode == 2, f"NaN in {stage}: status {ended.returncode}")
    (line,) = lines(ended.stderr)
    require("not finite" in line and stage.partition("-")[0] in line, line)
    runs.check_resumed(path, *SMOKE)


def gradient(runs: Runs, stage: str, number: int) -> None:
    """NaN in one array of gradients: caught within a chunk, with stage and step."""
    path = runs.path(f"gradient {stage} {number}")
    # Other programs than those that are kept.
    options = ["--out", str(path), "--cache", "None"]
    ended = runs.train(*SMOKE, *options, child=(f"gradient{number}", stage))
    require(ended.returncode == 2, f"NaN in {stage}: status {ended.returncode} {ended.stderr}")
    (line,) = lines(ended.stderr)
    found = re.search(rf"{stage}.* (\d+) of (\d+)", line)
    require(found and "nan" in line, line)
    # Of Q-learning epochs are told. In the chunk of that step, or the next one if it was its last.
    step = -(-NAN_STEP // PRESETS["smoke"].dqn.updates) if stage == "dqn" else NAN_STEP
    late = int(found[1]) - step if found else -1
    require(0 <= late <= int(found[2]) // 20 if found else False, line)
    saved = {file.name for file in (path / "checkpoints").rglob("*.msgpack")}
    require(any(name.startswith(stage) for name in saved), f"{stage} is not in {saved}")
    runs.check_resumed(path, *SMOKE)


def damaged(runs: Runs, how: str, name: str) -> None:
    """A checkpoint that is damaged: named, and the run continues to the same summary."""
    path = runs.path(f"{how} {name}")
    ended = runs.train(*SMOKE, "--out", str(path), child=("ctrl-c", name))
    require(ended.returncode == 130, f"status {ended.returncode}")
    for number, file in enumerate(sorted((path / "checkpoints").rglob("*.msgpack"))):
        one = runs.path(f"{how} {name} {number}")
        shutil.copytree(path, one)
        target = one / file.relative_to(path)
        content = bytearray(target.read_bytes())
        if how == "missing":
            target.unlink()
        elif how == "truncated":
            target.write_bytes(content[: len(content) // 2])
        else:
            content[random.Random(number).randrange(len(content))] ^= 1 << number % 8
            target.write_bytes(content)
        resumed = runs.train("--resume", str(one), "--quiet")
        require(resumed.returncode == 0, resumed.stderr)
        said = [line for line in lines(resumed.stderr) if target.name in line]
        require(len(said) == 1, f"{how} {target.name}: {resumed.stderr}")
        require(summary(one) == runs.whole(*SMOKE), f"{how} {target.name}: another summary")


def without_rights(command: list[str]) -> list[str]:
    """Root may write everywhere; this takes that right from a command."""
    if os.geteuid() != 0:
        return command
    caps = "-dac_override,-dac_read_search"
    return ["setpriv", f"--bounding-set={caps}", f"--inh-caps={caps}", *command]


def read_only(runs: Runs) -> None:
    """A directory that cannot be written."""
    place = runs.path("read only")
    place.mkdir()
    place.chmod(0o555)
    command = [sys.executable, "-m", "jaxsense.train", *SMOKE, "--out", str(place / "run")]
    ended = Process(without_rights(command)).finish()
    require(ended.returncode == 2, f"status {ended.returncode}")
    (line,) = lines(ended.stderr)
    require("cannot be written (Permission denied)" in line, line)


def surroundings(runs: Runs, name: str, changes: dict[str, str | None], ascii_only: bool) -> None:
    """Another environment: a plain run, with at most a line more."""
    env = {k: v for k, v in {**os.environ, **changes}.items() if v is not None}
    path = runs.path(name)
    command = [sys.executable, "-m", "jaxsense.train", "--preset", "smoke", "--out", str(path)]
    if "HOME" not in changes:
        command += ["--cache", str(runs.folder / "cache")]
    ended = Process(without_rights(command), env=env).finish()
    require(ended.returncode == 0, f"{name}: {ended.stderr}")
    # Matplotlib has a cache of its own, and says so.
    said = [line for line in lines(ended.stderr) if "matplotlib" not in line.lower()]
    require(len(said) <= 1, f"{name}: {ended.stderr}")
    require(not ascii_only or ended.stdout.isascii(), f"{name}: not ASCII")
    require(summary(path) == runs.whole(*SMOKE), f"{name}: another summary")


def two_in_one_second(runs: Runs) -> None:
    """Two runs that would have one name."""
    place = runs.path("same second")
    place.mkdir()
    processes = [runs.start(*SMOKE, cwd=place, child=("clock", "")) for _ in range(2)]
    ended = [process.finish() for process in processes]
    require([e.returncode for e in ended] == [0, 0], ended[0].stderr + ended[1].stderr)
    found = sorted((place / "runs").iterdir())
    require([path.name for path in found] == IN_ONE_SECOND, f"{found}")
    for path in found:
        require(summary(path) == runs.whole(*SMOKE), "another summary")


def disk_full_after(runs: Runs, program: str) -> None:
    """No room for what `evaluate` or `export` write: one line, and the run is as it was."""
    path = runs.path(f"disk {program}")
    require(runs.train(*SMOKE, "--out", str(path)).returncode == 0, "a plain run")
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    command = [sys.executable, "-m", "benchmarks.faults.child", "disk", program, str(path)]
    ended = Process(command).finish()
    require(ended.returncode == 2, f"{program}: {ended.returncode} {ended.stderr}")
    (line,) = lines(ended.stderr)
    require("File too large" in line, line)
    after = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    require(after == before, f"{program} has changed {set(after) ^ set(before)}")


def two_evaluations(runs: Runs) -> None:
    """Two evaluations of one run at once."""
    path = runs.path("evaluated")
    require(runs.train(*SMOKE, "--out", str(path)).returncode == 0, "a plain run")
    command = [sys.executable, "-m", "jaxsense.evaluate", str(path), "--episodes", "2"]
    command += ["--cache", str(runs.folder / "cache"), "--policy"]
    names = "camera_alone", "lidar_alone"
    ended = [p.finish() for p in [Process([*command, name]) for name in names]]
    require([e.returncode for e in ended] == [0, 0], ended[0].stderr + ended[1].stderr)
    (file,) = (path / "evaluations").glob("*.json")
    found = json.loads(file.read_text(encoding="utf-8"))
    require(set(names) <= set(found["mission"]), "a block is lost")


def shared_cache(runs: Runs) -> None:
    """Two writers of one cache, in a directory with files of the user."""
    cache = runs.path("their work")
    for folder in ("programs/mine", "traced/mine", "compiled/mine"):
        (cache / folder).mkdir(parents=True)
        (cache / folder / "thesis.txt").write_text("precious", encoding="utf-8")
    for folder in ("traced", "compiled"):
        (cache / folder).chmod(0o700)
    before = sorted(cache.rglob("*"))
    paths = [runs.path(f"sharing {i}") for i in range(2)]
    processes = [runs.start(*SMOKE, "--out", str(p), "--cache", str(cache)) for p in paths]
    for process, path in zip(processes, paths, strict=True):
        ended = process.finish()
        require(ended.returncode == 0, ended.stderr)
        require(summary(path) == runs.whole(*SMOKE), "another summary")
    require(set(before) <= set(cache.rglob("*")), "a file of the user is gone")


Trial = tuple[str, Callable[[], None]]


def trials(runs: Runs, is_quick: bool) -> Iterator[Trial]:
    """All trials, each with the row that it belongs to."""

    def trial(row: str, function: Callable[..., None], *args: Any) -> Trial:
        return row, lambda: function(runs, *args)

    stages = ("survey", "dqn-advance") if is_quick else STAGES
    for i in range(2 if is_quick else 30):
        yield trial("kill -9 at a random moment, `smoke`", killed, f"killed {i}", SMOKE, i)
    for i in range(0 if is_quick else 5):
        row = "kill -9 at a random moment, `default`"
        yield trial(row, killed, f"killed default {i}", ["--quiet"], i)
    for (fault, name), stage in itertools.product(PRESSED.items(), stages):
        yield trial(f"{name} in a stage, one seed", stopped, fault, stage)
        yield trial(f"{name} in a stage, two seeds", stopped, fault, stage, "--num-seeds", "2")
    for how, stage in itertools.product(("truncated", "flipped", "missing"), STOPPED):
        yield trial(f"each checkpoint {how}", damaged, how, stage)
    for stage in stages:
        yield trial("disk full in a stage", disk_full, stage)
    arrays = range(1 if is_quick else 3)
    for (stage, name), i in itertools.product(POISONED.items(), arrays):
        yield trial(f"NaN in {name}", not_finite, stage, i)
    for stage, i in itertools.product(TRAININGS, arrays):
        yield trial(f"NaN in gradients of {stage}", gradient, stage, i)
    for program in ("evaluate", "export"):
        yield trial(f"disk full in `{program}`", disk_full_after, program)
    yield trial("a read-only directory", read_only)
    yield trial(
        "HOME that cannot be created", surroundings, "home", {"HOME": "/dev/null/home"}, False
    )
    yield trial("a read-only HOME", surroundings, "ro-home", {"HOME": "/proc"}, False)
    yield trial("no HOME, no TERM", surroundings, "bare", {"HOME": None, "TERM": None}, False)
    ascii_locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    yield trial("an ASCII locale", surroundings, "ascii", ascii_locale, True)
    yield trial("two runs in one second", two_in_one_second)
    yield trial("two evaluations of one run", two_evaluations)
    yield trial("two writers of a cache with files of the user", shared_cache)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Makes runs go wrong in many ways, and prints what became of them."""

    quick: bool = False
    """Try a few faults of each kind."""
    only: str = ""
    """Try the faults whose row of the table holds this text."""
    jobs: int = limited(2, at_least=1)
    """How many trials run at a time."""
    json: Path | None = None
    """File to write; must be new, or with `--only` one whose rows are tried again, and the source
    without changes since its commit."""

    def __post_init__(self):
        check_fields(self)


def attempt(trial: Trial) -> str:
    """What a trial finds; nothing if the run ended as it must."""
    try:
        trial[1]()
    except Exception as error:  # whatever it is
        return f"{type(error).__name__}: {error}"
    return ""


def _before(arguments: Arguments) -> list[dict[str, Any]]:
    """What earlier calls have stored; of none, the file is reserved."""
    path = arguments.json
    if path is None or not (arguments.only and path.is_file()):
        measure.reserve(PROGRAM, "json", path)
        return []
    return json.loads(path.read_text(encoding="utf-8"))


def main(argv: list[str] | None = None) -> bool:
    """Tries everything and prints a table; returns whether all runs ended as they must."""
    arguments = cli.parse(PROGRAM, Arguments, sys.argv[1:] if argv is None else argv)
    if arguments.json is not None:
        measure.require_commit(PROGRAM)
    before = _before(arguments)
    # First: a commit that is made meanwhile is not what is tried.
    passed: dict[str, list[bool]] = {}
    results = {**measure.origin(studies.command(PROGRAM, arguments)), "passed": passed}
    with tempfile.TemporaryDirectory() as folder:
        runs = Runs(Path(folder))
        runs.whole(*SMOKE)
        chosen = [t for t in trials(runs, arguments.quick) if arguments.only in t[0]]
        with ThreadPoolExecutor(arguments.jobs) as executor:
            for (row, _), failure in zip(chosen, executor.map(attempt, chosen), strict=True):
                passed.setdefault(row, []).append(not failure)
                if failure:
                    print(f"{row}: {failure}", file=sys.stderr, flush=True)
                # After each trial, so that what was tried before a failure is kept.
                studies.write(arguments.json, [*before, results])
    print(table([results]))
    return all(itertools.chain.from_iterable(passed.values()))


if __name__ == "__main__":
    sys.exit(not main())

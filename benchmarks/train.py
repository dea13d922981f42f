"""The whole training program, from the command line to the end of its process."""

import functools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks import measure
from benchmarks.measure import Options, Row


def train(options: Options) -> Row:
    """Seconds with an empty compilation cache."""
    return _row("train", *_both_runs(options.quick)[0])


def train_warm(options: Options) -> Row:
    """Seconds of the same command once more, with the compilation cache that it left."""
    return _row("train_warm", *_both_runs(options.quick)[1])


def _row(name: str, seconds: float, compile_s: float) -> Row:
    return measure.make_row(name, "s", seconds, compile_s=compile_s, batch=1)


@functools.cache
def _both_runs(quick: bool) -> tuple[tuple[float, float], tuple[float, float]]:
    """Seconds, and those of them in which a stage was compiled, cold and warm."""
    with tempfile.TemporaryDirectory() as folder:

        def run(name: str) -> tuple[float, float]:
            out = Path(folder) / name
            command = [sys.executable, "-m", "jaxsense.train", "--out", str(out)]
            command += ["--cache", str(Path(folder) / "cache")]
            command += ["--preset", "smoke"] if quick else []
            seconds = measure.seconds(
                lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            )
            stages = json.loads((out / "summary.json").read_text())["timing"]["stages"]
            return seconds, sum(stage["compile_s"] for stage in stages.values())

        return run("cold"), run("warm")

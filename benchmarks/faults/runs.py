"""Runs in processes of their own, and what they are compared with."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any


class BrokenError(AssertionError):
    """A run that did not do what it must."""


def require(condition: Any, text: str) -> None:
    """Raises `BrokenError` unless the condition holds."""
    if not condition:
        raise BrokenError(text)


class Runs:
    """Runs in a temporary directory, with what they are compared with."""

    def __init__(self, folder: Path):
        self.folder, self._whole, self._lock = folder, dict[str, Any](), threading.Lock()
        self._seconds = dict[str, float]()

    def path(self, name: str) -> Path:
        """A new directory's name."""
        return self.folder / name.replace(" ", "-").replace("/", "-")

    def train(
        self, *arguments: str, child: tuple[str, ...] = (), **options: Any
    ) -> subprocess.CompletedProcess[str]:
        """Trains in a process of its own; with `child`, a fault and its stage."""
        return self.start(*arguments, child=child, **options).finish()

    def start(self, *arguments: str, child: tuple[str, ...] = (), **options: Any) -> "Process":
        """Begins to train."""
        module = "benchmarks.faults.child" if child else "jaxsense.train"
        cache = () if "--cache" in arguments else ("--cache", str(self.folder / "cache"))
        return Process([sys.executable, "-m", module, *child, *arguments, *cache], **options)

    def whole(self, *arguments: str) -> Any:
        """The summary of a run that nothing has gone wrong with."""
        name = "-".join(["whole", *arguments]).replace("--", "")
        with self._lock:
            if name not in self._whole:
                path = self.path(name)
                ended = self.train(*arguments, "--out", str(path))
                require(ended.returncode == 0, ended.stderr)
                self._whole[name] = summary(path)
            return self._whole[name]

    def seconds(self, *arguments: str) -> float:
        """How long a run takes from when it has a `config.json`, while another one runs."""
        self.whole(*arguments)
        with self._lock:
            name = "-".join(arguments)
            if name not in self._seconds:
                paths = [self.path(f"timed {name} {i}") for i in range(2)]
                both = [self.start(*arguments, "--out", str(path)) for path in paths]
                wait_for(paths[0] / "config.json", both[0])
                begin = time.monotonic()
                for process in both:
                    require(process.finish().returncode == 0, "a plain run")
                self._seconds[name] = time.monotonic() - begin
            return self._seconds[name]

    def check_resumed(self, path: Path, *arguments: str) -> None:
        """Resumes a run, which must end as if nothing had gone wrong."""
        again = ["--resume", str(path), "--quiet"]
        if not (path / "config.json").exists():
            again = [*arguments, "--out", str(path)]
        if not (path / "summary.json").exists():
            ended = self.train(*again)
            require(ended.returncode == 0, f"{path.name}: {ended.stderr}")
        require(summary(path) == self.whole(*arguments), f"{path.name}: another summary")
        for file in path.rglob("metrics.jsonl"):
            reported = map(json.loads, file.read_text(encoding="utf-8").splitlines())
            steps = [(line["stage"], line["step"]) for line in reported if "loss" in line]
            require(len(set(steps)) == len(steps), f"{file}: steps reported twice")


class Process:
    """A program that runs."""

    def __init__(self, command: list[str], cwd: Path | None = None, **options: Any):
        root = Path(__file__).parents[2]
        environment = dict(options.pop("env", os.environ), JAX_PLATFORMS="cpu")
        paths = [str(root), *filter(None, [environment.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        self._command = command
        self._process = subprocess.Popen(
            command,
            cwd=cwd or root,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )

    def has_ended(self) -> bool:
        """Whether it no longer runs."""
        return self._process.poll() is not None

    def kill_after(self, seconds: float) -> None:
        """As `kill -9` after some time, unless it has ended by then."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        self._process.send_signal(signal.SIGKILL)

    def finish(self) -> subprocess.CompletedProcess[str]:
        """Waits for its end."""
        output, errors = self._process.communicate(timeout=1800)
        return subprocess.CompletedProcess(self._command, self._process.returncode, output, errors)


def wait_for(path: Path, process: Process) -> None:
    """Waits until a process has written a file."""
    end = time.monotonic() + 120.0
    while not path.exists():
        if process.has_ended():
            ended = process.finish()
            require(path.exists(), f"{path.name}: status {ended.returncode}, {ended.stderr}")
        require(time.monotonic() < end, f"{path} does not come")
        time.sleep(0.01)


def summary(path: Path) -> Any:
    """The summary of a run without times."""

    def without(value: Any) -> Any:
        if isinstance(value, dict):
            dropped = ("timing", "env_steps_per_s")
            return {k: without(v) for k, v in value.items() if k not in dropped}
        return value

    return without(json.loads((path / "summary.json").read_text(encoding="utf-8")))


def lines(text: str) -> list[str]:
    """Lines that say something."""
    return [line for line in text.splitlines() if line.strip()]

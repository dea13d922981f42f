"""Run directories, of one seed or of several: creates, resumes and reads them."""

import contextlib
import dataclasses
import functools
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path

import jax
import numpy as np
from jaxtyping import PyTree

from jaxsense import models
from jaxsense.config import Config, ConfigError
from jaxsense.config.section import require_32_bits
from jaxsense.core import inside
from jaxsense.models import Models
from jaxsense.run import files, output, version
from jaxsense.run.files import Checkpoints
from jaxsense.run.settings import Settings, as_json, began, of_run, read_settings, resumable
from jaxsense.summary.blocks import Origin
from jaxsense.summary.compare import UNKNOWN
from jaxsense.summary.read import ORIGINS, read_origins
from jaxsense.tasks.registry import PREFIX, load_pretrained
from jaxsense.training import stages
from jaxsense.training.agents import learners

_METRICS = "metrics.jsonl"
_MOST_METRICS = 2**28  # bytes


class RunDirectory:
    """Writes the files of one run, and never overwrites files of another.

    Attributes:
      path: the directory.
      settings: of the run.
      checkpoints: of the run.
    """

    def __init__(self, path: Path, settings: Settings):
        self.path, self.settings = path, settings
        self.checkpoints = Checkpoints(path / "checkpoints")

    @classmethod
    @contextlib.contextmanager
    def create(cls, path: Path | None, settings: Settings) -> "Iterator[RunDirectory]":
        """Makes the directory with its `config.json`, and locks it for this process.

        If a `ConfigError` or Ctrl-C ends the run before anything else is written, its files are
        removed, and so is the directory if it is new.

        Args:
          path: a new or empty directory; by default `dated(settings.preset)`.
          settings: of the run.

        Raises:
          ConfigError: if the directory is not empty.
          OSError: if it cannot be written, or another process has locked it.
        """
        with begun(path, settings.preset) as place, files.locked(place):
            run = cls(place, settings)
            # There is none, unless another process has been faster.
            write_json(place / "config.json", as_json(settings), is_new=True)
            try:
                yield run
            except (ConfigError, KeyboardInterrupt):
                run._withdraw()
                raise

    @classmethod
    @contextlib.contextmanager
    def resume(cls, path: Path, trust: bool = False) -> "Iterator[RunDirectory]":
        """Opens the directory of a stopped run, and locks it for this process.

        Raises:
          ConfigError: see `resumable`.
          OSError: if another process has locked the directory.
        """
        settings = resumable(path, trust)
        with files.locked(path):
            run = cls(path, settings)
            run._remove_partial()
            run._mend_metrics()
            yield run

    @property
    def seeds(self) -> dict[int, Path]:
        """The directory of each seed; raises `OSError` if one leads out of the run."""
        if self.settings.num_seeds == 1:
            return {self.settings.seed: self.path}
        return {n: inside.place(self.path / f"seed-{n}", self.path) for n in self.settings.seeds}

    def check_seeds(self) -> None:
        """Raises `ConfigError` if the directory of a seed holds another run."""
        for seed, path in self.seeds.items():
            if path == self.path or not (path / "config.json").exists():
                continue
            # The settings are only compared: no custom sensor is made.
            if read_settings(path / "config.json", trust=True) != self._settings_of(seed):
                reason = f"must have the settings of {self.path / 'config.json'}, with seed {seed}"
                raise ConfigError("resume", str(path), reason)

    def of_seed(self, seed: int, path: Path) -> "AbstractContextManager[RunDirectory]":
        """Opens the directory of a seed, the same as if that seed were trained alone."""
        if path == self.path:
            return contextlib.nullcontext(self)
        if (path / "config.json").exists():
            return RunDirectory.resume(path, trust=True)
        return RunDirectory.create(path, self._settings_of(seed))

    def _settings_of(self, seed: int) -> Settings:
        return dataclasses.replace(self.settings, seed=seed, num_seeds=1)

    def append_metrics(self, *, stage: str, step: int, **metrics: float) -> None:
        """Adds a line to `metrics.jsonl`: metrics of a stage after so many steps."""
        files.append(self.path / _METRICS, json.dumps({"stage": stage, "step": step, **metrics}))

    def sign(self) -> list[Origin]:
        """Adds this process to `origins.json`, those that have worked on the run; returns all."""
        found = read_origins(self.path)
        if not found and (self.path / "checkpoints").exists():
            found.append(UNKNOWN)
        if process() not in found[-1:]:
            found.append(process())
            write_json(self.path / ORIGINS, found)
        return found

    def _remove_partial(self) -> None:
        """Removes partial files of a killed process; raises `OSError` if a link leads elsewhere."""
        for place in (self.path, self.path / "checkpoints", self.path / "checkpoints/unfinished"):
            if inside.place(place, self.path).is_dir():
                files.remove_unfinished(place)

    def _withdraw(self) -> None:
        """Empties the directory if the run has written only its settings."""
        ours = {".lock", "config.json"}
        with contextlib.suppress(OSError):
            if {path.name for path in self.path.iterdir()} <= ours:
                for name in ours:
                    (self.path / name).unlink(missing_ok=True)

    def _mend_metrics(self) -> None:
        """Cuts off a partial line of `metrics.jsonl`."""
        path = self.path / _METRICS
        if os.path.lexists(path):
            content = inside.read(path, _MOST_METRICS)
            # Always, to find out at once whether the run can be written; and where the file is a
            # link, lines go to a new one.
            files.write(path, content[: content.rfind(b"\n") + 1])


def dated(name: str) -> Path:
    """Makes a new directory `runs/DATE-TIME-NAME`, with a number after it if that is taken."""
    first = path = Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{name}"
    path.parent.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        try:
            path.mkdir()
            return path
        except FileExistsError:
            number += 1
            path = first.with_name(f"{first.name}-{number}")


@contextlib.contextmanager
def begun(path: Path | None, name: str) -> Iterator[Path]:
    """Makes a directory, and removes it if it stays empty and was not there before.

    Args:
      path: a new or empty directory; by default `dated(name)`.
      name: what is in it.

    Raises:
      ConfigError: if the directory is not empty.
      OSError: if it cannot be made.
    """
    is_new = path is None or not path.exists()
    path = path or dated(name)
    path.mkdir(parents=True, exist_ok=True)
    # A process that was killed at once leaves the lock.
    if any(each.name != ".lock" for each in path.iterdir()):
        reason = "is not empty; must be a new or empty directory"
        raise ConfigError("out", str(path), reason)
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            if is_new:
                path.rmdir()


def write_json(
    path: Path, content: Mapping[str, object] | Sequence[object], *, is_new: bool = False
) -> None:
    """Writes finite numbers, texts, lists and dictionaries as a JSON file for people."""
    files.write(path, json.dumps(content, indent=2, allow_nan=False) + "\n", is_new=is_new)


def origin() -> Origin:
    """How figures of this process are made."""
    return {**process(), "date": datetime.now().date().isoformat()}


@functools.cache
def process() -> Origin:
    """What is the same for all figures of this process."""
    found: Origin = {
        "versions": version.versions(),
        "devices": [device.device_kind for device in jax.devices()],
        "cores": output.cores(),
        "source": version.SOURCE,
    }
    return {**found, "commit": commit} if (commit := version.commit()) else found


def newest(path: Path) -> Path:
    """A path; for `latest`, that of the newest finished run in `runs/`.

    Raises:
      ConfigError: if there is none, or if trained models are named, which are no run.
    """
    if str(path).startswith(PREFIX) and not path.exists():
        raise ConfigError("run", str(path), "only names models; must be a finished run")
    if str(path) != "latest" or path.exists():
        return path
    runs = sorted(config.parent for config in Path("runs").glob("*/config.json"))
    # Nobody could type the other names, and a terminal might obey them.
    finished = [r for r in runs if r.name.isprintable() and (r / "summary.json").exists()]
    if not finished:
        raise ConfigError("run", "latest", "there is no finished run in runs/")
    return max(finished, key=began)


def load(path: Path | str, trust: bool = False) -> tuple[Config, Models]:
    """Reads the settings and the trained models of a finished run.

    Args:
      path: the run's directory; `latest` for the newest finished one in `runs/`; or
        `pretrained:PRESET`, see `load_pretrained`.
      trust: whether its `config.json` may name custom sensors, whose code runs.

    Returns:
      The settings and the models, on the default device.

    Raises:
      ConfigError: if the directory holds no finished run, a run of another version or a damaged
        checkpoint, if the run names custom sensors without trust, or if JAX computes in 64 bits.
    """
    require_32_bits()
    if not isinstance(path, str | Path):
        raise ConfigError("run", path, "must be a path")
    if str(path).startswith(PREFIX) and not Path(path).exists():
        return load_pretrained(str(path).removeprefix(PREFIX))
    path = newest(Path(path))
    settings = of_run(path, trust)
    config, checkpoints = settings.config, Checkpoints(path / "checkpoints")
    if not (path / "checkpoints").exists() and settings.num_seeds != 1:
        raise ConfigError("run", str(path), f"holds several seeds; choose one, {path}/seed-...")

    def restore(name: str, shape: PyTree) -> PyTree:
        return jax.device_put(checkpoints.load(name, shape, finite=True))

    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    sources = stages.sources(config)
    parts = {part: getattr(shapes, part) for part in sources}
    return config, models.make_models(config, **jax.tree.map(restore, sources, parts))


def rewards(
    runs: Sequence[Path], config: Config, warn: Callable[[str], None]
) -> dict[str, dict[str, np.ndarray]]:
    """Reads the curves of `reward.svg` from the checkpoints of several runs.

    Args:
      runs: their directories.
      config: their settings.
      warn: called with a line about each checkpoint that is damaged or missing.

    Returns:
      `[K, epochs]` rewards of `pipeline.TrainingResults`, without those of such checkpoints.
    """
    epochs = config.dqn.epochs
    lengths = dict.fromkeys(("reward", "evaluation", "epsilon"), epochs)
    lengths |= {"seconds": epochs // config.dqn.chunk}
    shapes = {name: np.empty(length, np.float32) for name, length in lengths.items()}

    def found(network: str, run: Path) -> dict[str, np.ndarray] | None:
        try:
            return Checkpoints(run / "checkpoints").load(f"curves_{network}", shapes)
        except ConfigError as error:
            warn(f"{error}; left out of reward.svg")
            return None

    curves: dict[str, dict[str, np.ndarray]] = {}
    for network in learners(config):
        of_runs = [each for run in runs if (each := found(network, run))]
        curves[network.removeprefix("dqn_")] = {
            name: np.array([each[name] for each in of_runs]).reshape(-1, epochs)
            for name in ("reward", "evaluation")
        }
    return curves

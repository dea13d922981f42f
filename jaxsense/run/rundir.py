"""Run directories: creates, resumes and reads them."""

import contextlib
import functools
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import cast

import jax
from jaxtyping import PyTree

from jaxsense import models
from jaxsense.config import Config, ConfigError, parse_json, require_32_bits
from jaxsense.config.options import command
from jaxsense.core import inside
from jaxsense.models import Models
from jaxsense.run import devices, files, version
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.settings import Settings, as_json, began, of_run, resumable
from jaxsense.summary.blocks import Made, Origin
from jaxsense.summary.compare import UNKNOWN
from jaxsense.summary.read import ORIGINS, read_made
from jaxsense.tasks.pretrained import PREFIX, PRETRAINED, load_pretrained
from jaxsense.training import stages
from jaxsense.training.agents import learner

_METRICS = "metrics.jsonl"
_MOST_METRICS, _MOST_METRICS_LINE = 2**28, 2**16  # bytes


class RunDirectory:
    """Writes the files of one run, and never overwrites files of another.

    Attributes:
      path: the directory.
      settings: of the run.
      checkpoints: of the run.
    """

    def __init__(self, path: Path, settings: Settings):
        self.path, self.settings = path, settings
        self.checkpoints = Checkpoints(path / "checkpoints", saved=self.sign)
        self._made: list[Made] = []
        self._reported: dict[str, int] = {}

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
          ConfigError: if the directory is not empty, cannot be written, or is locked by another
            process.
        """
        with contextlib.ExitStack() as kept:
            path = kept.enter_context(begun(path, settings.preset))
            try:
                kept.enter_context(_locked(path, "out"))
                run = cls(path, settings)
                run._remove_partial()
                _check_empty(path)  # once more: another process may have been faster
                write_json(path / "config.json", as_json(settings))
            except OSError as error:
                raise _unwritable(path, error) from None
            try:
                yield run
            except (ConfigError, KeyboardInterrupt):
                run._withdraw()
                raise

    @classmethod
    @contextlib.contextmanager
    def resume(cls, path: Path, trust: bool = False) -> "Iterator[RunDirectory]":
        """Opens the directory of a stopped run, and locks it for this process.

        Args:
          path: the directory.
          trust: see `resumable`.

        Raises:
          ConfigError: see `resumable`; also if another process locks the directory.
        """
        settings = resumable(path, trust)
        with _locked(path, "resume"):
            run = cls(path, settings)
            run._remove_partial()
            run.checkpoints.check(is_begun=(path / _METRICS).exists())
            run._made = read_made(path)
            if not run._made and (path / "checkpoints").exists():
                run._made = [{**UNKNOWN, "stage": "earlier stages"}]
            run._read_metrics()
            yield run

    def append_metrics(self, *, stage: str, step: int, **metrics: float) -> None:
        """Adds a line to `metrics.jsonl`, unless this run wrote it before it was killed.

        Args:
          stage: that reports.
          step: number of steps so far.
          **metrics: after that step.

        Raises:
          WriteError: if the file cannot be written.
        """
        if step > self._reported.get(stage, -1):
            line = json.dumps({"stage": stage, "step": step, **metrics})
            files.append(self.path / _METRICS, line)

    def made(self, stage: str) -> list[Made]:
        """What made each stage so far, and this process, which makes another."""
        mine: Made = {**_process(), "stage": stage}
        return self._made if mine in self._made else [*self._made, mine]

    def sign(self, checkpoint: str) -> list[Made]:
        """Writes to `origins.json` that this process made a checkpoint; returns its content."""
        made = self.made(checkpoint.removeprefix("unfinished/").removeprefix("curves_"))
        if made != self._made:
            self._made = made
            write_json(self.path / ORIGINS, made)
        return made

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

    def _read_metrics(self) -> None:
        """Reads the last step of each stage from `metrics.jsonl`, and cuts off a partial line."""
        path = self.path / _METRICS
        if not os.path.lexists(path):
            return
        content = inside.read(path, _MOST_METRICS)
        whole = content[: content.rfind(b"\n") + 1]
        # Always, to find out at once whether the run can be written; and where the file is a link,
        # lines go to a new one.
        files.write(path, whole)
        for line in io.BytesIO(whole):
            with contextlib.suppress(ValueError, KeyError, TypeError, OverflowError):
                found = cast(dict, parse_json(line[:_MOST_METRICS_LINE]))
                stage, step = found["stage"], int(found["step"])
                self._reported[stage] = max(step, self._reported.get(stage, -1))


def unused(path: Path) -> Path:
    """Makes a new directory, with a number after its name if the name is taken.

    Args:
      path: the directory.

    Returns:
      The directory made.

    Raises:
      ConfigError: if it cannot be made.
    """
    found, number = path, 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            with contextlib.suppress(FileExistsError):
                found.mkdir()
                return found
            number += 1
            found = path.with_name(f"{path.name}-{number}")
    except OSError as error:
        raise ConfigError("out", str(path), f"cannot be made ({error.strerror})") from None


def dated(name: str) -> Path:
    """Makes a new directory `runs/DATE-TIME-NAME`, see `unused`.

    Args:
      name: what is in it.
    """
    return unused(Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{name}")


@contextlib.contextmanager
def begun(path: Path | None, name: str) -> Iterator[Path]:
    """Makes a directory, and removes it if it stays empty and was not there before.

    Args:
      path: a new or empty directory; by default `dated(name)`.
      name: what is in it.

    Raises:
      ConfigError: if the directory is not empty or cannot be made.
    """
    try:
        is_new = path is None or not path.exists()
        path = path or dated(name)
        path.mkdir(parents=True, exist_ok=True)
        _check_empty(path)
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            if is_new:
                path.rmdir()


def _unwritable(path: Path | None, error: OSError) -> ConfigError:
    """The error about a directory of results that cannot be written."""
    reason = f"cannot be written ({error.strerror}); must be a new directory"
    return ConfigError("out", str(path), reason)


def _check_empty(path: Path) -> None:
    """Raises `ConfigError` if a directory holds more than a lock and a partial `config.json`."""
    if any(f.name != ".lock" and not files.is_unfinished(f, "config.json") for f in path.iterdir()):
        raise ConfigError("out", str(path), "is not empty; must be a new or empty directory")


@contextlib.contextmanager
def _locked(path: Path, field: str) -> Iterator[None]:
    """Locks a directory; raises `ConfigError` about `field` if another process holds the lock."""
    with contextlib.ExitStack() as kept:
        try:
            kept.enter_context(files.locked(path))
        except BlockingIOError:
            reason = "is being written by another process; wait for it to end"
            raise ConfigError(field, str(path), reason) from None
        except OSError as error:
            raise ConfigError(field, str(path), f"cannot be written ({error.strerror})") from None
        yield


def write_json(path: Path, content: Mapping[str, object] | Sequence[object]) -> None:
    """Writes a JSON file.

    Args:
      path: the file.
      content: finite numbers, texts, lists and dictionaries.

    Raises:
      WriteError: if the file cannot be written.
      ValueError: if a number is not finite.
    """
    files.write(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def origin() -> Origin:
    """How figures of this process are made."""
    return {**_process(), "date": datetime.now().date().isoformat()}


@functools.cache
def _process() -> Origin:
    """What is the same for all figures of this process."""
    found: Origin = {
        "versions": version.versions(),
        "devices": [device.device_kind for device in jax.devices()],
        "cores": devices.cores(),
        "source": version.SOURCE,
    }
    return {**found, "commit": commit} if (commit := version.commit()) else found


def newest(path: Path) -> Path:
    """Returns a path; for `latest`, that of the newest finished run in `runs/`.

    Raises:
      ConfigError: if there is no finished run, or if the models that come with jaxsense are named.
    """
    preset = (given := str(path)).removeprefix(PREFIX)
    is_pretrained = preset != given or preset in PRETRAINED
    if not (is_pretrained or given == "latest") or path.exists():
        return path
    if is_pretrained:
        reason = f"must be the directory of a finished run; {PREFIX}{preset} only names models, "
        demo = f"{command('jaxsense.demo')} --preset {preset}"
        raise ConfigError("run", given, f"{reason}which {demo} plays")
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
    path, given = Path(path), str(path)
    if given.startswith(PREFIX) and not path.exists():
        return load_pretrained(given.removeprefix(PREFIX))
    path = newest(path)
    settings = of_run(path, trust)
    config = settings.config
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    checkpoints = Checkpoints(path / "checkpoints")

    if not (path / "checkpoints").exists() and settings.num_seeds != 1:
        raise ConfigError("run", str(path), f"holds several seeds; choose one, {path}/seed-...")

    def restore(name: str, shape: PyTree) -> PyTree:
        found = checkpoints.load(name, shape, finite=True)
        if found is None:
            reason = f"must be a finished run (there is no checkpoint {name!r})"
            raise ConfigError("run", str(path), reason)
        return jax.device_put(found)

    found = {name: restore(name, shape) for name, shape in _named(shapes, config).items()}
    return config, stages.models(found, config)


def _named(models: Models, config: Config) -> dict[str, PyTree]:
    """The parts of the models, by the names of their stages and checkpoints."""
    detectors = zip(config.modalities, models.detectors, strict=True)
    q_networks = zip(config.modalities, models.q_networks, strict=True)
    return {
        **{f"detector_{name}": detector for name, detector in detectors},
        "best_jmvae": models.jmvae,
        "novelty": models.novelty,
        "fusion": models.fusion,
        "look_values": models.look_values,
        **{learner(config, name): q_network for name, q_network in q_networks},
        **dict(zip(("tours",), models.tours, strict=False)),
    }

"""The directory of a run: writes it, resumes in it, and reads it back."""

import contextlib
import dataclasses
import errno
import hashlib
import itertools
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from jaxsense import models, training
from jaxsense.config import (
    PRESETS,
    Config,
    ConfigError,
    as_plain,
    from_plain,
    parse_json,
    require_trust,
)
from jaxsense.models import Models
from jaxsense.run import files
from jaxsense.run.checkpoints import Checkpoints
from jaxsense.run.version import __version__, versions
from jaxsense.training.agents import learner

_METRICS = "metrics.jsonl"


@dataclasses.dataclass(frozen=True)
class Settings:
    """All that determines a run's results, on the same devices and versions.

    Attributes:
      preset: origin of the settings.
      seed: of all randomness.
      config: the settings.
      num_seeds: number of seeds to train, from `seed` on.
    """

    preset: str
    seed: int
    config: Config
    num_seeds: int = 1

    @property
    def seeds(self) -> range:
        """All seeds."""
        return range(self.seed, self.seed + self.num_seeds)


class RunDirectory:
    """Writes the files of one run, and never overwrites those of another.

    Attributes:
      path: the directory.
      settings: of the run.
      checkpoints: of the run.
    """

    def __init__(self, path: Path, settings: Settings):
        """Takes an existing directory; see `create` and `resume`."""
        self.path, self.settings = path, settings
        self.checkpoints = Checkpoints(path / "checkpoints")

    @classmethod
    @contextlib.contextmanager
    def create(cls, path: Path, settings: Settings) -> "Iterator[RunDirectory]":
        """Makes the directory with its `config.json`, and locks it for this process.

        Raises:
          ConfigError: if the directory is not empty or cannot be written, or another process
            locks it.
        """
        content = {
            "preset": settings.preset,
            "seed": settings.seed,
            "num_seeds": settings.num_seeds,
            "config": as_plain(settings.config),
            "versions": versions(),
            "commit": commit(),
        }
        content["digest"] = _digest(content)
        reason = "cannot be written ({}); must be a new directory"
        with contextlib.ExitStack() as kept:
            try:
                path.mkdir(parents=True, exist_ok=True)
                # Before the lock too, so as to add no file to another directory.
                _check_empty(path)
                kept.enter_context(_locked(path, "out"))
                run = cls(path, settings)
                run._remove_unfinished()
                _check_empty(path)
                write_json(path / "config.json", content)
            except OSError as error:
                raise ConfigError("out", str(path), reason.format(error.strerror)) from None
            yield run

    @classmethod
    @contextlib.contextmanager
    def resume(cls, path: Path, trust: bool = False) -> "Iterator[RunDirectory]":
        """Opens the directory of a stopped run, and locks it for this process.

        Raises:
          ConfigError: as `resumable`, or if another process locks the directory.
        """
        settings = resumable(path, trust)
        with _locked(path, "resume"):
            run = cls(path, settings)
            run._remove_unfinished()
            run.checkpoints.check(is_begun=(path / _METRICS).exists())
            run._drop_unfinished_line()
            yield run

    def write_json(self, name: str, content: Any) -> None:
        """Writes a file of the run, see the function `write_json`."""
        write_json(self.path / name, content)

    def save_models(self, models: Models) -> None:
        """Saves trained models for `load`; raises `OSError` if they cannot be written."""
        for name, tree in _named(models, self.settings.config).items():
            self.checkpoints.save(name, tree)

    def append_metrics(self, **metrics: Any) -> None:
        """Adds a line to `metrics.jsonl`."""
        files.append(self.path / _METRICS, json.dumps(metrics))

    def _remove_unfinished(self) -> None:
        """Removes partial files of a killed process."""
        for place in (self.path, *self.checkpoints.directories()):
            files.remove_unfinished(place)

    def _drop_unfinished_line(self) -> None:
        """Removes the partial last line of a killed process from `metrics.jsonl`."""
        path = self.path / _METRICS
        if path.exists():
            content = path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            if whole != content:
                files.write(path, whole)


def unused(path: Path) -> Path:
    """Makes a new directory, with a number after its name if the name is taken.

    Raises:
      ConfigError: if it cannot be made.
    """
    first = path
    try:
        first.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(2):
            try:
                path.mkdir()
                break
            except FileExistsError:
                path = first.with_name(f"{first.name}-{number}")
    except OSError as error:
        raise ConfigError("out", str(path), f"cannot be made ({error.strerror})") from None
    return path


def _check_empty(path: Path) -> None:
    """Raises `ConfigError` if a directory holds more than a lock."""
    # A process killed at once may leave a lock and a partial file.
    if any(f.name != ".lock" and not files.is_unfinished(f, "config.json") for f in path.iterdir()):
        raise ConfigError("out", str(path), "is not empty; must be a new directory")


def resumable(path: Path, trust: bool = False) -> Settings:
    """The settings of a stopped run.

    Raises:
      ConfigError: if there is no run, another version wrote it, it is finished, or it names code
        without trust.
    """
    content = _read_config(path / "config.json", "resume", path)
    _check_origin(content, "resume", path)
    if (path / "summary.json").exists():
        raise ConfigError("resume", str(path), "is finished; must be a stopped run")
    return _settings_of(content, trust)


@contextlib.contextmanager
def _locked(path: Path, field: str) -> Iterator[None]:
    """Locks a directory; raises `ConfigError` about `field` if another process holds it."""
    with contextlib.ExitStack() as kept:
        try:
            kept.enter_context(files.locked(path, waits=False))
        except BlockingIOError:
            reason = "is being written by another process; wait for its end"
            raise ConfigError(field, str(path), reason) from None
        yield


def commit() -> str | None:
    """The commit of jaxsense's source, with `-dirty` if changed; None outside Git."""
    source = Path(__file__).parents[1]
    if not (source / ".git").exists():
        return None
    command = ["git", "-C", str(source), "describe", "--always", "--dirty", "--abbrev=40"]
    command += ["--exclude", "*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()


def write_json(path: Path, content: Any) -> None:
    """Writes a JSON file, see `files.write`."""
    files.write(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_settings(file: Path, trust: bool = False) -> Settings:
    """Reads the settings in the `config.json` of a run.

    Missing ones come from the preset that it names, by default `default`, with seed 0.

    Args:
      file: the file.
      trust: whether it may name code, which runs when its sensors are made.

    Raises:
      ConfigError: if the file cannot be read or names code without trust; otherwise names the field
        that is unknown or wrong.
    """
    return _settings_of(_read_config(file, "config", file), trust)


def load(path: Path | str, trust: bool = False) -> tuple[Config, Models]:
    """Reads the settings and the trained models of a finished run.

    Args:
      path: the run's directory.
      trust: whether to run the functions that its `config.json` names for your own sensors.

    Returns:
      The settings and the models, on the default device.

    Raises:
      ConfigError: if the directory holds no finished run, a run of another version, a damaged
        checkpoint, or settings that name code without trust.
    """
    path = Path(path)
    content = _read_config(path / "config.json", "run", path)
    _check_origin(content, "run", path)
    config = _settings_of(content, trust).config
    shapes = jax.eval_shape(lambda: models.init(jax.random.key(0), config))
    checkpoints = Checkpoints(path / "checkpoints")

    if not checkpoints.exists() and content.get("num_seeds", 1) != 1:
        raise ConfigError("run", str(path), f"holds several seeds; choose one, {path}/seed-...")

    def restore(name: str, shape: Any) -> Any:
        found = checkpoints.load(name, shape)
        if found is None:
            reason = f"must be a finished run (there is no checkpoint {name!r})"
            raise ConfigError("run", str(path), reason)
        return jax.device_put(found)

    found = {name: restore(name, shape) for name, shape in _named(shapes, config).items()}
    return config, training.models(found, config)


def _named(models: Models, config: Config) -> dict[str, Any]:
    """The parts of the models, by the names of their stages and checkpoints."""
    detectors = zip(config.modalities, models.detectors, strict=True)
    q_networks = zip(config.modalities, models.q_networks, strict=True)
    return {
        **{f"detector_{name}": detector for name, detector in detectors},
        "best_jmvae": models.jmvae,
        "fusion": models.fusion,
        "look_values": models.look_values,
        **{learner(config, name): q_network for name, q_network in q_networks},
        **({} if models.tours is None else {"tours": models.tours}),
    }


def _read_config(file: Path, field: str, value: Path) -> dict[str, Any]:
    """Reads a `config.json`; raises `ConfigError` about `field = value` if that fails."""
    try:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise OSError(errno.EINVAL, "Not a regular file")  # it may never end
        content = parse_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        reason = f"must hold a run's settings ({file.name}: {error.strerror})"
        raise ConfigError(field, str(value), reason) from None
    except ValueError as error:
        reason = f"must hold a run's settings ({file.name} is no JSON: {error})"
        raise ConfigError(field, str(value), reason) from None
    if not isinstance(content, dict):
        raise ConfigError(field, str(value), f"{file.name} must hold an object")
    return content


def _settings_of(content: dict[str, Any], trust: bool) -> Settings:
    """The settings in the content of a `config.json`."""
    known = {"preset", "seed", "num_seeds", "config", "versions", "commit", "digest"}
    unknown = sorted(set(content) - known)
    if unknown:
        raise ConfigError(unknown[0], content[unknown[0]], "is no field of a run's config.json")
    preset = content.get("preset", "default")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigError("preset", preset, f"must be one of {', '.join(PRESETS)}")
    numbers = {"seed": content.get("seed", 0), "num_seeds": content.get("num_seeds", 1)}
    for name, number in numbers.items():
        if not isinstance(number, int) or isinstance(number, bool):
            raise ConfigError(name, number, "must be a whole number")
    config = from_plain(content.get("config", {}), PRESETS[preset])
    if not trust:
        require_trust(config)
    return Settings(preset, config=config, **numbers)


def _digest(content: dict[str, Any]) -> str:
    """SHA-256 of the content of a `config.json`, without its digest."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _check_origin(content: dict[str, Any], field: str, path: Path) -> None:
    """Raises `ConfigError` about a `config.json` to which the run's checkpoints may not belong.

    A version whose checkpoints may differ wrote it, or it has changed since the run began.
    """
    recorded = content.get("versions")
    wrote = recorded.get("jaxsense") if isinstance(recorded, dict) else None
    if not isinstance(wrote, str) or wrote.split(".")[:2] != __version__.split(".")[:2]:
        by = f"jaxsense {wrote}" if wrote else "an older jaxsense"
        raise ConfigError(field, str(path), f"was written by {by}; this is {__version__}")
    if content.get("digest") not in (None, _digest(content)):
        reason = "config.json has changed since the run began; start a new run with --config"
        raise ConfigError(field, str(path), reason)

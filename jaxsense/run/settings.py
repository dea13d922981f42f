"""Settings of a run, and the `config.json` in which its directory keeps them."""

import dataclasses
import errno
import hashlib
import json
from pathlib import Path
from typing import TypeAlias

from jaxsense.config import (
    PRESETS,
    Config,
    ConfigError,
    as_plain,
    from_plain,
    parse_json,
    require_trust,
)
from jaxsense.run.version import __version__, commit, versions

Json: TypeAlias = dict[str, object]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Everything that determines a run's results, on the same devices and versions.

    Attributes:
      preset: name of the preset that the settings started from.
      seed: of all randomness; the first one if there are several.
      config: all settings.
      num_seeds: number of seeds to train.
    """

    preset: str
    seed: int
    config: Config
    num_seeds: int = 1

    @property
    def seeds(self) -> range:
        """All seeds."""
        return range(self.seed, self.seed + self.num_seeds)


class NotARunError(ConfigError):
    """A directory that holds no run."""

    def __init__(self, path: Path):
        self.expected = "is not a run directory: it has no config.json"
        ValueError.__init__(self, f"{path} {self.expected}")


def as_json(settings: Settings) -> Json:
    """The content of a `config.json`: settings, versions, and a digest of both."""
    content: Json = {
        "preset": settings.preset,
        "seed": settings.seed,
        "num_seeds": settings.num_seeds,
        "config": as_plain(settings.config),
        "versions": versions(),
        "commit": commit(),
    }
    return {**content, "digest": _digest(content)}


def read_settings(file: Path, trust: bool = False) -> Settings:
    """Reads the settings in a `config.json`.

    Missing ones come from the preset that it names, `default` if it names none, with seed 0.

    Args:
      file: the file.
      trust: whether it may name custom sensors, whose code runs when they are made.

    Raises:
      ConfigError: if the file cannot be read, a field is unknown or wrong, or if it names custom
        sensors without trust.
    """
    return _settings_of(_read_config(file, "config", file), trust)


def resumable(path: Path, trust: bool = False) -> Settings:
    """Reads the settings of a stopped run.

    Args:
      path: the directory.
      trust: whether `config.json` may name custom sensors, whose code runs.

    Raises:
      ConfigError: if there is no run, if another version wrote it, if it is finished, or if it
        names custom sensors without trust.
    """
    content = _read_config(path / "config.json", "resume", path)
    _check_origin(content, "resume", path)
    if (path / "summary.json").exists():
        raise ConfigError("resume", str(path), "is finished; must be a stopped run")
    return _settings_of(content, trust)


def of_run(path: Path, trust: bool = False) -> Settings:
    """Reads the settings of a run whose models are wanted.

    Args:
      path: the directory.
      trust: whether `config.json` may name custom sensors, whose code runs.

    Raises:
      ConfigError: if there is no run, if another version wrote it, or if it names custom sensors
        without trust.
    """
    content = _read_config(path / "config.json", "run", path)
    _check_origin(content, "run", path)
    return _settings_of(content, trust)


def _read_config(file: Path, field: str, path: Path) -> Json:
    """The content of a `config.json`.

    Raises `ConfigError` about `field = path`, which is the file or its run's directory.
    """
    try:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise OSError(errno.EINVAL, "Not a regular file")  # a pipe might never end
        content = parse_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        reason = f"{file.name} cannot be read ({error.strerror})"
        if path != file and isinstance(error, FileNotFoundError | NotADirectoryError):
            raise NotARunError(path) from None
        raise ConfigError(field, str(path), reason) from None
    except ValueError as error:
        raise ConfigError(field, str(path), f"{file.name} is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise ConfigError(field, str(path), f"{file.name} must hold an object")
    return content


def _settings_of(content: Json, trust: bool) -> Settings:
    """The settings in a `config.json`; raises `ConfigError` if one is unknown or wrong."""
    known = {"preset", "seed", "num_seeds", "config", "versions", "commit", "digest"}
    unknown = sorted(set(content) - known)
    if unknown:
        raise ConfigError(unknown[0], content[unknown[0]], "unknown field of a run's config.json")
    preset = content.get("preset", "default")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigError("preset", preset, f"must be one of {', '.join(PRESETS)}")

    def whole(name: str, default: int) -> int:
        number = content.get(name, default)
        if not isinstance(number, int) or isinstance(number, bool):
            raise ConfigError(name, number, "must be a whole number")
        return number

    seed, num_seeds = whole("seed", 0), whole("num_seeds", 1)
    config = from_plain(content.get("config", {}), PRESETS[preset])
    if not trust:
        require_trust(config)
    return Settings(preset, seed, config, num_seeds)


def _digest(content: Json) -> str:
    """SHA-256 of the content of a `config.json`, apart from its digest."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _check_origin(content: Json, field: str, path: Path) -> None:
    """Raises `ConfigError` if the run's checkpoints may not fit its `config.json`.

    That is so if another version wrote it, or if it has changed since the run began.
    """
    recorded = content.get("versions")
    wrote = recorded.get("jaxsense") if isinstance(recorded, dict) else None
    if not isinstance(wrote, str) or wrote.split(".")[:2] != __version__.split(".")[:2]:
        by = f"jaxsense {wrote}" if wrote else "an older jaxsense"
        raise ConfigError(field, str(path), f"was written by {by}; this is {__version__}")
    if content.get("digest") not in (None, _digest(content)):
        reason = "config.json has changed since the run began; start a new run with --config"
        raise ConfigError(field, str(path), reason)

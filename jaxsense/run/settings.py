"""Settings of a run, and the `config.json` in which its directory keeps them."""

import hashlib
import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeAlias

from jaxsense.config import PRESETS, Config, ConfigError, as_plain, from_plain
from jaxsense.config.options import parse
from jaxsense.config.section import Checked, limited, require, require_known
from jaxsense.core import inside
from jaxsense.run.version import __version__, commit, versions

Json: TypeAlias = dict[str, object]
MAX_SEED = 2**32 - 1
"""Largest seed of `jax.random.key`."""

_KNOWN = {"preset", "seed", "num_seeds", "config", "versions", "commit", "began", "digest"}


class Settings(Checked):
    """Everything that determines a run's results, on the same devices and versions.

    Attributes:
      preset: Settings to start from: `default`, `paper`, `noisy`, `many`, `raw`, `team`, `recorded`
        or `smoke`; the other options change them.
      seed: Seed of all randomness, from 0 to 2^32 - 1.
      num_seeds: Number of seeds to train, starting from `--seed`. Each has its own directory within
        the run, which reports their means and 95 % confidence intervals.
    """

    preset: str = "default"
    seed: int = limited(0, at_least=0, at_most=MAX_SEED)
    config: Config = Config()
    num_seeds: int = limited(1, at_least=1, at_most=10_000)

    def check(self) -> None:
        """Checks the last seed; raises `ConfigError`."""
        require(self.seeds[-1] <= MAX_SEED, self, "num_seeds", "leads beyond seed 2^32 - 1")

    @property
    def seeds(self) -> range:
        """All seeds."""
        return range(self.seed, self.seed + self.num_seeds)


def as_json(settings: Settings) -> Json:
    """The content of a `config.json`: settings, versions, the time, and a digest of all."""
    content: Json = {
        "preset": settings.preset,
        "seed": settings.seed,
        "num_seeds": settings.num_seeds,
        "config": as_plain(settings.config),
        "versions": versions(),
        "commit": commit(),
        "began": datetime.now(UTC).isoformat(),
    }
    return {**content, "digest": _digest(content)}


def began(path: Path) -> float:
    """When a run began, in seconds since 1970; else when its `config.json` last changed."""
    file = path / "config.json"
    try:
        return datetime.fromisoformat(str(_read(file, "run", path)["began"])).timestamp()
    except (KeyError, ValueError, OverflowError):
        return file.lstat().st_mtime


def read_settings(file: Path, trust: bool = False) -> Settings:
    """Reads a `config.json`, or a TOML file of the same form, as those of presets.

    Missing settings come from the preset that it names, or `default`.

    Raises:
      ConfigError: if the file cannot be read, a field is unknown or wrong, or if it names custom
        sensors, whose code runs when they are made, without trust.
    """
    return _settings_of(_read(file, "config", file), trust)


def resumable(path: Path, trust: bool = False) -> Settings:
    """Reads the settings of a stopped run; raises `ConfigError` as `of_run`, or if finished."""
    settings = of_run(path, trust, "resume")
    if os.path.lexists(path / "summary.json"):
        raise ConfigError("resume", str(path), "is finished; must be a stopped run")
    return settings


def of_run(path: Path, trust: bool = False, field: str = "run") -> Settings:
    """Reads the settings of a run whose models are wanted; errors name it as an option `field`.

    Raises:
      ConfigError: if there is no run, if another version wrote it, if its `config.json` has changed
        since, or if it names custom sensors without trust.
    """
    content = _read(path / "config.json", field, path)
    # Its checkpoints may not fit otherwise.
    recorded = content.get("versions")
    wrote = recorded.get("jaxsense") if isinstance(recorded, dict) else None
    if not isinstance(wrote, str) or wrote.split(".")[:2] != __version__.split(".")[:2]:
        by = f"jaxsense {wrote}" if wrote else "an older jaxsense"
        raise ConfigError(field, str(path), f"was written by {by}; this is {__version__}")
    if content.get("digest") != _digest(content):
        reason = "config.json has changed since the run began; start a new run with --config"
        raise ConfigError(field, str(path), reason)
    return _settings_of(content, trust)


def _read(file: Path, field: str, path: Path) -> Json:
    """The content of a `config.json`; raises `ConfigError` about `field = path`."""
    form = "TOML" if file.suffix.lower() == ".toml" else "JSON"
    try:
        # A file that the user names may be a link, that of a run may not lead out of it.
        real = Path(os.path.realpath(file)) if path == file else file
        if isinstance(content := parse(inside.read(real), is_toml=form == "TOML"), dict):
            return content
        reason = f"{file.name} must hold an object"
    except OSError as error:
        reason = f"{file.name} cannot be read ({error.strerror})"
        if path != file and isinstance(error, FileNotFoundError | NotADirectoryError):
            reason = "is not a run directory: it has no config.json"
    except ValueError as error:
        reason = f"{file.name} is not {form}: {error}"
    raise ConfigError(field, str(path), reason)


def _settings_of(content: Json, trust: bool) -> Settings:
    """The settings in a `config.json`; raises `ConfigError` if one is unknown or wrong."""
    if unknown := sorted(set(content) - _KNOWN):
        reason = "unknown field of a config.json or preset, which hold settings in config"
        raise ConfigError(unknown[0], content[unknown[0]], reason)
    require_known("preset", preset := content.get("preset", "default"), PRESETS)
    config = from_plain(content.get("config", {}), PRESETS[str(preset)])
    if not trust:
        config.require_trust()
    numbers = {name: content[name] for name in ("seed", "num_seeds") if name in content}
    return Settings(**{"preset": preset, "seed": 0, "config": config, **numbers})


def _digest(content: Json) -> str:
    """SHA-256 of the content of a `config.json`, apart from its digest."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()

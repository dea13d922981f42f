"""Presets: ready-made settings of a run, by name."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

from jaxsense.config.options import from_plain
from jaxsense.config.section import FrozenDict
from jaxsense.config.whole import Config

_FILES = Path(__file__).parent  # in the form that `--config` takes


def _read(name: str) -> Config:
    """The settings of a preset, which change those of another one."""
    if name == "default":
        return Config()
    content = tomllib.loads((_FILES / f"{name}.toml").read_text(encoding="utf-8"))
    return from_plain(content["config"], _read(content.get("preset", "default")))


_NAMES = "default", "paper", "noisy", "many", "raw", "team", "recorded", "smoke"
PRESETS: Mapping[str, Config] = FrozenDict({name: _read(name) for name in _NAMES})
"""Ready-made settings of a run, by name.

`default`: the best settings we know. `paper`: the paper's settings where it states them, otherwise
settings chosen to reproduce its figures, see `docs/differences.md`. `noisy`: detections that are
often uncertain, and beliefs that accumulate looks. `many`: sixteen classes of four colours and four
shapes, with the sensors of `noisy` and a team. `raw`: `default`, but the JMVAE learns from scans
themselves, without detectors or labels. `team`: one policy for any number of PoIs and robots that
takes travel time into account. `recorded`: `default` with the noise of a real laser scanner.
`smoke`: the whole pipeline with very little training, for tests.
"""

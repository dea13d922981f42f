"""How far an accelerator's results are from the CPU's: `python -m benchmarks.agreement`."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
import rich.console
import rich.table

from jaxsense import PRESETS, init, make_jmvae, mission, sim
from jaxsense.run import devices
from jaxsense.vae import detect, posterior

_SCENES = 256
_SECONDS = 1.0


def main(argv: list[str]) -> None:
    """Prints the largest differences; with a file as argument, writes the results there instead."""
    devices.start(None)
    if argv:
        np.savez(argv[0], allow_pickle=False, **_results())
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cpu.npz"
        # Some of what is compiled depends on the backend of the process.
        subprocess.run(
            [sys.executable, "-m", "benchmarks.agreement", str(file)],
            check=True,
            env={**os.environ, "JAX_PLATFORMS": "cpu"},
        )
        expected = dict(np.load(file))
    kind = jax.devices()[0].device_kind
    table = rich.table.Table("result", "largest difference", title=f"CPU and {kind}")
    for name, values in _results().items():
        table.add_row(name, f"{np.abs(values - expected[name]).max():.1e}")
    rich.console.Console().print(table)


def _results() -> dict[str, np.ndarray]:
    """Scans, beliefs and motion in random scenes, on the default device."""
    config = PRESETS["default"]
    scenario = mission.make_mission(config)
    models, model = init(jax.random.key(0), config), make_jmvae(config)
    keys = jax.random.split(jax.random.key(1), _SCENES)

    @jax.jit
    def run(keys: jax.Array):
        shape = _SCENES, config.arena.num_pois
        classes = jax.random.randint(jax.random.key(2), shape, 0, len(config.arena.classes))
        _, windows, _ = jax.vmap(lambda key, classes: sim.survey(key, scenario.world, classes))(
            keys, classes
        )
        of_each = jax.vmap(jax.vmap(detect, (None, 0)), (None, 0))
        features = [of_each(d, w) for d, w in zip(models.detectors, windows, strict=True)]
        encode = jax.vmap(jax.vmap(lambda *f: posterior(models.jmvae, model, f)))
        states = jax.vmap(
            lambda key: mission.reset(key, scenario, models, scenario.policy("naive"))
        )(keys)
        periods = round(_SECONDS / config.mission.control_period)
        states, _ = mission.rollout_batch(keys, scenario, models, states, periods, 1)
        found = dict(zip(config.modalities, windows, strict=True))
        return found, encode(*features), states.scene.poses

    windows, belief, poses = jax.tree.map(np.asarray, run(keys))
    return {
        **{f"window of the {name}": window for name, window in windows.items()},
        "belief, mean": belief.mean,
        "belief, standard deviation": belief.std,
        f"poses after {_SECONDS:.0f} s of a mission, in m and rad": poses,
    }


if __name__ == "__main__":
    main(sys.argv[1:])

"""Another Python, the lowest versions and the large extras, each in an environment of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
SAMPLE = ("tests/core", "tests/vae", "tests/interfaces/test_gymnasium.py")
LARGE = ("tests/interfaces/test_parity.py", "tests/interfaces/test_stable_baselines3.py")


def find_python(version):
    """The interpreter that `.ci/run` would take; skips the test if there is none."""
    script = 'source .ci/pythons && find_python "$0"'
    command = ["bash", "-c", script, version]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip(found.stderr.strip())
    return found.stdout.strip()


@pytest.mark.slow  # installs everything, from a package index
@pytest.mark.parametrize(
    ("version", "pins", "extras", "tests"),
    [
        ("3.12", ["3.12"], "test", SAMPLE),
        ("3.11", ["lowest"], "test", SAMPLE),
        (HERE, [HERE, "extras"], "test,rejax,sb3", LARGE),
    ],
    ids=["3.12", "lowest", "extras"],
)
def test_it_installs_trains_and_passes_tests(version, pins, extras, tests, tmp_path):
    place = tmp_path / "environment"
    python = str(place / "bin" / "python")
    environment = {**os.environ, "PATH": f"{place / 'bin'}:{os.environ['PATH']}"}
    for name in [name for name in environment if name.startswith("PYTEST_")] + ["PYTHONPATH"]:
        environment.pop(name, None)

    def run(*command):
        ended = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, f"{ended.stdout[-8000:]}\n{ended.stderr[-8000:]}"
        return ended.stdout

    run(find_python(version), "-m", "venv", str(place))
    pinned = [part for name in pins for part in ("-c", f"constraints/{name}.txt")]
    run(python, "-m", "pip", "install", "--quiet", *pinned, "-e", f".[{extras}]")
    run(python, "-m", "pip", "check")
    run(python, "-m", "jaxsense.train", "--preset", "smoke", "--quiet", "--out", tmp_path / "run")
    assert (tmp_path / "run" / "summary.json").exists()
    output = run(python, "-m", "pytest", "-p", "no:cacheprovider", "-rs", *tests)
    assert "SKIPPED" not in output

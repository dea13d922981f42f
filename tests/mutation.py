"""Mutation testing: breaks one place at a time and prints what the tests let pass.

    pip install cosmic-ray
    python tests/mutation.py                        # all modules below
    python tests/mutation.py jaxsense/dqn/losses.py

It works on a copy of the checkout. Of each module it draws the same `NUMBER` mutants every time;
those that no test could miss, such as shifts of floating-point numbers, are left out.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from cosmic_ray.work_db import use_db  # pyright: ignore[reportMissingImports]
from cosmic_ray.work_item import WorkerOutcome, WorkResult  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parents[1]
NUMBER, SEED = 20, 0
TESTS = {
    "jaxsense/dqn/losses.py": "tests/dqn/test_losses.py",
    "jaxsense/dqn/belief_mdp.py": "tests/dqn/test_belief_mdp.py tests/dqn/test_not_finite.py",
    "jaxsense/dqn/policies.py": "tests/dqn/test_policies.py tests/dqn/test_not_finite.py",
    "jaxsense/dqn/replay.py": "tests/dqn/test_replay.py",
    "jaxsense/dqn/training.py": "tests/dqn/test_not_finite.py tests/dqn/test_dqn_training.py",
    "jaxsense/sim/raycast.py": "tests/sim/test_raycast_plane.py"
    " tests/sim/test_raycast_gradients.py tests/sim/test_raycast.py",
    "jaxsense/vae/gaussian.py": "tests/vae/test_gaussian.py",
    "jaxsense/vae/fusion.py": "tests/vae/test_fusion.py",
    "jaxsense/vae/jmvae.py": "tests/vae/test_jmvae_draws.py"
    " tests/vae/test_jmvae_equation.py tests/vae/test_jmvae.py -k 'not trained and not lowers'",
}
CONFIG = """
[cosmic-ray]
module-path = "{module}"
timeout = 300.0
excluded-modules = []
test-command = "{python} -m pytest -o addopts= -p no:cacheprovider -q -x {tests}"

[cosmic-ray.distributor]
name = "local"

[cosmic-ray.filters.operators-filter]
exclude-operators = [
  "core/ReplaceBinaryOperator_\\\\w+_(Mod|FloorDiv|Pow|LShift|RShift|BitOr|BitXor|BitAnd)",
  "core/ReplaceBinaryOperator_BitOr_\\\\w+",
  "core/ReplaceComparisonOperator_\\\\w+_Is(Not)?",
  "core/ReplaceUnaryOperator_\\\\w+_(Not|Invert)",
]
"""


def survivors(module: str, copy: Path) -> tuple[int, list[str]]:
    """How many mutants of a module were tried, and the changes that its tests let pass."""
    scripts, session = Path(sys.executable).parent, copy / "session.sqlite"
    config = copy / "cosmic-ray.toml"
    config.write_text(CONFIG.format(module=module, python=sys.executable, tests=TESTS[module]))
    session.unlink(missing_ok=True)
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_COMPILATION_CACHE_DIR": str(copy / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }

    def run(*command: str | Path) -> None:
        subprocess.run(list(map(str, command)), cwd=copy, env=environment, check=True)

    run(scripts / "cosmic-ray", "init", config, session)
    run(scripts / "cr-filter-operators", session, config)
    with use_db(str(session)) as db:
        mutants = sorted(
            db.pending_work_items,
            key=lambda item: (item.mutations[0].start_pos, item.mutations[0].operator_name),
        )
        tried = random.Random(SEED).sample(mutants, min(NUMBER, len(mutants)))
        for item in mutants:
            if item not in tried:
                db.set_result(item.job_id, WorkResult(WorkerOutcome.SKIPPED))
    run(scripts / "cosmic-ray", "baseline", config)
    run(scripts / "cosmic-ray", "exec", config, session)
    with use_db(str(session)) as db:
        ids = {item.job_id for item in tried}
        results = [result for id_, result in db.results if id_ in ids]
        return len(tried), [str(r.diff) for r in results if not r.is_killed]


def main() -> None:
    """Tries the modules that are named, or all, and prints the share that was killed."""
    number, alive = 0, []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "runs", "docs"))
        for module in sys.argv[1:] or TESTS:
            tried, passed = survivors(module, copy)
            number, alive = number + tried, alive + passed
            print(f"{module}: {tried - len(passed)} of {tried} killed", *passed, sep="\n")
            sys.stdout.flush()
    print(f"{number - len(alive)} of {number} killed, {1 - len(alive) / number:.1%}")


if __name__ == "__main__":
    main()

"""What becomes of runs that something happens to; see `docs/reliability.md`."""

import subprocess
import sys

import pytest


@pytest.mark.slow  # some 40 minutes, with the table of `docs/reliability.md`
@pytest.mark.timeout(3 * 3600)
def test_all_faults_end_as_they_must(capsys):
    with capsys.disabled():
        subprocess.run([sys.executable, "-m", "tests.faults"], check=True)

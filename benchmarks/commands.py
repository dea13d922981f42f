"""Runs the commands that results, runs and pictures are made with."""

import os
import shlex
import subprocess
import sys


def run(command: str, *more: str) -> bool:
    """Runs a command in this Python and tells whether it succeeded.

    Args:
      command: `python ...`, after any environment variables, `NAME=VALUE`.
      more: words to append.
    """
    words = shlex.split(command)
    start = words.index("python")
    variables = dict(word.split("=", 1) for word in words[:start])
    print(shlex.join([*words, *more]), flush=True)
    found = subprocess.run(
        [sys.executable, *words[start + 1 :], *more],
        env={**os.environ, **variables},
        check=False,
    )
    return found.returncode == 0

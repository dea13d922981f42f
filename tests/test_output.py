"""Standard streams that are closed or full: what a command says, and how it ends."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from smoke import SMOKE

FULL = pytest.param("full", marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="none"))
REASONS = {
    "full": "No space left on device",
    "broken": "Broken pipe",
    "closed": "Bad file descriptor",
}
OUTPUTS = [FULL, "broken", "closed"]


def call(argv, output):
    """Runs Python with a standard output that takes nothing; its status, and standard error."""
    place = os.open("/dev/full", os.O_WRONLY) if output == "full" else broken()
    command = ["sh", "-c", 'exec "$0" "$@" >&-'] if output == "closed" else []
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    try:
        done = subprocess.run(
            [*command, sys.executable, *argv],
            stdout=place,
            stderr=subprocess.PIPE,
            env=environment,
            text=True,
            check=False,
        )
    finally:
        os.close(place)
    return done.returncode, done.stderr


def broken():
    """A pipe that nobody reads."""
    read, write = os.pipe()
    os.close(read)
    return write


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(
    "argv",
    [["--help"], pytest.param(["train", "--help-all"], marks=pytest.mark.slow)],  # imports JAX
    ids=" ".join,
)
def test_a_result_that_cannot_be_printed_is_told_in_one_line(argv, output):
    expected = f"jaxsense: standard output cannot be written ({REASONS[output]})\n"
    assert call(["-m", "jaxsense", *argv], output) == (1, expected)


RUN = """
import atexit, sys, threading, time
from jaxsense.run import output
atexit.register(lambda: print("left", file=sys.stderr))
threading.Thread(target=time.sleep, args=(600,)).start()  # as if it compiled
def main():
    {}
output.run(main)
print("end", file=sys.stderr)
os = sys.modules["os"]
sys.stderr.flush()
os._exit(0)
"""


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("output.say('x'); output.say('y'); print('z')", (0, "end\n")),
        ("output.say('x'); sys.exit(3)", (3, "left\n")),
        ("output.say('x'); sys.exit()", (0, "left\n")),
        ("output.complain('no'); sys.exit('text')", (1, "no\nleft\n")),
        ("raise KeyboardInterrupt", (130, "Interrupted.\n")),
    ],
)
def test_a_command_ends_with_its_own_status(code, expected, output):
    assert call(["-c", RUN.format(code)], output) == expected


@pytest.mark.parametrize("output", OUTPUTS)
def test_python_has_nothing_to_add_at_its_end(output):
    code = "from jaxsense.run import output; output.run(lambda: output.say('x' * 100_000))"
    assert call(["-c", code], output) == (0, "")


def test_errors_go_nowhere_if_standard_error_is_closed():
    command = f"{shlex.quote(sys.executable)} -m jaxsense no-such-command 2>&-"
    assert subprocess.getstatusoutput(command) == (2, "")


def test_the_cache_is_where_the_user_keeps_caches():
    code = """
import importlib, os
from jaxsense.run import cli
for place in ("/a b", "relative", ""):
    os.environ["XDG_CACHE_HOME"] = place
    print(importlib.reload(cli).CACHE)
"""
    told = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert told == "/a b/jaxsense\n~/.cache/jaxsense\n~/.cache/jaxsense\n"


@pytest.mark.slow  # trains, evaluates and exports in processes of their own
def test_who_reads_the_first_line_only_has_whole_results(tmp_path, cache):
    run = tmp_path / "run"
    for argv, file in (
        (["train", *SMOKE[:-1], *cache, "--out", str(run)], run / "summary.json"),
        (["evaluate", str(run), "--episodes", "1", *cache], run / "evaluations"),
        (["export", str(run)], run / "exported.zip"),
    ):
        command = [sys.executable, "-m", "jaxsense", *argv]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen(command, **pipes) as process:
            if argv[0] != "export":
                assert process.stdout.readline()
            process.stdout.close()
            assert process.stderr.read() == ""
        assert process.returncode == 0
        assert file.exists()

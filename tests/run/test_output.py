"""The process of a command: signals, and standard streams that are closed or full."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxsense.run import output
from jaxsense.run.output import on_interrupt

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
def test_a_result_that_cannot_be_printed_is_told_in_one_line(output):
    expected = f"jaxsense: standard output cannot be written ({REASONS[output]})\n"
    assert call(["-m", "jaxsense", "--help"], output) == (1, expected)


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


@pytest.mark.parametrize("output", ["broken", "closed"])
@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("output.say('x'); output.say('y'); print('z')", (0, "end\n")),
        ("output.say('x'); sys.exit(3)", (3, "left\n")),
        ("output.complain('no'); sys.exit('text')", (1, "no\nleft\n")),
        ("raise KeyboardInterrupt", (130, "Interrupted.\n")),
    ],
)
def test_a_command_ends_with_its_own_status(code, expected, output):
    assert call(["-c", RUN.format(code)], output) == expected


# The module alone: the package would be imported for seconds.
PROGRAM = """
import runpy, signal, sys
on_interrupt = runpy.run_path(sys.argv[1])["on_interrupt"]
first, second = map(int, sys.argv[2:])
signal.signal(signal.SIGINT, signal.default_int_handler)
with on_interrupt(lambda: print("stopping", flush=True)):
    signal.raise_signal(first)
    print("still here", flush=True)
    signal.raise_signal(second)
    print("never")
"""


@pytest.mark.parametrize(
    ("first", "second"), [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)]
)
def test_the_first_signal_stops_in_order_and_the_second_one_at_once(first, second):
    signals = str(int(first)), str(int(second))
    command = [sys.executable, "-c", PROGRAM, output.__file__, *signals]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == -second
    assert ended.stdout == "stopping\nstill here\n"
    assert ended.stderr == ""


def test_what_was_there_before_comes_back_and_what_is_ignored_stays_so():
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        at_first, stopped = signal.getsignal(signal.SIGINT), []
        with on_interrupt(lambda: stopped.append(True)):
            signal.raise_signal(signal.SIGTERM)
            assert not stopped
            signal.raise_signal(signal.SIGINT)
            assert stopped == [True]
        assert signal.getsignal(signal.SIGINT) is at_first
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)

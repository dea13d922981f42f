"""Ctrl-C and SIGTERM: the first one stops in order, the second one at once."""

import signal
import subprocess
import sys

import pytest

from jaxsense.run import output
from jaxsense.run.output import on_interrupt

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

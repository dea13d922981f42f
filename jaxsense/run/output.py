"""The process of a command: its threads, signals, standard streams and exit status."""

import atexit
import contextlib
import errno
import gc
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator
from types import FrameType

INTERRUPTED = 130  # exit status, as in shells
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NO_MEMORY = "RESOURCE_EXHAUSTED"
_RARELY = 100_000, 50, 50  # see `gc.set_threshold`


def cores() -> int:
    """Number of cores that this process may use."""
    is_known = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if is_known else os.cpu_count() or 1


def run(main: Callable[[], None]) -> None:
    """Runs a command; ends the process if it exits, and without a traceback at Ctrl-C."""
    # XLA, which no command has used yet, needs more threads than run programs: `devices.threads`.
    os.environ.setdefault("NPROC", str(2 * cores()))
    # Tracing makes and drops millions of small objects; by default, looking for circles among them
    # takes a sixth of its time. Modules stay.
    gc.freeze()
    gc.set_threshold(*_RARELY)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # The terminal may be unable to show the name of a directory.
        sys.stdout.reconfigure(errors="backslashreplace")
    status = None
    try:
        main()
    except KeyboardInterrupt:
        complain("Interrupted.")
        status = INTERRUPTED
    except (MemoryError, RuntimeError) as error:  # JAX's errors are of the second kind
        if not isinstance(error, MemoryError) and _NO_MEMORY not in str(error):
            raise
        first, *_ = str(error).splitlines() or [_NO_MEMORY]
        complain(f"Not enough memory: lower the sizes in the settings ({first})")
        status = 1
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        atexit._run_exitfuncs()
    for name in ("stdout", "stderr"):
        try:
            print(end="", file=getattr(sys, name), flush=True)
        except OSError:
            setattr(sys, name, None)  # Python would fail at its end
    if status is not None:
        os._exit(status)  # any other exit would wait for compiling threads


@contextlib.contextmanager
def on_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Calls `stop` at the first Ctrl-C or SIGTERM; the second one ends the process.

    Enter it in the main thread, where Python handles signals.
    """
    # Signals that the parent process made this one ignore stay ignored.
    before = {
        number: handler
        for number in _SIGNALS
        if (handler := signal.getsignal(number)) is not signal.SIG_IGN
    }

    def handle(number: int, frame: FrameType | None) -> None:
        # Any other end would wait for threads that compile or save.
        for each in before:
            signal.signal(each, signal.SIG_DFL)
        stop()

    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def tell(text: str) -> None:
    """Prints the result of a command; if it cannot be printed, exits with status 1 and a line."""
    try:
        if sys.stdout is None:  # closed before the process began
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        print(text, flush=True)
    except OSError as error:
        complain(f"jaxsense: standard output cannot be written ({error.strerror})")
        sys.exit(1)


def say(text: str) -> None:
    """Prints a line; ignores output that cannot be written, since results are in files."""
    with contextlib.suppress(OSError):
        print(text, flush=True)


def complain(text: str) -> None:
    """Prints a line to standard error, if it is still open."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            print(text, file=sys.stderr, flush=True)

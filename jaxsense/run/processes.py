"""Processes that share a run."""

import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxsense.config import ConfigError

_JOIN_TIMEOUT = 300.0  # s
LEAVE_TIMEOUT = 10.0  # s


def join(
    coordinator: str | None,
    number: int | None,
    index: int | None,
    begins: Callable[[], None] = lambda: None,
) -> None:
    """Joins the processes that share a run; does nothing without arguments.

    Ctrl-C ends the wait for the other processes.

    Args:
      coordinator: `HOST:PORT` of the first process, which listens at this address only.
      number: of processes.
      index: of this process, from 0.
      begins: called after the arguments are validated, before waiting for the others.

    Raises:
      ConfigError: if only some arguments are given, if a value is wrong, or if the others do not
        come within five minutes.
    """
    given = {"coordinator": coordinator, "num_processes": number, "process_index": index}
    if set(given.values()) == {None}:
        return
    if missing := [name for name, value in given.items() if value is None]:
        name, value = next((name, value) for name, value in given.items() if value is not None)
        others = " and ".join(f"--{other.replace('_', '-')}" for other in missing)
        raise ConfigError(name, value, f"also needs {others}")
    assert coordinator is not None
    assert number is not None
    assert index is not None
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        reason = "must be HOST:PORT, with a port from 1 to 65535"
        raise ConfigError("coordinator", coordinator, reason)
    if number < 1:
        raise ConfigError("num_processes", number, "must be greater than 0")
    if not 0 <= index < number:
        raise ConfigError("process_index", index, f"must be from 0 to {number - 1}")
    host, port = host.strip("[]"), int(port)
    try:
        socket.getaddrinfo(host, port)
    except OSError as error:
        raise ConfigError("coordinator", coordinator, f"cannot be found ({error})") from None
    begins()
    joined: Future[None] = Future()

    def initialise() -> None:
        try:
            jax.distributed.initialize(
                coordinator,
                number,
                index,
                coordinator_bind_address=coordinator if index == 0 else None,
                # JAX ends the process when this is over, so it must come second.
                initialization_timeout=int(2 * _JOIN_TIMEOUT),
            )
            joined.set_result(None)
        except BaseException as error:
            joined.set_exception(error)

    end = time.monotonic() + _JOIN_TIMEOUT
    if index > 0:
        _wait_for_listener(host, port, end)
    # A signal is not noticed in the thread that waits within JAX.
    threading.Thread(target=initialise, daemon=True).start()
    while not joined.done() and time.monotonic() < end:
        wait((joined,), timeout=0.2)
    try:
        joined.result(timeout=0)
    except TimeoutError:
        reason = f"not all {number} processes have joined within {_JOIN_TIMEOUT:.0f} s"
        raise ConfigError("coordinator", coordinator, reason) from None
    except (RuntimeError, ValueError) as error:
        reason = f"cannot be joined ({str(error).splitlines()[0]})"
        raise ConfigError("coordinator", coordinator, reason) from None


def _wait_for_listener(host: str, port: int, end: float) -> None:
    """Waits until the first process listens, or raises `ConfigError` at `end`, in monotonic s."""
    while True:
        try:
            socket.create_connection((host, port), timeout=1.0).close()
            return
        except OSError as error:
            if time.monotonic() > end:
                expected = f"the first process does not listen ({error.strerror or error})"
                raise ConfigError("coordinator", f"{host}:{port}", expected) from None
            time.sleep(0.2)


def of_first_process(values: np.ndarray) -> np.ndarray:
    """The first process's values, in all processes; blocks until all have called it."""
    return np.asarray(multihost_utils.broadcast_one_to_all(values))


def leave(timeout: float | None = None) -> None:
    """Waits for the other processes of the run, if any, and disconnects.

    Args:
      timeout: seconds to wait for processes that may not end; by default without limit.
    """
    if jax.process_count() > 1:
        waiting = threading.Thread(target=jax.distributed.shutdown, daemon=True)
        waiting.start()
        waiting.join(timeout)

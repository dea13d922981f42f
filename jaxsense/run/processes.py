"""Processes that share a run."""

import socket
import threading
from concurrent.futures import Future

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxsense.config import ConfigError
from jaxsense.run.output import say

_JOIN_TIMEOUT = 300.0  # s
LEAVE_TIMEOUT = 10.0  # s


def join(
    coordinator: str | None, number: int | None, index: int | None, *, quiet: bool = False
) -> None:
    """Joins the processes that share a run; does nothing without arguments.

    Ctrl-C ends the wait for the other processes.

    Args:
      coordinator: `HOST:PORT` of the first process, which listens at this address only.
      number: of processes.
      index: of this process, from 0.
      quiet: whether not to say that it waits.

    Raises:
      ConfigError: if only some arguments are given, if a value is wrong, or if the others do not
        come within five minutes.
    """
    given = {"coordinator": coordinator, "num_processes": number, "process_index": index}
    if coordinator is None or number is None or index is None:
        there = {name: value for name, value in given.items() if value is not None}
        missing = " and ".join(f"--{x.replace('_', '-')}" for x in given if x not in there)
        for name, value in there.items():
            raise ConfigError(name, value, f"also needs {missing}")
        return
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        reason = "must be HOST:PORT, with a port from 1 to 65535"
        raise ConfigError("coordinator", coordinator, reason)
    if number < 1:
        raise ConfigError("num_processes", number, "must be greater than 0")
    if not 0 <= index < number:
        raise ConfigError("process_index", index, f"must be from 0 to {number - 1}")
    try:
        socket.getaddrinfo(host.strip("[]"), port)
    except OSError as error:
        raise ConfigError("coordinator", coordinator, f"cannot be found ({error})") from None
    if not quiet:
        say(f"Waiting for the other processes at {coordinator}.")
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

    # A signal is not noticed in the thread that waits within JAX.
    threading.Thread(target=initialise, daemon=True).start()
    try:
        joined.result(_JOIN_TIMEOUT)
    except TimeoutError:
        reason = f"not all {number} processes have joined within {_JOIN_TIMEOUT:.0f} s"
        raise ConfigError("coordinator", coordinator, reason) from None
    except (RuntimeError, ValueError) as error:
        reason = f"cannot be joined ({str(error).splitlines()[0]})"
        raise ConfigError("coordinator", coordinator, reason) from None


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

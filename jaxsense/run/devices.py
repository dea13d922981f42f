"""Spreads work over the cores of a CPU, over accelerators, and over processes that share a run."""

import contextlib
import ctypes
import dataclasses
import functools
import math
import os
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from jaxsense.config import ConfigError
from jaxsense.run.output import cores, say

T = TypeVar("T")
R = TypeVar("R")

Options: TypeAlias = dict[str, Any]  # JAX declares fewer types than it takes
AXIS = "devices"
_JOIN_TIMEOUT = 300.0  # s
LEAVE_TIMEOUT = 10.0  # s
_LEAST_MEMORY = 2**33  # bytes, of an accelerator
_ALIGNED = 64  # bytes
_PASSES_OVER_LOOPS = "while-loop-invariant-code-motion,while-loop-constant-sinking"
MAX_DEVICES = 256
NUM_THREADS = min(cores(), 8)
"""Number of threads that share work on a CPU by default."""


def compiler_options(*, runs_long: bool = False, wide_vectors: bool = False) -> Options:
    """Compiler options that minimise the total time of compiling and running a program.

    On a CPU, level 1 compiles a third faster than level 3, with equally fast programs. The older
    code generator, which a program can choose up to JAX 0.10, saves another third, but its programs
    may be a third slower. Passes that move invariants out of nested loops repeat all others, for a
    sixth of the compile time. On an accelerator, only programs that run long are autotuned.

    Args:
      runs_long: whether the program runs much longer than it compiles.
      wide_vectors: of 512 bits on a CPU: roadmaps take half as long, Q-learning a sixth longer.

    Returns:
      The options that the installed compiler supports; none if JAX is set to compile quickly.
    """
    if jax.config.values["jax_disable_most_optimizations"]:
        return {}
    wanted: Options = {}
    if jax.default_backend() == "cpu":
        wanted = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": runs_long}
        if not runs_long:
            wanted["xla_disable_hlo_passes"] = _PASSES_OVER_LOOPS
        if wide_vectors:
            wanted["xla_cpu_prefer_vector_width"] = 512
    elif jax.default_backend() == "gpu" and not runs_long:
        wanted = {"xla_backend_optimization_level": 1, "xla_gpu_autotune_level": 0}
    return {name: value for name, value in wanted.items() if _is_known(name, value)}


@functools.cache
def _is_known(option: str, value: int | bool | str) -> bool:
    """Whether the installed compiler supports an option, which depends on its version."""
    options: Options = {option: value}
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options=options)
    except jax.errors.JaxRuntimeError:
        return False
    return True


@dataclasses.dataclass(frozen=True)
class Workers:
    """Threads of a CPU, or devices of a mesh, that share the rows of a batch.

    Attributes:
      threads: number of threads, each with its own calls of a program; 1 with a mesh.
      mesh: from `make_mesh`; None for a single device.
    """

    threads: int = 1
    mesh: Mesh | None = None

    @property
    def number(self) -> int:
        """Number of workers."""
        return self.threads if self.mesh is None else self.mesh.size


ALONE = Workers()


def start(number: int | None) -> Workers:
    """Begins a command: sets the precision of products for the whole process, selects its devices.

    Args:
      number: of accelerators, at least one of each process, or of threads on a CPU. By default all
        accelerators, or as many threads as cores, at most 8; see `threads` for when fewer are used.

    Returns:
      The workers that share scenes and missions. A training stays on one device.

    Raises:
      ConfigError: if there are fewer devices, none of the platform that `JAX_PLATFORMS` names, or
        a process would have none.
    """
    jax.config.update("jax_default_matmul_precision", "highest")
    try:
        is_cpu = jax.default_backend() == "cpu"
    except (AssertionError, RuntimeError) as error:
        reason = f"must name devices of this machine ({str(error) or 'its plugin is missing'})"
        raise ConfigError("JAX_PLATFORMS", jax.config.values["jax_platforms"], reason) from None
    if is_cpu and jax.process_count() == 1:
        return Workers(threads=threads(number or NUM_THREADS))
    owners = [device.process_index for device in jax.devices()]
    least, there = 1 + owners.index(max(owners)), len(owners)
    number = number or there
    if not least <= number <= there:
        # All processes refuse; one that ends without the others makes them abort.
        leave(LEAVE_TIMEOUT)
        raise ConfigError("devices", number, f"must be from {least} to {there}")
    return Workers(mesh=make_mesh(number) if number > 1 else None)


def threads(wanted: int = NUM_THREADS) -> int:
    """How many of the `wanted` programs may run side by side on a CPU: fewer than XLA's threads.

    One of these splits a large batch of Cholesky decompositions, as in the physics of six robots,
    among all and waits for the others. If every one did so, all would wait forever. XLA reads their
    number from `NPROC` when it creates the backend; its default is the number of cores.
    """
    given = os.environ.get("NPROC", "")
    return min(wanted, max(1, (int(given) if given.isdecimal() else cores()) - 1))


def memory() -> int | None:
    """Bytes that each accelerator may hold, few if it does not tell; None for a CPU."""
    if jax.default_backend() == "cpu":
        return None
    told = [device.memory_stats() or {} for device in jax.local_devices()]
    return min(each.get("bytes_limit", _LEAST_MEMORY) for each in told)


def make_mesh(number: int | None = None) -> Mesh:
    """A row of the first devices of all processes, by default of all, with the axis `AXIS`."""
    return Mesh(np.array(jax.devices()[:number]), (AXIS,))


def places(mesh: Mesh, number: int, whole: int = 0) -> tuple[NamedSharding, ...]:
    """Where arguments lie: the first `whole` ones on each device, rows of the others divided."""
    undivided, divided = PartitionSpec(), PartitionSpec(AXIS)
    return tuple(NamedSharding(mesh, undivided if i < whole else divided) for i in range(number))


def share(
    shapes: tuple[PyTree, ...], mesh: Mesh | None, whole: int = 0
) -> tuple[PyTree[jax.ShapeDtypeStruct], ...]:
    """What each device gets of arguments of such shapes; see `places`."""
    if mesh is None:
        return shapes
    rows = lambda x: x.update(shape=(x.shape[0] // mesh.size, *x.shape[1:]))  # noqa: E731
    return *shapes[:whole], *jax.tree.map(rows, shapes[whole:])


def put(values: PyTree, place: NamedSharding) -> PyTree[jax.Array]:
    """Distributes values that every process has over the devices of all processes."""

    def put_one(x: jax.Array) -> jax.Array:
        if jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put_one(jax.random.key_data(x)))
        if isinstance(x, jax.Array) and x.sharding == place:
            return x
        local = np.asarray(x, jnp.result_type(x))
        return jax.make_array_from_callback(local.shape, place, lambda index: local[index])

    return jax.tree.map(put_one, values)


def fetched(values: PyTree[jax.Array]) -> PyTree[np.ndarray]:
    """Values of all devices on the host, in every process."""
    if jax.process_count() > 1:
        return multihost_utils.process_allgather(values, tiled=True)
    return jax.device_get(values)


def spread(
    function: Callable[..., PyTree], mesh: Mesh, number: int, whole: int = 0
) -> Callable[..., PyTree]:
    """Calls a function on each device with a part of its rows, independent of the other devices.

    Args:
      function: of pytrees of arrays, whose first axis is a batch of independent rows. With MJX
        inside, it must be one that `kept.trace` returns: jaxlib 0.11.2 crashes while it
        compiles a step of MJX whose constants `shard_map` sees, on a CPU and on accelerators.
      mesh: from `make_mesh`; its size must divide the batch.
      number: of arguments.
      whole: number of arguments, the first ones, that every device gets undivided.

    Returns:
      The same function; call it under `jit`.
    """
    divided = PartitionSpec(AXIS)
    specs = tuple(place.spec for place in places(mesh, number, whole))
    # The rows of devices are different, which nobody needs to check.
    return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=divided, check_vma=False)


def side_by_side(
    function: Callable[[T], R],
    works: Sequence[T],
    threads: int,
    fail: Callable[[BaseException], None] = lambda error: None,
) -> list[R]:
    """Calls a function for each of some works, in several threads, to use all cores.

    Args:
      function: of one of them.
      threads: how many calls run at once.
      fail: asks the calls to end, when one has failed or Ctrl-C has been pressed.

    Returns:
      The results, in order.
    """
    if len(works) == 1:
        return [function(works[0])]
    with ThreadPoolExecutor(threads) as executor:
        futures = [executor.submit(function, each) for each in works]
        try:
            for each in as_completed(futures):
                each.result()
        except BaseException as error:
            fail(error)
            raise
        return [future.result() for future in futures]


def empty(shape: jax.ShapeDtypeStruct) -> np.ndarray:
    """An array without values that JAX can take over on a CPU, where it would copy others."""
    size = math.prod(shape.shape) * shape.dtype.itemsize
    memory = np.empty(size + _ALIGNED, np.uint8)
    first = -memory.ctypes.data % _ALIGNED
    return memory[first : first + size].view(shape.dtype).reshape(shape.shape)


def give_back_freed() -> None:
    """Gives the system back what compiler and surveys have freed, which glibc would keep."""
    # Other systems have no such function, or need none.
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


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
        missing = [f"--{name.replace('_', '-')}" for name, x in given.items() if x is None]
        for name in (name for name, x in given.items() if x is not None):
            raise ConfigError(name, given[name], f"also needs {' and '.join(missing)}")
        return
    host, _, port = coordinator.rpartition(":")
    if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
        reason = "must be HOST:PORT, with a port from 1 to 65535"
        raise ConfigError("coordinator", coordinator, reason)
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

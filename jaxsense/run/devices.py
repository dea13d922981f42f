"""Spreads work over the cores of a CPU, over accelerators, and over processes."""

import dataclasses
import functools
import os
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsense.config import ConfigError

T = TypeVar("T")

AXIS = "devices"
NUM_THREADS = min(os.cpu_count() or 1, 8)
_MOST_DEVICES = 256


def compiler_options(*, runs_long: bool = False) -> dict[str, Any]:
    """Compiler options that minimise the time to compile and run a program.

    On a CPU, level 1 compiles a third faster than level 3, and its programs are as fast. The older
    code generator saves another third, but the program may run a third slower. On an accelerator,
    autotuning of matrix products would take most of the time.

    Args:
      runs_long: the program runs far longer than it compiles.

    Returns:
      The options that the installed compiler knows; none if JAX is set to compile quickly.
    """
    if jax.config.values["jax_disable_most_optimizations"]:
        return {}
    wanted: dict[str, Any] = {}
    if jax.default_backend() == "cpu":
        wanted = {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": runs_long}
    elif jax.default_backend() == "gpu" and not runs_long:
        wanted = {"xla_backend_optimization_level": 1, "xla_gpu_autotune_level": 0}
    return {name: value for name, value in wanted.items() if _is_known(name, value)}


@functools.cache
def _is_known(option: str, value: Any) -> bool:
    """Whether the installed compiler has an option; options change with its version."""
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options={option: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True


@dataclasses.dataclass(frozen=True)
class Workers:
    """What shares the rows of a batch: threads of a CPU, or the devices of a mesh.

    Attributes:
      threads: how many, each with its own call of a program; 1 with a mesh.
      mesh: from `make_mesh`; None for a single device.
    """

    threads: int = 1
    mesh: Mesh | None = None

    @property
    def number(self) -> int:
        """Number of parts of a batch."""
        return self.threads if self.mesh is None else self.mesh.size


ALONE = Workers()


def start(number: int | None) -> Workers:
    """Selects the devices of a program.

    Args:
      number: of accelerators, or of threads on a CPU. By default all accelerators, or as many
        threads as cores, at most 8.

    Returns:
      The workers that share scenes and missions. A training stays on one device, as exchanging
      gradients takes longer than computing them.

    Raises:
      ConfigError: if there are fewer devices.
    """
    jax.config.update("jax_default_matmul_precision", "highest")
    if number is not None and not 1 <= number <= _MOST_DEVICES:
        raise ConfigError("devices", number, f"must be within 1 and {_MOST_DEVICES}")
    _make_room(number or NUM_THREADS)
    if jax.default_backend() == "cpu" and jax.process_count() == 1:
        return Workers(threads=number or NUM_THREADS)
    there = jax.device_count()
    number = there if number is None else number
    if number > there:
        raise ConfigError("devices", number, f"must be within 1 and {there}")
    return Workers(mesh=make_mesh(number) if number > 1 else None)


def _make_room(threads: int) -> None:
    """Makes XLA's pool of threads larger than the number of programs side by side.

    A large batch of Cholesky decompositions, as in the physics of six robots, is shared out to the
    pool by a member of the pool, which waits for the others. If every member does, all wait for
    ever. XLA reads the size when it makes the backend; by itself it takes the number of cores.
    """
    cores = len(os.sched_getaffinity(0))  # a process may be held to some of them
    os.environ.setdefault("NPROC", str(max(2 * threads, cores)))


def make_mesh(number: int | None = None) -> Mesh:
    """A row of devices.

    Args:
      number: how many, over all processes; all by default.

    Returns:
      The mesh, with the axis `AXIS`.

    Raises:
      ValueError: if there are fewer devices.
    """
    there = jax.devices()
    number = len(there) if number is None else number
    if not 1 <= number <= len(there):
        raise ValueError(
            f"devices = {number}: must be within 1 and {len(there)}, the number of devices"
        )
    return Mesh(np.array(there[:number]), (AXIS,))


def join(
    coordinator: str | None,
    number: int | None,
    index: int | None,
    begins: Callable[[], None] = lambda: None,
) -> None:
    """Joins the processes that share a run; does nothing without arguments.

    Args:
      coordinator: `HOST:PORT` at which the first process listens.
      number: of processes.
      index: of this process, from 0.
      begins: called once the arguments are found to be right, before it waits for the others.

    Raises:
      ConfigError: if only some are given, or a value is wrong.
    """
    given = {"coordinator": coordinator, "num_processes": number, "process_index": index}
    if set(given.values()) == {None}:
        return
    for name, value in given.items():
        if value is None:
            others = " and ".join(other for other, x in given.items() if x is not None)
            raise ConfigError(name, value, f"must be given with {others}")
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
        raise ConfigError("process_index", index, f"must be within 0 and {number - 1}")
    try:
        socket.getaddrinfo(host.strip("[]"), int(port))
    except OSError as error:
        raise ConfigError("coordinator", coordinator, f"cannot be found ({error})") from None
    begins()
    try:
        jax.distributed.initialize(coordinator, number, index)
    except (RuntimeError, ValueError) as error:
        reason = f"cannot be joined ({str(error).splitlines()[0]})"
        raise ConfigError("coordinator", coordinator, reason) from None


def of_first_process(values: np.ndarray) -> np.ndarray:
    """The first process's values, in all processes; blocks until all have called it."""
    return np.asarray(multihost_utils.broadcast_one_to_all(values))


def leave(timeout: float | None = None) -> None:
    """Waits for the other processes of the run, if any, and disconnects.

    Args:
      timeout: seconds to wait for processes that may not end; without it, as long as they need.
    """
    if jax.process_count() > 1:
        waiting = threading.Thread(target=jax.distributed.shutdown, daemon=True)
        waiting.start()
        waiting.join(timeout)


def shardings(mesh: Mesh, number: int, whole: tuple[int, ...]) -> tuple[NamedSharding, ...]:
    """Places of arguments: a part of their rows on each device, or all rows if in `whole`."""
    return tuple(
        NamedSharding(mesh, PartitionSpec() if i in whole else PartitionSpec(AXIS))
        for i in range(number)
    )


def put(args: tuple[Any, ...], places: tuple[NamedSharding, ...]) -> tuple[Any, ...]:
    """Distributes arguments that every process has over the devices of all processes."""

    def put_one(x: Any, place: NamedSharding) -> jax.Array:
        if jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key):
            return jax.random.wrap_key_data(put_one(jax.random.key_data(x), place))
        x = np.asarray(x, jnp.result_type(x))
        return jax.make_array_from_callback(x.shape, place, lambda index: x[index])

    return tuple(
        jax.tree.map(lambda x: put_one(x, place), arg)  # noqa: B023
        for arg, place in zip(args, places, strict=True)
    )


def spread(
    function: Callable[..., Any], mesh: Mesh | None, whole: tuple[int, ...] = ()
) -> Callable[..., Any]:
    """Splits a function's inputs and outputs along their first axis, a part on each device.

    XLA's partitioner finds the split. Under `shard_map`, jaxlib 0.11.2 crashes while it compiles a
    step of MJX, on a CPU and on accelerators: its Shardy drops inputs that the body does not use
    (`ManualComputationUnusedInputsPattern`), and MJX closes over a hundred constants.

    Args:
      function: of arrays, or pytrees of them, with a batch of independent rows as first axis.
      mesh: from `make_mesh`; its size must divide the batch. Without one nothing is split.
      whole: positions of arguments that every device gets undivided.

    Returns:
      The same function; call it under `jit`.
    """
    if mesh is None:
        return function

    def partitioned(*args: Any) -> Any:
        rows = NamedSharding(mesh, PartitionSpec(AXIS))
        constrain = jax.lax.with_sharding_constraint
        args = tuple(x if i in whole else constrain(x, rows) for i, x in enumerate(args))
        return constrain(function(*args), rows)

    return partitioned


def side_by_side(function: Callable[[int], T], number: int) -> list[T]:
    """Calls `function(0)`, `function(1)` and so on, each in a thread to use all cores."""
    if number == 1:
        return [function(0)]
    with ThreadPoolExecutor(number) as executor:
        futures = [executor.submit(function, i) for i in range(number)]
        # A wait without timeout may not notice Ctrl-C.
        while wait(futures, timeout=0.2).not_done:
            pass
        return [future.result() for future in futures]


def part(
    args: tuple[Any, ...], i: int, number: int, whole: tuple[int, ...] = ()
) -> tuple[Any, ...]:
    """The i-th of `number` equal parts of arguments, along their first axis.

    Args:
      args: arrays, their shapes, or pytrees of them; `number` divides their first axis.
      i: which part.
      number: of parts.
      whole: positions of arguments that every part gets undivided.
    """
    if number == 1:
        return args

    def cut(x: Any) -> Any:
        rows = x.shape[0] // number
        if isinstance(x, jax.ShapeDtypeStruct):
            return x.update(shape=(rows, *x.shape[1:]))
        return x[i * rows : (i + 1) * rows]

    return tuple(x if j in whole else jax.tree.map(cut, x) for j, x in enumerate(args))


def of_all_parts(shapes: Any, number: int) -> Any:
    """The shapes of the joined results of `number` parts, from those of one."""
    if number == 1:
        return shapes
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((number * x.shape[0], *x.shape[1:]), x.dtype), shapes
    )


def joined(parts: list[Any]) -> Any:
    """Joins the results of parts, on the host if there are several."""
    if len(parts) == 1:
        return parts[0]
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(each) for each in x]), *parts)

"""Work spread over several devices: the cores of a CPU, several accelerators, several processes."""

import contextlib
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxsense.config import ConfigError, DqnConfig

AXIS = "devices"
_MOST_THREADS = 8
_MOST_DEVICES = 256


def compiler_options(*, runs_long: bool = False) -> Any:
    """What a program is compiled with: so that compiling and running take least together.

    On a CPU, optimisation at level 1 takes a third less time than at level 3, and what it gives is
    as fast. Without the newer code generator it is again a third less, but what it gives may be a
    third slower. On an accelerator most of the time would go into trying kernels for products.

    Args:
      runs_long: far longer than it takes to compile.
    """
    if jax.default_backend() == "cpu":
        return {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": runs_long}
    if runs_long or jax.default_backend() != "gpu":
        return {}
    return {"xla_backend_optimization_level": 1, "xla_gpu_autotune_level": 0}


def start(number: int | None, config: DqnConfig | None = None) -> tuple[Mesh | None, Mesh | None]:
    """The devices of a program; which should be called before JAX is used.

    Args:
      number: of devices; on a CPU each is a thread. If not given, all accelerators there are, or as
        many threads as there are cores, but no more than can share the environments evenly.
      config: of the Q-learning that is to be shared, if any.

    Returns:
      Devices to split simulations over and to split Q-learning over; None for a single one. Unless
      asked to, threads do not share Q-learning: to agree on a gradient takes them longer than to
      work it out.

    Raises:
      ConfigError: if there are not that many devices, or they cannot share the environments.
    """
    jax.config.update("jax_default_matmul_precision", "highest")
    if number is not None and not 1 <= number <= _MOST_DEVICES:
        raise ConfigError("devices", number, f"must be within 1 and {_MOST_DEVICES}")
    threads = min(os.cpu_count() or 1, _MOST_THREADS) if number is None else max(number, 1)
    # Where JAX is in use already, its devices are what they are.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", threads)
    is_chosen = number is not None or jax.default_backend() != "cpu"
    there = jax.device_count()
    if number is None:
        can_share = (n for n in range(1, there + 1) if config is None or config.shares % n == 0)
        number = max(can_share)
    if not 1 <= number <= there:
        raise ConfigError("devices", number, f"must be within 1 and {there}")
    if config is not None and config.shares % number:
        raise ConfigError(
            "devices",
            number,
            f"must divide {config.shares}, the shares that dqn.num_envs = {config.num_envs} and "
            f"dqn.batch = {config.batch} can be cut into",
        )
    mesh = make_mesh(number) if number > 1 else None
    return mesh, mesh if is_chosen else None


def make_mesh(number: int | None = None) -> Mesh:
    """A row of devices.

    Args:
      number: how many; all there are if not given. Devices of all processes count.

    Returns:
      The mesh, with the axis `AXIS`.

    Raises:
      ValueError: if there are not that many devices.
    """
    there = jax.devices()
    number = len(there) if number is None else number
    if not 1 <= number <= len(there):
        raise ValueError(
            f"devices = {number}: must be within 1 and {len(there)}, as many there are"
        )
    return Mesh(np.array(there[:number]), (AXIS,))


def spread(
    function: Callable[..., Any], mesh: Mesh | None, whole: tuple[int, ...] = ()
) -> Callable[..., Any]:
    """A function whose inputs and outputs are split along their first axis, a part on each device.

    Args:
      function: of arrays, or pytrees of them, with a batch as first axis; rows must not depend on
        one another.
      mesh: from `make_mesh`; its size must divide the batch. Without one nothing is split.
      whole: positions of arguments that every device gets as they are.

    Returns:
      The same function, to be called under `jit`.
    """
    if mesh is None:
        return function

    def split(*args: Any) -> Any:
        specs = tuple(
            PartitionSpec() if i in whole else PartitionSpec(AXIS) for i in range(len(args))
        )
        # What varies over the mesh is not checked: MJX builds constants inside its loops.
        return jax.shard_map(
            function, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(AXIS), check_vma=False
        )(*args)

    def partition(*args: Any) -> Any:
        rows = NamedSharding(mesh, PartitionSpec(AXIS))
        constrain = jax.lax.with_sharding_constraint
        args = tuple(x if i in whole else constrain(x, rows) for i, x in enumerate(args))
        return constrain(function(*args), rows)

    # For accelerators XLA's compiler crashes on a step of MJX under `shard_map` (jaxlib 0.11.2);
    # its partitioner finds the same split. On a CPU that would make threads wait for one another.
    return split if jax.default_backend() == "cpu" else partition

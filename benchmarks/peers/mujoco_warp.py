"""MJX and its rays on Warp, which compiles kernels for a CUDA device."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np
import warp  # pyright: ignore[reportMissingImports]
from mujoco import mjx
from mujoco.mjx.third_party import mujoco_warp

from jaxsense.sim.arena import Arena

if jax.default_backend() != "gpu":
    # Warp has a CPU mode too, in which one thread runs everything.
    raise RuntimeError("needs a CUDA device")

# Room for each simulation: two robots touch fewer things.
_CONTACTS, _CONSTRAINTS = 8, 16
_VISIBLE_GROUP = 0  # no wheels, casters and collision shapes


def arenas(arena: Arena, batch: int) -> list[Arena]:
    """The same arena with MJX on Warp, for each of its ways to launch kernels.

    Args:
      arena: the arena.
      batch: number of simulations side by side; their contacts share one list.
    """
    data = mjx.make_data(
        arena.mj_model, impl="warp", naconmax=_CONTACTS * batch, njmax=_CONSTRAINTS
    )
    # As a part of XLA's command buffers, the third way, a step within a loop fails on an H100.
    modes = (warp.JaxCallableGraphMode.WARP, warp.JaxCallableGraphMode.NONE)
    models = (mjx.put_model(arena.mj_model, impl="warp", graph_mode=mode) for mode in modes)
    return [dataclasses.replace(arena, model=model, data=data) for model in models]


def cast(
    mj_model: "mujoco.MjModel",  # pyright: ignore[reportAttributeAccessIssue]
    *,
    geom_xpos: np.ndarray,
    geom_xmat: np.ndarray,
    origins: np.ndarray,
    directions: np.ndarray,
    robot_bodies: np.ndarray,
    has_tree: bool,
) -> Callable[[], tuple[Any, Any]]:
    """A call that casts R rays in each of B scenes by `mujoco_warp.rays`.

    Args:
      mj_model: the model.
      geom_xpos: `[B, G, 3]` centres of the geoms, in metres.
      geom_xmat: `[B, G, 3, 3]` their rotations.
      origins: `[B, R, 3]` in metres.
      directions: `[B, R, 3]` unit vectors.
      robot_bodies: `[R]` ids of the bodies that are not seen.
      has_tree: whether to search a tree of bounding volumes instead of testing all geoms. Every
        call fits the tree to the scenes first, as a simulation must after each step.

    Returns:
      The call. It finds normals too, and returns Warp's arrays of `[B, R]` distances, -1 for none,
      and `[B, R]` geom ids.
    """
    batch, number = origins.shape[:2]
    model = mujoco_warp.put_model(mj_model)
    data = mujoco_warp.make_data(mj_model, nworld=batch, naconmax=1, njmax=1)
    data.geom_xpos = warp.array(geom_xpos, dtype=warp.vec3)
    data.geom_xmat = warp.array(geom_xmat, dtype=warp.mat33)
    starts = warp.array(origins, dtype=warp.vec3)
    along = warp.array(directions, dtype=warp.vec3)
    bodies = warp.array(robot_bodies, dtype=int)
    distance = warp.empty((batch, number), dtype=float)
    geom = warp.empty((batch, number), dtype=int)
    normal = warp.empty((batch, number), dtype=warp.vec3)
    groups = warp.types.vector(6, float)(*np.eye(6)[_VISIBLE_GROUP])
    tree = None
    if has_tree:
        tree = mujoco_warp.create_render_context(
            mj_model, nworld=batch, enabled_geom_groups=[_VISIBLE_GROUP], cam_active=[]
        )
    # Of geoms that do not move, such as walls, too.
    inputs = model, data, starts, along, groups, True, bodies

    def run() -> tuple[Any, Any]:
        if tree is not None:
            mujoco_warp.refit_bvh(model, data, tree)
        mujoco_warp.rays(*inputs, distance, geom, normal, tree)
        warp.synchronize()
        return distance, geom

    return run

"""C MuJoCo: batches of trajectories and rays."""

import concurrent.futures
import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch
from mujoco import rollout as mujoco_rollout


@dataclasses.dataclass(frozen=True)
class RolloutInputs:
    """B trajectories of T steps.

    Attributes:
      qpos: `[B, nq]`.
      qvel: `[B, nv]`.
      warmstart: `[B, nv]`.
      control: `[B, T, nu]`.
      mocap_pos: `[B, 3 nmocap]`, constant over a trajectory.
      mocap_quat: `[B, 4 nmocap]`.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    warmstart: np.ndarray
    control: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray


def rollout(
    model: "mujoco.MjModel",  # pyright: ignore[reportAttributeAccessIssue]
    inputs: RolloutInputs,
    threads: int,
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """A call that rolls all trajectories out, on a pool of threads that is kept between calls.

    Everything is allocated and checked before. The call returns the last `[B, nq]` positions and
    `[B, nv]` velocities.
    """
    batch, steps = inputs.control.shape[:2]
    kinds = mujoco.mjtState  # pyright: ignore[reportAttributeAccessIssue]
    # What is not in the control vector is reset at every step, so the PoIs are in it.
    spec = kinds.mjSTATE_CTRL | kinds.mjSTATE_MOCAP_POS | kinds.mjSTATE_MOCAP_QUAT
    constant = np.concatenate([inputs.mocap_pos, inputs.mocap_quat], axis=-1)
    constant = np.broadcast_to(constant[:, None], (batch, steps, constant.shape[-1]))
    control = np.concatenate([inputs.control, constant], axis=-1).astype(np.float64)
    start = np.concatenate([np.zeros((batch, 1)), inputs.qpos, inputs.qvel], axis=-1)
    warmstart = inputs.warmstart.astype(np.float64)
    state = np.empty((batch, steps, start.shape[-1]))
    sensors = np.empty((batch, steps, model.nsensordata))
    data = [mujoco.MjData(model) for _ in range(threads)]  # pyright: ignore[reportAttributeAccessIssue]
    pool = mujoco_rollout.Rollout(nthread=threads)
    models = [model] * batch

    def run() -> tuple[np.ndarray, np.ndarray]:
        pool.rollout(
            models,
            data,
            start,
            control,
            control_spec=int(spec),
            skip_checks=True,
            nstep=steps,
            initial_warmstart=warmstart,
            state=state,
            sensordata=sensors,
        )
        last = state[:, -1]
        return last[:, 1 : 1 + model.nq], last[:, 1 + model.nq :]

    return run


def batch(
    model: "mujoco.MjModel",  # pyright: ignore[reportAttributeAccessIssue]
    inputs: RolloutInputs,
    threads: int,
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """A call that makes the same steps with `mujoco.batch`, one step of all trajectories at a time.

    A call of several steps would hold the control constant. The call returns the last `[B, nq]`
    positions and `[B, nv]` velocities.
    """
    size, steps = inputs.control.shape[:2]
    simulations = mujoco_batch.Batch(model, nsim=size, nthread=threads)
    start = {
        "qpos": inputs.qpos,
        "qvel": inputs.qvel,
        "qacc_warmstart": inputs.warmstart,
        "mocap_pos": inputs.mocap_pos.reshape(size, model.nmocap, 3),
        "mocap_quat": inputs.mocap_quat.reshape(size, model.nmocap, 4),
    }
    controls = np.ascontiguousarray(inputs.control.swapaxes(0, 1), np.float64)
    control, qpos, qvel = (simulations.bind(name) for name in ("ctrl", "qpos", "qvel"))

    def run() -> tuple[np.ndarray, np.ndarray]:
        for name, values in start.items():
            simulations.bind(name)[:] = values
        for step in range(steps):
            control[:] = controls[step]
            simulations.step()
        return qpos.copy(), qvel.copy()

    return run


@dataclasses.dataclass(frozen=True)
class Scan:
    """The rays of one sensor in one scene.

    Attributes:
      data: state of the scene, after kinematics.
      origin: `[3]` in metres.
      directions: `[B, 3]` unit vectors.
      robot_body: id of the body that is not seen.
    """

    data: "mujoco.MjData"  # pyright: ignore[reportAttributeAccessIssue]
    origin: np.ndarray
    directions: np.ndarray
    robot_body: int


def cast(
    model: "mujoco.MjModel",  # pyright: ignore[reportAttributeAccessIssue]
    scans: list[Scan],
    threads: int,
) -> Callable[[], list[tuple[np.ndarray, np.ndarray]]]:
    """A call that casts all rays by `mj_multiRay`, with the scans dealt out to threads.

    The call finds normals too, and returns, for each scan, the `[B]` distances, -1 for none, and
    `[B]` geom ids.
    """
    # Only what the sensors see: no wheels, casters and collision shapes.
    groups = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    flat = [np.ascontiguousarray(scan.directions, np.float64).reshape(-1) for scan in scans]
    outputs = [
        (np.empty(len(scan.directions)), np.empty(len(scan.directions), np.int32)) for scan in scans
    ]
    normals = [np.empty(3 * len(scan.directions)) for scan in scans]
    pool = concurrent.futures.ThreadPoolExecutor(threads)
    cutoff = mujoco.mjMAXVAL  # pyright: ignore[reportAttributeAccessIssue]

    def some(first: int) -> None:
        for i in range(first, len(scans), threads):
            scan, (distance, geom) = scans[i], outputs[i]
            mujoco.mj_multiRay(  # pyright: ignore[reportAttributeAccessIssue]
                model,
                scan.data,
                scan.origin,
                flat[i],
                groups,
                1,
                scan.robot_body,
                geom,
                distance,
                normals[i],
                len(distance),
                cutoff,
            )

    def run() -> list[tuple[np.ndarray, np.ndarray]]:
        list(pool.map(some, range(threads)))
        return outputs

    return run

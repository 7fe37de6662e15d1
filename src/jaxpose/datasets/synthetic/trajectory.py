"""What moves the camera through the room: a made-up hand, or the recorded motion of a real machine."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.datasets.ground_truth import poses_at
from jaxpose.datasets.rgbd import euroc
from jaxpose.datasets.rgbd.euroc_files import read_camera_sheet, sensors
from jaxpose.datasets.synthetic import hand_held
from jaxpose.datasets.synthetic.furniture import SIZE, Extent
from jaxpose.errors import DataError
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid
from jaxpose.imu import GRAVITY_WORLD, Imu, ImuNoise
from jaxpose.imu.simulation import simulate

# The camera looks along the body's x, turned by some degrees and a few centimetres away.
_LEVER_ARM = (0.045, 0.02, -0.03)
_MOUNTING = (0.02, -0.035, 0.015)  # rotation vector [rad]
# cam0 of EuRoC's rig looks along the body's z (its sensor.yaml, to 0.1 mm and 0.01 degrees).
_EUROC_CAM0 = ((0.0149, -0.9999, 0.0041), (0.9996, 0.0150, 0.0257), (-0.0258, 0.0038, 0.9997))
_EUROC_LEVER_ARM = (-0.0216, -0.0647, 0.0098)
_AROUND, _ABOVE = 1.5, 1.2  # [m] free beside and over a recorded motion


Course = Callable[[hand_held.HandHeldMotion, Float[Array, ""]], Float[Array, "4 4"]]  # T_world_body at t [s]


class Motion(NamedTuple):
    """A motion and its readings; the room is of a size that holds it."""

    name: str
    t: Float[np.ndarray, " n"]  # [s] of the frames, from 0
    T_world_body: Float[np.ndarray, "n 4 4"]
    imu: Imu  # on the clock of `t`
    T_body_cam: Float[np.ndarray, "4 4"]
    room: Extent
    pose: Callable[[Float[np.ndarray, " m"]], Float[np.ndarray, "m 4 4"]]  # T_world_body at times [s]
    notes: tuple[str, ...] = ()


def by_hand(
    walk: hand_held.HandHeldMotion,
    t: Float[np.ndarray, " n"],
    imu_rate_hz: float,
    noise: ImuNoise,
    gravity_world: tuple[float, float, float] = GRAVITY_WORLD,
    course: Course = hand_held.pose,
    *,
    seed: int,
) -> Motion:
    """A walk along a course, and its exact derivatives as readings up to the last frame."""
    samples = int(np.ceil(t[-1] * imu_rate_hz - 1e-9)) + 1
    with jax.enable_x64(True):
        times = jnp.asarray(t), jnp.asarray(np.arange(samples) / imu_rate_hz)
        T_world_body, imu = _readings(walk, *times, jax.random.key(seed), noise, gravity_world, course)
        T_world_body, imu = np.asarray(T_world_body), Imu(*(np.array(x) for x in imu))
    # From right, down, forwards to forwards, left, up, not quite.
    turn = rigid.so3_exp(np.array(_MOUNTING)) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]

    def pose(times):
        with jax.enable_x64(True):
            return np.asarray(_poses(walk, jnp.asarray(times), course))

    return Motion("room", t, T_world_body, imu, rigid.make(turn, np.array(_LEVER_ARM)), SIZE, pose)


@partial(jax.jit, static_argnames="course")
def _poses(walk, times, course):
    return jax.vmap(partial(course, walk))(times)


@partial(jax.jit, static_argnames=("noise", "gravity_world", "course"))
def _readings(walk, frame_times, imu_times, key, noise, gravity_world, course):
    pose = partial(course, walk)
    imu = simulate(pose, imu_times, noise=noise, key=key, gravity_world=gravity_world)
    return jax.vmap(pose)(frame_times), imu


def recorded(folder: Path | str, duration_s: float, rate_hz: float) -> Motion:
    """The motion and the readings, as recorded, of a EuRoC sequence (`imu0`, `state_groundtruth_estimate0`).

    From the first time that both know on; moved along the floor to the room's middle. The camera sits where
    `cam0/sensor.yaml` says, or EuRoC's own without one. Errors as `euroc.load_imu` and `load_truth`;
    DataError where they have no two frames in common, or the motion goes below the floor.
    """
    folder = Path(folder)
    t0_ns, first = euroc.common_start(folder)
    imu, ground_truth = euroc.load_imu(folder, t0_ns).imu, euroc.load_truth(folder, t0_ns)
    last = min(imu.t[-1], ground_truth.t[-1])
    t = np.arange(int(np.floor(min(duration_s, last) * rate_hz + 1e-9)) + 1) / rate_hz
    if len(t) < 2:
        raise DataError(
            f"{folder}: expected two frames at {rate_hz:g} Hz within IMU and ground truth, got {len(t)}"
        )
    path = Trajectory(ground_truth.t, ground_truth.T_world_body)
    T_world_body = poses_at(path, t)
    if np.isnan(T_world_body).any():
        raise DataError(f"{folder}: expected ground truth without gaps above 0.1 s, found one")
    lower, upper = (f(T_world_body[:, :3, 3], axis=0) for f in (np.min, np.max))
    if lower[2] < 0.05:
        raise DataError(f"{folder}: expected a motion above the floor (z = 0), got z = {lower[2]:.2f} m")
    middle = np.append((lower + upper)[:2] / 2, 0.0)
    T_world_body[:, :3, 3] -= middle
    wide, deep = upper[:2] - lower[:2] + 2 * _AROUND
    room = float(max(wide, SIZE[0])), float(max(deep, SIZE[1])), float(max(upper[2] + _ABOVE, SIZE[2]))
    name = folder.resolve().parent.name if folder.resolve().name == "mav0" else folder.resolve().name
    sheet = sensors(folder) / "cam0" / "sensor.yaml"
    own = rigid.make(rigid.nearest_rotation(np.array(_EUROC_CAM0)), np.array(_EUROC_LEVER_ARM))
    extent = " x ".join(f"{side:.1f}" for side in room)
    what = (
        f"motion and IMU readings are those of {name}, {t[-1]:.1f} s from {first:.2f} s on; all images are "
        f"rendered, in a made-up room of {extent} m"
    )
    return Motion(
        f"rendered room along {name}",
        t,
        T_world_body,
        imu,
        read_camera_sheet(sheet)[1] if sheet.exists() else own,
        room,
        lambda times: rigid.make(np.eye(3), -middle) @ poses_at(path, np.minimum(times, last)),
        (what,),
    )

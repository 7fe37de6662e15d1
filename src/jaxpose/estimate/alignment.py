"""Where an estimate starts: time offset, mounting, scale and gravity, from poses and readings alone."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, integrate_gyro

_STEP_S = 0.005  # between the offsets that are tried


def gyro_orientation(imu: Imu) -> Slerp:
    """The orientation that the gyroscope's readings add up to, from the first on.

    Args:
        imu: readings (n,), float64.

    Returns:
        A function of times within the readings' (m,) [s].
    """
    with jax.enable_x64(True):
        R = integrate_gyro(jnp.eye(3), jnp.asarray(imu.t), jnp.asarray(imu.omega_body))
    return Slerp(np.asarray(imu.t), Rotation.from_matrix(np.asarray(R)))


def rotation_alignment(
    t: Float[np.ndarray, " n"],
    R_world_cam: Float[np.ndarray, "n 3 3"],
    turned: Slerp,
    reach_s: float,
    R_body_cam: Float[np.ndarray, "3 3"] | None = None,
) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Time offset and mounting at which poses and gyroscope turn alike from pose to pose.

    Between neighbouring poses both give a rotation vector; the mounting turns one into the other and a
    constant bias adds to it, so that for a given offset both follow in closed form (Kabsch). The offset of
    least residual among those tried is taken.

    Args:
        t: times of the poses (n,) [s].
        R_world_cam: orientations (n, 3, 3).
        turned: `gyro_orientation` of the readings.
        reach_s: offsets from -reach_s to reach_s are tried; 0: only none.
        R_body_cam: the mounting where it is known.

    Returns:
        Offset [s], and `R_body_cam` (3, 3).

    Raises:
        DataError: where the readings overlap with fewer than four poses.
    """
    start, *_, end = np.asarray(turned.times)
    steps = int(np.ceil(reach_s / _STEP_S))
    seen = rigid.so3_log(np.swapaxes(R_world_cam[:-1], 1, 2) @ R_world_cam[1:])
    best = None
    for offset in _STEP_S * np.arange(-steps, steps + 1):
        at = t + offset
        inside = (at[:-1] >= start) & (at[1:] <= end)
        if inside.sum() < 3:
            continue
        R = turned(np.clip(at, start, end)).as_matrix()
        dt = np.diff(t)[inside, None]
        read = rigid.so3_log(np.swapaxes(R[:-1], 1, 2) @ R[1:])[inside] / dt
        rate = seen[inside] / dt
        about = lambda x: x - x.mean(0)
        turn = R_body_cam
        if turn is None:
            turn = rigid.nearest_rotation(about(read).T @ about(rate))
        bias = (read - rate @ turn.T).mean(0)
        left = float(np.mean((read - bias - rate @ turn.T) ** 2))
        if best is None or left < best[0]:
            best = left, offset, turn
    if best is None:
        raise DataError(
            f"IMU: expected readings between {t[0]:.3f} and {t[-1]:.3f} s (the poses), got them between "
            f"{start:.3f} and {end:.3f} s"
        )
    return float(best[1]), best[2]


def scale_and_gravity(
    t: Float[np.ndarray, " n"],
    T_world_cam: Float[np.ndarray, "n 4 4"],
    imu: Imu,
    turned: Slerp,
    R_body_cam: Float[np.ndarray, "3 3"],
    gravity_m_s2: float,
    *,
    scale: float | None,
) -> tuple[float, Float[np.ndarray, "3"]]:
    """Scale and gravity by how positions bend between neighbouring poses.

    Forces are turned into the world by the nearest pose's orientation and the gyroscope since; integrated
    twice over two neighbouring intervals they say how the path bends, which is linear in the scale and in
    gravity (after Martinelli 2014, without velocities). It starts an estimate, no more: noise of positions
    makes the scale somewhat small.

    Args:
        t: times of the poses [s] on the IMU's clock.
        T_world_cam: poses (n, 4, 4).
        imu: readings.
        turned: their `gyro_orientation`.
        R_body_cam: mounting.
        gravity_m_s2: size of gravity.
        scale: of the positions where it is known.

    Returns:
        The scale, and gravity (3,) in the world of the poses, of the given size.
    """
    times, force = _forces(t, T_world_cam[:, :3, :3] @ R_body_cam.T, imu, turned)
    step = np.gradient(times)
    # over a tent of two intervals, the mean of acceleration is the change of mean velocity
    rows, right = [], []
    for i in range(1, len(t) - 1):
        within = (times >= t[i - 1]) & (times < t[i + 1])
        if within.sum() < 4:
            continue
        before, after = t[i] - t[i - 1], t[i + 1] - t[i]
        x = times[within]
        tent = np.minimum((x - t[i - 1]) / before, (t[i + 1] - x) / after) * step[within]
        p = T_world_cam[i - 1 : i + 2, :3, 3]
        bend = (p[2] - p[1]) / after - (p[1] - p[0]) / before
        rows.append(np.concatenate([bend[:, None], -np.eye(3) * tent.sum()], axis=1))
        right.append(tent @ force[within])
    if len(rows) < 3:
        raise DataError(f"IMU: expected readings between at least 5 poses, got them between {len(rows) + 2}")
    A, b = np.concatenate(rows), np.concatenate(right)
    if scale is not None:
        A, b = A[:, 1:], b - scale * A[:, 0]
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    gravity = found[-3:] * gravity_m_s2 / np.linalg.norm(found[-3:])
    if scale is None:
        scale = float(found[0])
        if not scale > 0:
            raise DataError(
                f"scale: expected a motion whose size an accelerometer tells, got a scale of {scale:.3g}"
            )
    return scale, gravity


def _forces(
    t: Float[np.ndarray, " n"], R_world_body: Float[np.ndarray, "n 3 3"], imu: Imu, turned: Slerp
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
    """Specific forces in the world, turned by the pose before them and the gyroscope since."""
    inside = (imu.t >= t[0]) & (imu.t <= t[-1])
    times = np.asarray(imu.t)[inside]
    k = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    at_pose = turned(np.clip(t, imu.t[0], imu.t[-1])).as_matrix()
    since = np.swapaxes(at_pose[k], 1, 2) @ turned(times).as_matrix()
    return times, np.einsum("nij,njk,nk->ni", R_world_body[k], since, imu.acceleration_body[inside])

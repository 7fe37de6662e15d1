"""Inertial readings of a run: those that an interval needs, and all of them."""

import numpy as np

from jaxpose.imu import Imu
from jaxpose.slam.types import SlamState

_KEPT_S = 0.1  # of readings before the last frame, so that they can be interpolated there


def joined(state: SlamState, imu: Imu | None) -> Imu | None:
    """The readings that the next interval needs: the new ones behind those around the last frame.

    Args:
        state: the run so far.
        imu: readings since its last frame.

    Returns:
        Readings in order; None without any, or where none are used.
    """
    if imu is None or not state.config.uses_gyroscope:
        return state.imu
    new = Imu(*(np.asarray(x, np.float64) for x in imu))
    if state.imu is None:
        return new
    since = state.frames.t[-1] - _KEPT_S if state.frames.count else -np.inf
    kept = state.imu.t > since
    kept[-2:] = True  # however slow the sensor is
    later = new.t > state.imu.t[-1]
    return Imu(*(np.concatenate([old[kept], more[later]]) for old, more in zip(state.imu, new, strict=True)))


def readings_until(imu: Imu | None, before: float, t: float) -> Imu | None:
    """A recording's readings since a time, as a sensor would give them by another.

    Args:
        imu: all readings.
        before: [s] time of the last one that is known already.
        t: [s] time that they are to reach past, by one.

    Returns:
        Those between; None without an IMU.
    """
    if imu is None:
        return None
    times = np.asarray(imu.t)
    first, last = np.searchsorted(times, before, side="right"), np.searchsorted(times, t, side="left") + 1
    return Imu(*(np.asarray(x)[first:last] for x in imu))


def all_readings(came: tuple[Imu, ...]) -> Imu | None:
    """Readings that came in parts as one; of what was read before again, the first counts.

    Args:
        came: parts, in order.

    Returns:
        All of them; None without any.
    """
    if not came:
        return None
    t = np.concatenate([part.t for part in came])
    new = t > np.concatenate([[-np.inf], np.maximum.accumulate(t)[:-1]])
    omega, force = (np.concatenate([part[k] for part in came])[new] for k in (1, 2))
    return Imu(t[new], omega, force)

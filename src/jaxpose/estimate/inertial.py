"""Readings of an IMU as sufficient statistics of a spline: a few numbers a knot interval, whatever the rate.

Within a knot interval what a spline predicts is, to far below any sensor's noise, a polynomial in time of
degree `NODES` - 1 (`tests/estimate/test_inertial.py` measures it). A sum of squares over the readings of
three intervals is then one over its values at a dozen fixed places,

    sum_k |h(t_k) - z_k|^2 = |R h(nodes) - Q^T z|^2 + what no such function explains,   L = Q R,

with L the intervals' Lagrange polynomials at the readings' times. The first term is all that the solver works
on. Q is turned so that its columns go from slow to fast: what an IMU reads beside a smooth trajectory is
mostly vibration, so that slow residuals may be worth more than fast ones, and each has a level of its own.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.imu import Imu

NODES = 4  # a knot interval
BANDS = 3 * NODES  # residuals of three intervals, from slow to fast
# Chebyshev's places on [0, 1], where interpolation is within a small factor of the best there is
PLACES = (1 - np.cos((np.arange(NODES) + 0.5) * np.pi / NODES)) / 2


class NodeReadings(NamedTuple):
    """Readings of three knot intervals, reduced; gyroscope first, then accelerometer, in SI units."""

    root: Float[np.ndarray, "n m m"]  # R: what multiplies the predictions at the nodes
    value: Float[np.ndarray, "n m 6"]  # Q^T z: what they are compared with
    count: Int[np.ndarray, " n"]  # readings in the intervals
    unexplained: Float[np.ndarray, "n 6"]  # sum of squares that no function explains


def node_readings(imu: Imu, span: tuple[float, float], intervals: int) -> NodeReadings:
    """Reduce readings to the knot intervals that they fall in.

    Args:
        imu: readings, numpy, on the spline's clock [s]; those outside of the span are left out.
        span: of the spline [s].
        intervals: how many knot intervals it has, a multiple of three.

    Returns:
        The reduced readings, leading axis `intervals` / 3.
    """
    first, last = span
    t = np.asarray(imu.t, np.float64)
    z = np.concatenate([imu.omega_body, imu.acceleration_body], axis=1).astype(np.float64)
    inside = (t >= first) & (t <= last)
    place = (t[inside] - first) * (intervals / (last - first))
    index = np.clip(place.astype(int), 0, intervals - 1)
    three, groups = index // 3, intervals // 3
    count = np.bincount(three, minlength=groups)
    order = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)  # within the three
    size = max(int(count.max(initial=0)), BANDS)
    L, slow = np.zeros((2, groups, size, BANDS))
    values = np.zeros((groups, size, 6))
    columns = (index % 3)[:, None] * NODES + np.arange(NODES)
    L[three[:, None], order[:, None], columns] = lagrange(place - index)
    slow[three, order] = np.cos(np.pi * np.arange(BANDS) * ((place - 3 * three) / 3)[:, None])
    values[three, order] = z[inside]
    Q, R = np.linalg.qr(L)
    turn, _ = np.linalg.qr(np.swapaxes(Q, 1, 2) @ slow)
    Q, R = Q @ turn, np.swapaxes(turn, 1, 2) @ R
    value = np.swapaxes(Q, 1, 2) @ values
    left = (values**2).sum(1) - (value**2).sum(1)
    return NodeReadings(R, value, count, np.maximum(left, 0.0))


def lagrange(u: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n m"]:
    """The Lagrange polynomials of the nodes at places u of an interval."""
    differences = PLACES[:, None] - PLACES
    np.fill_diagonal(differences, 1)
    result = np.ones((len(u), NODES))
    for j in range(NODES):
        for k in range(NODES):
            if k != j:
                result[:, j] *= (u - PLACES[k]) / differences[j, k]
    return result


def white_noise(readings: NodeReadings) -> Float[np.ndarray, "2"]:
    """One sigma of a reading per axis [rad/s, m/s^2], by what no function explains; NaN of too few."""
    spare = np.maximum(readings.count - BANDS, 0).sum()
    per_axis = readings.unexplained[readings.count > BANDS].sum(0).reshape(2, 3).mean(1)
    return np.sqrt(per_axis / spare) if spare else np.full(2, np.nan)

"""What an estimate leaves: a continuous trajectory with its covariance, and sensors with theirs."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxpose.estimate import solver
from jaxpose.estimate.blocks import Covariance, Factorisation, solve_rows
from jaxpose.estimate.inertial import NodeReadings, white_noise
from jaxpose.estimate.system import (
    BIAS,
    BLOCK,
    GRAVITY,
    MOUNTING,
    OFFSET,
    SCALE,
    Noise,
    Problem,
    State,
    camera_rows,
)
from jaxpose.fields import Covariances, Params, PoseField, bspline
from jaxpose.fields._bspline import control_rows
from jaxpose.fields.types import Span
from jaxpose.geometry import rigid

_TABLE_HZ = 20.0  # of covariances in files
_TOGETHER = 256  # times that are asked in one call, so that one shape is compiled
_UNOBSERVED = 0.1  # share of what was known before


class Sensors(NamedTuple):
    """What is known of the sensors, one sigma each; the sigma of what was not estimated is 0."""

    offset_s: float  # t_imu = t_cam + offset
    offset_sigma_s: float
    T_body_cam: Float[np.ndarray, "4 4"]
    T_body_cam_sigma: Float[np.ndarray, "6"]  # [m, rad] of its increment on the right
    scale: float  # metres per unit of the measured positions
    scale_sigma: float  # relative
    gravity_world: Float[np.ndarray, "3"]  # [m/s^2]
    gravity_sigma: float  # [rad] of its direction, about the worse axis
    bias_t: Float[np.ndarray, " b"]  # [s] on the clock of the IMU; linear between
    gyro_bias: Float[np.ndarray, "b 3"]  # [rad/s]
    gyro_bias_sigma: Float[np.ndarray, "b 3"]
    accelerometer_bias: Float[np.ndarray, "b 3"]  # [m/s^2]
    accelerometer_bias_sigma: Float[np.ndarray, "b 3"]


class NoiseLevels(NamedTuple):
    """How noisy everything turned out to be."""

    gyro: float  # [rad/s] of a reading, by what no trajectory explains; NaN of too few readings
    accelerometer: float  # [m/s^2]
    gyro_bands: Float[np.ndarray, " m"]  # of a reading, in bands from slow to fast
    accelerometer_bands: Float[np.ndarray, " m"]
    position: float  # what the poses' stated sigmas are to be multiplied by
    rotation: float


class Posterior(NamedTuple):
    """A trajectory as it was most likely, and how sure that is.

    Times are those of the poses' clock. Covariances are of the increment `xi` of `T_world_cam exp(xi)`:
    [translation, rotation], metres and radians, along and about the camera's own axes, all that is uncertain
    about the sensors in them.
    """

    sensors: Sensors
    noise: NoiseLevels
    estimated: tuple[str, ...]
    clock_s: float  # of the spline's start, on the IMU's clock
    problem: Problem
    state: State
    known: Covariance
    factor: Factorisation

    @property
    def unobserved(self) -> tuple[str, ...]:
        """Which of the estimated quantities the motion says nothing of: their sigma is nearly what it was."""
        prior = np.asarray(self.problem.prior.border)
        left = np.sqrt(np.diag(self.known.corner)) / prior > _UNOBSERVED
        parts = {"gravity": GRAVITY, "offset": OFFSET, "extrinsics": MOUNTING, "scale": SCALE}
        return tuple(name for name, part in parts.items() if name in self.estimated and left[part].any())

    @property
    def span(self) -> Span:
        """First and last time that a pose was measured at."""
        t = np.asarray(self.problem.t) + self.clock_s
        return float(t[0]), float(t[-1])

    def pose(self, t: float | ArrayLike) -> Float[np.ndarray, "n 4 4"]:
        """Camera poses `T_world_cam`, float64.

        Args:
            t: times (n,) [s], or one.

        Raises:
            ValueError: times beyond the poses that were measured.
        """
        return self._rows(t)[0]

    def covariance(self, t: float | ArrayLike) -> Float[np.ndarray, "n 6 6"]:
        """Covariances of camera poses.

        Args:
            t: times (n,) [s], or one.

        Raises:
            ValueError: times beyond the poses that were measured.
        """
        _, J, pair = self._rows(t)
        with jax.enable_x64(True):
            P = np.asarray(solver.pair_covariance(self.known))
        return J @ P[pair] @ np.swapaxes(J, 1, 2)

    def relative_covariance(
        self, t_a: float | ArrayLike, t_b: float | ArrayLike
    ) -> Float[np.ndarray, "n 6 6"]:
        """Covariances of `T_a_b`, the later pose seen from the earlier, of its increment on the right.

        Args:
            t_a: times (n,) [s].
            t_b: times (n,) [s].

        Raises:
            ValueError: times beyond the poses that were measured.
        """
        T_a, J_a, pair_a = self._rows(t_a)
        T_b, J_b, pair_b = self._rows(t_b)
        carried = -rigid.adjoint(rigid.inverse(T_b) @ T_a) @ J_a
        with jax.enable_x64(True):
            return np.asarray(_joint(self.factor, carried, pair_a, J_b, pair_b))

    def covariances(self) -> Covariances:
        """Covariances of poses and of moves of one second, 20 times a second, as `fields.save` takes them."""
        t, early = table_times(self.span)
        second = self.relative_covariance(early, early + 1.0) if len(early) else np.zeros((0, 6, 6))
        return Covariances(t, self.covariance(t), second)

    def field(self) -> tuple[PoseField, Params]:
        """The camera's trajectory as a B-spline on the poses' clock, and its parameters.

        A spline's control poses carry what is mounted on the body: composed with `T_body_cam` they are those
        of the camera's spline.
        """
        intervals = len(self.state.control) - 3
        first = self.clock_s - self.sensors.offset_s
        last = first + float(self.problem.interval_s) * intervals
        control = np.asarray(self.state.control) @ self.sensors.T_body_cam
        return bspline((first, last), intervals), jnp.asarray(control_rows(control), jnp.zeros(()).dtype)

    def _rows(self, t: float | ArrayLike):
        t = np.atleast_1d(np.asarray(t, np.float64))
        first, last = self.span
        if t.ndim != 1 or not ((t >= first - 1e-9) & (t <= last + 1e-9)).all():
            raise ValueError(f"t: expected times (n,) [s] between {first:.6g} and {last:.6g}, got {t}")
        padded = np.resize(t, (max(-(-len(t) // _TOGETHER), 1), _TOGETHER))
        with jax.enable_x64(True):
            rows = [_camera_rows(self.problem, self.state, jnp.asarray(x - self.clock_s)) for x in padded]
        return tuple(np.concatenate(x)[: len(t)] for x in zip(*rows, strict=True))


def table_times(span: Span) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " k"]]:
    """Times [s] of a table of covariances over a span, and those of them that have a second after them."""
    first, last = span
    t = first + np.arange(int((last - first) * _TABLE_HZ) + 1) / _TABLE_HZ
    t = t if last - t[-1] < 1e-9 else np.append(t, last)
    return t, t[t + 1.0 <= last]


_camera_rows = jax.jit(camera_rows)


def posterior_calls(problem: Problem, noise: Noise, span: Span) -> list[tuple[Any, ...]]:
    """The compiled functions that a posterior asks, each with arguments of such shapes."""
    spread = lambda *x: solver.spread(solver.linearise(*x))[:2]
    factor, known = jax.eval_shape(spread, problem, problem.start, noise)
    times = jax.ShapeDtypeStruct((_TOGETHER,), np.float64)
    rows = jax.eval_shape(camera_rows, problem, problem.start, times)
    _, J, pair = (jax.ShapeDtypeStruct((len(table_times(span)[1]), *x.shape[1:]), x.dtype) for x in rows)
    return [
        (_camera_rows, problem, problem.start, times),
        (solver.pair_covariance, known),
        (_joint, factor, J, pair, J, pair),
    ]


def posterior_of(
    problem: Problem,
    at: solver.Linearisation,
    level: Noise,
    readings: NodeReadings,
    *,
    clock_s: float,
    estimated: tuple[str, ...],
) -> Posterior:
    """The posterior of a problem that has been solved; float64."""
    factor, known, _ = solver.spread(at)
    sigma = np.sqrt(np.diag(known.corner)) * np.asarray(problem.prior.free)
    bias = np.asarray(at.state.bias)
    bias_sigma = np.sqrt(np.diagonal(known.diagonal, axis1=1, axis2=2))[:, BIAS]
    sensors = Sensors(
        float(at.state.offset_s),
        float(sigma[OFFSET][0]),
        np.asarray(at.state.T_body_cam),
        sigma[MOUNTING],
        float(np.exp(at.state.log_scale)),
        float(sigma[SCALE][0]),
        np.asarray(at.state.gravity_world),
        float(sigma[GRAVITY].max()),
        clock_s + 3 * float(problem.interval_s) * np.arange(len(bias)),
        bias[:, :3],
        bias_sigma[:, :3],
        bias[:, 3:],
        bias_sigma[:, 3:],
    )
    white = white_noise(readings)
    bands = np.asarray(level.gyro), np.asarray(level.accelerometer)
    noise = NoiseLevels(
        float(white[0]), float(white[1]), *bands, float(level.position), float(level.rotation)
    )
    return Posterior(sensors, noise, estimated, clock_s, problem, at.state, known, factor)


@jax.jit
def _joint(factor: Factorisation, J_a, pair_a, J_b, pair_b):
    """Covariances of J_a x_a + J_b x_b, where x are pairs of blocks with the border."""
    blocks = factor.root.shape[0]

    def one(J_a, pair_a, J_b, pair_b):
        columns = jnp.zeros((blocks, BLOCK, 6), J_a.dtype)
        for J, pair in ((J_a, pair_a), (J_b, pair_b)):
            columns = columns.at[pair].add(J[:, :BLOCK].T)
            columns = columns.at[pair + 1].add(J[:, BLOCK : 2 * BLOCK].T)
        corner = (J_a + J_b)[:, 2 * BLOCK :].T
        solved = solve_rows(factor.root, factor.lower, columns)
        rest = corner - jnp.einsum("nkg,nkm->gm", factor.swept, columns)
        P = jnp.einsum("nki,nkj->ij", columns, solved)
        return P + rest.T @ jnp.linalg.solve(factor.schur, rest)

    return jax.lax.map(lambda x: one(*x), (J_a, pair_a, J_b, pair_b))

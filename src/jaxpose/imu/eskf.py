"""Error-state Kalman filter and smoother of IMU readings and poses pure and traceable.

The readings drive the prediction, poses correct it (a multiplicative filter, after Sola, "Quaternion
kinematics for the error-state Kalman filter", 2017). The error has 15 components: position and velocity
[m, m/s, world], rotation [rad, right increment], bias of the gyroscope [rad/s] and the accelerometer [m/s^2].
`filtering.filter_imu` is the way in for recordings.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxpose.geometry import se3
from jaxpose.imu.types import ImuNoise


class PoseNoise(NamedTuple):
    """One standard deviation of a measured pose, per axis; errors are independent from pose to pose."""

    position: float  # m
    rotation: float  # rad


class State(NamedTuple):
    """The mean of what the filter estimates."""

    T_world_body: Float[Array, "*n 4 4"]
    velocity_world: Float[Array, "*n 3"]
    gyro_bias: Float[Array, "*n 3"]
    accelerometer_bias: Float[Array, "*n 3"]


class Step(NamedTuple):
    """From one reading to the next, and the pose that corrects the state at the latter."""

    dt: Float[Array, "*n"]
    omega_body: Float[Array, "*n 2 3"]  # readings at both ends
    acceleration_body: Float[Array, "*n 2 3"]
    T_world_body: Float[Array, "*n 4 4"]  # finite, but any where none was measured
    time_offset: Float[Array, "*n"]  # [s] from the reading to the pose
    measured: Bool[Array, "*n"]


class FilterStep(NamedTuple):
    """The outcome of each step, for the smoother and for the user."""

    predicted: State
    predicted_covariance: Float[Array, "*n 15 15"]
    transition: Float[Array, "*n 15 15"]
    state: State
    covariance: Float[Array, "*n 15 15"]
    innovation: Float[Array, "*n 6"]  # of the measured pose against the predicted: world [m], body [rad]
    innovation_covariance: Float[Array, "*n 6 6"]
    nis: Float[Array, "*n"]  # innovation squared over its covariance


def retract(state: State, error: Float[Array, "15"]) -> State:
    """The state that an error leads to.

    Args:
        state: The state to begin from.
        error: (15,): position [m, world], velocity [m/s], rotation [rad, right increment], bias of the
            gyroscope [rad/s] and of the accelerometer [m/s^2].

    Returns:
        The state that is `error` away (Sola 2017, section 5).
    """
    position, velocity, rotation, gyro_bias, accelerometer_bias = jnp.split(error, 5)
    T = state.T_world_body
    return State(
        se3.make(_product(T[:3, :3], se3.so3_exp(rotation)), T[:3, 3] + position),
        state.velocity_world + velocity,
        state.gyro_bias + gyro_bias,
        state.accelerometer_bias + accelerometer_bias,
    )


def difference(a: State, b: State) -> Float[Array, "15"]:
    """The error between two states, the inverse of `retract`.

    Args:
        a: The state to begin from.
        b: The state to arrive at.

    Returns:
        (15,), so that `retract(a, difference(a, b))` is b.
    """
    T_a, T_b = a.T_world_body, b.T_world_body
    return jnp.concatenate(
        [
            T_b[:3, 3] - T_a[:3, 3],
            b.velocity_world - a.velocity_world,
            se3.so3_log(_product(T_a[:3, :3].T, T_b[:3, :3])),
            b.gyro_bias - a.gyro_bias,
            b.accelerometer_bias - a.accelerometer_bias,
        ]
    )


def propagate(
    state: State,
    dt: Float[Array, ""],
    omega_body: Float[Array, "2 3"],
    acceleration_body: Float[Array, "2 3"],
    gravity_world: Float[Array, "3"],
) -> State:
    """The state some time later, by the readings at both ends (trapezoidal rule; biases stay).

    Args:
        state: The state at the first reading.
        dt: [s] between the readings.
        omega_body: Body rates (2, 3) [rad/s] as read.
        acceleration_body: Specific forces (2, 3) [m/s^2] as read, gravity in them.
        gravity_world: (3,) [m/s^2].

    Returns:
        The state at the second reading.
    """
    T = state.T_world_body
    turn = se3.so3_exp((omega_body.mean(axis=0) - state.gyro_bias) * dt)
    R_world_next = _product(T[:3, :3], turn)
    force = acceleration_body - state.accelerometer_bias[None]
    acceleration = (_product(T[:3, :3], force[0]) + _product(R_world_next, force[1])) / 2 + gravity_world
    position = T[:3, 3] + (state.velocity_world + acceleration * dt / 2) * dt
    return state._replace(
        T_world_body=se3.make(R_world_next, position), velocity_world=state.velocity_world + acceleration * dt
    )


def transition(
    state: State,
    dt: Float[Array, ""],
    omega_body: Float[Array, "2 3"],
    acceleration_body: Float[Array, "2 3"],
    gravity_world: Float[Array, "3"],
) -> tuple[State, Float[Array, "15 15"]]:
    """`propagate`, and how a small error of the state goes on.

    Args:
        state: The state at the first reading.
        dt: [s] between the readings.
        omega_body: Body rates (2, 3) [rad/s] as read.
        acceleration_body: Specific forces (2, 3) [m/s^2] as read.
        gravity_world: (3,) [m/s^2].

    Returns:
        The state at the second reading, and the matrix (15, 15) from the error before to that after, by
        forward mode.
    """
    ahead = lambda start: propagate(start, dt, omega_body, acceleration_body, gravity_world)
    after = ahead(state)
    grow = lambda error: difference(after, ahead(retract(state, error)))
    return after, jax.jacfwd(grow)(jnp.zeros(15, dt.dtype))


def _predict(state, covariance, step: Step, noise: ImuNoise, gravity_world):
    after, F = transition(state, step.dt, step.omega_body, step.acceleration_body, gravity_world)
    # White noise of a reading acts as a bias would that lasts for this step only.
    G = (F - jnp.eye(15, dtype=F.dtype))[:, 9:]
    white = jnp.repeat(jnp.stack([noise.gyro_density, noise.accelerometer_density]) ** 2 / step.dt, 3)
    walk = jnp.repeat(jnp.stack([noise.gyro_walk, noise.accelerometer_walk]) ** 2 * step.dt, 3)
    drift = jnp.diag(jnp.concatenate([jnp.zeros(9, walk.dtype), walk]))
    return after, _sandwich(F, covariance) + _sandwich(G, jnp.diag(white)) + drift, F


def _correct(state, covariance, step: Step, pose_noise: PoseNoise):
    def residual(error):
        """The measured pose against that of the state, carried to the pose's own time by its own motion."""
        at = retract(state, error)
        turn = se3.so3_exp((step.omega_body[1] - at.gyro_bias) * step.time_offset)
        R_world_body = _product(at.T_world_body[:3, :3], turn)
        position = at.T_world_body[:3, 3] + at.velocity_world * step.time_offset
        rotation = se3.so3_log(_product(R_world_body.T, step.T_world_body[:3, :3]))
        return jnp.concatenate([step.T_world_body[:3, 3] - position, rotation])

    zero = jnp.zeros(15, covariance.dtype)
    innovation, H = residual(zero), -jax.jacfwd(residual)(zero)
    N = jnp.diag(jnp.repeat(jnp.stack([pose_noise.position, pose_noise.rotation]) ** 2, 3))
    S = _sandwich(H, covariance) + N
    solved = jnp.linalg.solve(S, jnp.concatenate([_product(H, covariance), innovation[:, None]], axis=1))
    K = jnp.where(step.measured, solved[:, :15].T, 0)
    # Joseph's form stays positive whatever rounding does to K.
    covariance = _sandwich(jnp.eye(15, dtype=K.dtype) - _product(K, H), covariance) + _sandwich(K, N)
    return retract(state, _product(K, innovation)), covariance, innovation, S, innovation @ solved[:, 15]


@jax.jit
def forward(
    start: State,
    covariance: Float[Array, "15 15"],
    steps: Step,
    noise: ImuNoise,
    pose_noise: PoseNoise,
    gravity_world: Float[Array, "3"],
) -> FilterStep:
    """The filter over all steps.

    Args:
        start: The state at the first reading.
        covariance: Of its error (15, 15).
        steps: One from each reading to the next.
        noise: Of the readings, as scalar arrays.
        pose_noise: Of the measured poses, as scalar arrays.
        gravity_world: (3,) [m/s^2].

    Returns:
        What each step left behind.
    """

    def step(carry: tuple[State, Float[Array, "15 15"]], step: Step):
        predicted, P, F = _predict(*carry, step, noise, gravity_world)
        state, covariance, innovation, S, nis = _correct(predicted, P, step, pose_noise)
        filtered = FilterStep(predicted, P, F, state, covariance, innovation, S, nis)
        return (state, covariance), filtered

    return jax.lax.scan(step, (start, covariance), steps)[1]


@jax.jit
def backward(
    start: State, covariance: Float[Array, "15 15"], filtered: FilterStep
) -> tuple[State, Float[Array, "n 15 15"]]:
    """States and covariances given later poses too (Rauch, Tung and Striebel 1965).

    Args:
        start: The state that `forward` began from.
        covariance: Of its error (15, 15).
        filtered: What `forward` returned.

    Returns:
        States and covariances at all readings, the first included.
    """
    last = jax.tree.map(lambda x: x[-1], (filtered.state, filtered.covariance))
    before = jax.tree.map(
        lambda first, x: jnp.concatenate([first[None], x[:-1]]),
        (start, covariance),
        (filtered.state, filtered.covariance),
    )

    def step(later, row):
        (state, P), predicted, predicted_P, F = row
        C = jnp.linalg.solve(predicted_P, _product(F, P)).T
        state = retract(state, _product(C, difference(predicted, later[0])))
        smoothed = state, P + _sandwich(C, later[1] - predicted_P)
        return smoothed, smoothed

    rows = before, filtered.predicted, filtered.predicted_covariance, filtered.transition
    _, smoothed = jax.lax.scan(step, last, rows, reverse=True)
    return jax.tree.map(lambda x, end: jnp.concatenate([x, end[None]]), smoothed, last)


def _product(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.matmul(a, b, precision="highest")


def _sandwich(A: Float[Array, "i k"], P: Float[Array, "k k"]) -> Float[Array, "i i"]:
    """A P A^T, symmetric to the last bit."""
    full = _product(_product(A, P), A.T)
    return (full + full.T) / 2

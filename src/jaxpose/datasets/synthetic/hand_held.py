"""A hand-held walk: an analytic, smooth trajectory of the body (= IMU) around the middle of the room."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.geometry import se3
from jaxpose.imu import AnyArray

LOOP_S = 12.5  # once around, at speed 1
STEP_HZ = 1.8  # steps of the walk
# per axis: amplitude and frequency [Hz] of each sinusoid; their phases are the walk's
_SWAY = (((0.10, 0.23), (0.012, 0.9)), ((0.10, 0.19), (0.012, 0.9)), ((0.10, 0.11), (0.014, STEP_HZ)))  # m
_LOOK = (  # rad: yaw, pitch, roll
    ((0.22, 0.17), (0.012, 0.9), (0.003, 3.7)),
    ((0.10, 0.21), (0.010, STEP_HZ), (0.003, 4.3)),
    ((0.05, 0.14), (0.012, 0.9), (0.003, 3.1)),
)
_RADII = (1.2, 0.8)  # of the loop [m]
HEIGHT = 1.38  # [m]
_PITCH = 0.23  # downwards [rad]


class HandHeldMotion(NamedTuple):
    """What differs from one walk to another."""

    speed: Float[AnyArray, ""]  # 1 is a stroll; may be negative to walk the other way round
    start: Float[AnyArray, ""]  # where on the loop [rad]
    sway: Float[AnyArray, "3 2"]  # phases [rad]
    look: Float[AnyArray, "3 3"]


def draw(rng: np.random.Generator, speed: float) -> HandHeldMotion:
    """A walk at random: its direction, start and phases."""
    phases = lambda shape: np.asarray(rng.uniform(0, 2 * np.pi, shape))
    return HandHeldMotion(np.asarray(speed * rng.choice([-1, 1])), phases(()), phases((3, 2)), phases((3, 3)))


def pose(walk: HandHeldMotion, t: Float[Array, ""]) -> Float[Array, "4 4"]:
    """`T_world_body` at `t` [s]; body axes are forwards, left, up."""
    around = jnp.asarray(walk.start, t.dtype) + 2 * jnp.pi / LOOP_S * jnp.asarray(walk.speed, t.dtype) * t
    loop = jnp.stack([_RADII[0] * jnp.cos(around), _RADII[1] * jnp.sin(around), jnp.full_like(t, HEIGHT)])
    return by_hand(walk, t, loop, around + jnp.pi)  # across the room, past its middle


def by_hand(
    walk: HandHeldMotion, t: Float[Array, ""], place: Float[Array, "3"], heading: Float[Array, ""]
) -> Float[Array, "4 4"]:
    """`T_world_body` at `t` [s] of a hand at a `place` [m] of its course, looking along a `heading` [rad]."""
    walk = HandHeldMotion(*(jnp.asarray(x, t.dtype) for x in walk))
    phase = t * jnp.abs(walk.speed)

    def waves(kind, phases):
        amplitude, frequency = jnp.moveaxis(jnp.asarray(kind, t.dtype), -1, 0)
        return jnp.sum(amplitude * jnp.sin(2 * jnp.pi * frequency * phase + phases), axis=-1)

    angles = waves(_LOOK, walk.look) + jnp.stack([heading, jnp.full_like(t, _PITCH), jnp.zeros_like(t)])
    return se3.make(_yaw_pitch_roll(angles), place + waves(_SWAY, walk.sway))


def _yaw_pitch_roll(angles: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rz(yaw) Ry(pitch) Rx(roll), written out."""
    (a, b, c), (p, q, r) = jnp.sin(angles), jnp.cos(angles)
    return jnp.stack(
        [p * q, p * b * c - a * r, p * b * r + a * c]
        + [a * q, a * b * c + p * r, a * b * r - p * c]
        + [-b, q * c, q * r]
    ).reshape(3, 3)

"""Whether the mean of what an accelerometer reads along ground truth is gravity."""

import numpy as np
from jaxtyping import Float

from jaxpose._checks import check_shapes
from jaxpose.geometry.rigid import vector_angle

_MOST_OFF_UP_DEG, _MOST_OFF_GRAVITY = 10.0, 0.1  # of the mean specific force, before a note says so


def gravity_note(
    read_at: Float[np.ndarray, " m"],
    force: Float[np.ndarray, "m 3"],
    t: Float[np.ndarray, " n"],
    T_world_sensor: Float[np.ndarray, "n 4 4"],
    gravity_world: Float[np.ndarray, "3"],
    sensor: str,
) -> tuple[str, ...]:
    """Compare the mean of an accelerometer's readings with gravity.

    What moves comes to rest again, so over a recording its own acceleration has no mean.

    Args:
        read_at: Timestamps (m,) [s] of the readings.
        force: Specific forces (m, 3) [m/s^2] in the sensor's axes.
        t: Timestamps (n,) [s] of ground truth; those within the readings are used.
        T_world_sensor: Ground truth (n, 4, 4), NaN where it is missing.
        gravity_world: (3,) [m/s^2].
        sensor: The sensor's name in the note.

    Returns:
        A note if the mean in the world is more than 10 degrees or 10% off the opposite of gravity; none if it
        is not, or if fewer than two poses can be used.
    """
    check_shapes(
        read_at=(read_at, "m"), force=(force, "m 3"), t=(t, "n"), T_world_sensor=(T_world_sensor, "n 4 4")
    )
    usable = (t >= read_at[0]) & (t <= read_at[-1]) & np.isfinite(T_world_sensor).all(axis=(1, 2))
    if usable.sum() < 2:
        return ()
    between = np.stack([np.interp(t[usable], read_at, axis) for axis in force.T], axis=-1)
    mean = np.einsum("nij,nj->ni", T_world_sensor[usable, :3, :3], between).mean(axis=0)
    norm, gravity = np.linalg.norm(mean), np.linalg.norm(gravity_world)
    off = np.degrees(vector_angle(-mean, gravity_world))
    if off <= _MOST_OFF_UP_DEG and abs(norm / gravity - 1) <= _MOST_OFF_GRAVITY:
        return ()
    return (
        f"{sensor}'s mean force is {norm:.3g} m/s^2, {off:.0f} deg from up by the true poses, "
        f"where gravity is {gravity:.3g}: check unit and extrinsics, and that ground truth's z axis "
        f"points up",
    )

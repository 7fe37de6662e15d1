"""Whether what an accelerometer reads along true poses is gravity."""

import numpy as np
from jaxtyping import Float

from jaxpose.geometry.rigid import vector_angle

_MOST_OFF_UP_DEG, _MOST_OFF_GRAVITY = 10.0, 0.1  # of the mean specific force, before it is told


def gravity_note(
    read_at: Float[np.ndarray, " m"],
    force: Float[np.ndarray, "m 3"],
    t: Float[np.ndarray, " n"],
    T_world_sensor: Float[np.ndarray, "n 4 4"],
    gravity_world: Float[np.ndarray, "3"],
    sensor: str,
) -> tuple[str, ...]:
    """A note if the mean of `force` [m/s^2, sensor axes] in the world is far from the opposite of gravity.

    Over the true poses at `t` [s], NaN where one is missing, that lie within the readings; none where those
    are fewer than two. What moves comes to rest again, so over a recording its own acceleration has no mean.
    `sensor` is its name in the note.
    """
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

"""A constant turn of a moving camera, by contrast in space: where poses are right, rays of events meet.

Rays are counted in voxels (Rebecq et al., "EMVS", IJCV 2018); how sharp the counts are says how right poses
are, as variance does for images of warped events (Gallego et al., CVPR 2018).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.events.types import Events, check_events
from jaxpose.geometry.camera import Camera, unproject_numpy

LEAST, _MOST = 1000, 30_000  # events that are used
_CELLS, _DEPTHS = 96, 64  # voxels along a side, and points along a ray
_REACH_DEG, _STEP_DEG, _NEAR_DEG = 12.0, 1.5, 1.5  # turns tried; the peak is a parabola through those so near
_FINE = 9  # turns to which it is fitted


def find_turn_deg(
    camera: Camera,
    events: Events,
    poses: Callable[[Float[np.ndarray, " n"]], Float[np.ndarray, "n 4 4"]],
    depths: tuple[float, float],
) -> float:
    """The turn about the camera's own y axis, the same at all times, with which rays of events meet best.

    A turntable's axis stands across the rows of an image. If a camera is thought to see it elsewhere, by a
    few degrees, nothing of what turns is seen twice in one place, and counts of rays in voxels are blurred.
    Rays are weighed by depth, as those of a camera that came nearer would lie closer together. Turns about
    the other axes shift everything alike and hardly show.

    Args:
        camera: That saw the events.
        events: At least 1000.
        poses: Camera-to-world poses, up to the turn, at given times [s].
        depths: Between which the scene lies [scene units].

    Returns:
        Degrees, by which cameras are to be turned: `T_world_cam @ turn` is right. At most 12 either way.

    Raises:
        DataError: For few events.
        ValueError: For columns of another shape or type.

    Source: after Rebecq et al., IJCV 2018, and Gallego et al., CVPR 2018; weights and search are our own.
    """
    check_events(events)
    if len(events.t) < LEAST:
        raise DataError(f"axis from events: expected at least {LEAST} events, got {len(events.t)}")
    generator, (near, far) = np.random.default_rng(0), depths
    some = np.sort(generator.permutation(len(events.t))[:_MOST])
    pixels = np.stack([events.x[some], events.y[some]], axis=-1).astype(np.float64)
    directions, T = unproject_numpy(camera, pixels), poses(events.t[some])
    depth = near + (far - near) * (np.arange(_DEPTHS) + generator.random((len(some), 1))) / _DEPTHS
    sign = (events.polarity[some] > 0).astype(np.int64)[:, None]

    def points(turn_deg):
        turn = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
        along = np.einsum("nij,jk,nk->ni", T[:, :3, :3], turn, directions)
        return T[:, None, :3, 3] + depth[..., None] * along[:, None]

    low, high = np.percentile(points(0.0).reshape(-1, 3), (5, 95), axis=0)
    middle, size = (low + high) / 2, 1.2 * float((high - low).max())

    def contrast(turn_deg):
        cell = np.floor(((points(turn_deg) - middle) / size + 0.5) * _CELLS).astype(np.int64)
        inside = ((cell >= 0) & (cell < _CELLS)).all(axis=-1)
        at = ((sign * _CELLS + cell[..., 0]) * _CELLS + cell[..., 1]) * _CELLS + cell[..., 2]
        counts = np.bincount(at[inside], depth[inside], minlength=2 * _CELLS**3)
        both = counts.reshape(2, _CELLS, _CELLS, _CELLS).astype(np.float32)
        return float(sum(np.sum(gaussian_filter(count, 1.0, truncate=2.0) ** 2) for count in both))

    steps = np.arange(-_REACH_DEG, _REACH_DEG + _STEP_DEG / 2, _STEP_DEG)
    best = float(steps[int(np.argmax([contrast(turn) for turn in steps]))])
    nearby = best + np.linspace(-_NEAR_DEG, _NEAR_DEG, _FINE)
    curvature, slope, _ = np.polyfit(nearby - best, [contrast(turn) for turn in nearby], 2)
    peak = -slope / (2 * curvature) if curvature < 0 else 0.0
    return best + float(np.clip(peak, -_NEAR_DEG, _NEAR_DEG))

"""Frames of a rolling shutter as a global one would have taken them: all rows at the first one's time."""

import cv2
import numpy as np
from jaxtyping import Float

from jaxpose.datasets.types import Frame
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, pixel_grid, project_numpy, unproject_numpy

_ONE_SURFACE = 0.02  # share of its depth by which neighbours may differ to be interpolated
_ROUNDS = 3  # of finding where a pixel came from: the flow is a few pixels, and changes slowly


def at_first_row(
    frame: Frame, camera: Camera, twist_cam: Float[np.ndarray, "6"], line_delay_s: float
) -> Frame:
    """The frame seen from where its first row was, at the camera's speed.

    A pixel's point is where its ray ends at the measured depth when its row was read; pixels without depth
    are taken to be as far away as the image's median. What came into view later is left without depth.

    Args:
        frame: as read.
        camera: its intrinsics.
        twist_cam: (6,) [m/s, rad/s] of the camera in its own axes while the frame is read.
        line_delay_s: [s] from a row to the next.

    Returns:
        A frame of the same size.
    """
    height, width = frame.depth.shape
    pixel = pixel_grid(camera).astype(np.float64)
    measured = frame.depth > 0
    if not measured.any() or not np.any(twist_cam) or line_delay_s == 0:
        return frame
    depth = np.where(measured, frame.depth, np.median(frame.depth[measured]))
    T_first_row = rigid.exp(np.arange(height)[:, None] * line_delay_s * twist_cam)
    point = unproject_numpy(camera, pixel) * depth[..., None]
    point = np.einsum("hij,hwj->hwi", T_first_row[:, :3, :3], point) + T_first_row[:, None, :3, 3]
    pixel = pixel.astype(np.float32)
    flow = project_numpy(camera, point).astype(np.float32) - pixel
    source = pixel
    for _ in range(_ROUNDS):
        source = pixel - _sampled(flow, source, cv2.INTER_NEAREST)
    rgb = _sampled(frame.rgb, source, cv2.INTER_LINEAR)
    moved = np.where(measured, point[..., 2], 0).astype(np.float32)
    nearest, between = (_sampled(moved, source, how) for how in (cv2.INTER_NEAREST, cv2.INTER_LINEAR))
    one_surface = np.abs(between - nearest) < _ONE_SURFACE * nearest
    inside = np.all((source > -0.5) & (source < np.array([width, height]) - 0.5), axis=-1)
    return Frame(rgb, np.where(inside, np.where(one_surface, between, nearest), 0))


def _sampled(image: np.ndarray, at: Float[np.ndarray, "h w 2"], how: int) -> np.ndarray:
    """An image at places of it; beyond its border it goes on as it ends there."""
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    return np.asarray(cv2.remap(image, x, y, how, borderMode=cv2.BORDER_REPLICATE))

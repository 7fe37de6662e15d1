"""Lenses that `Camera` does not have, OpenCV's rational model with k4 to k6 and its fisheye, undone."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose.geometry.camera import Camera, pinhole_matrix, pixel_grid

_ITERATIONS = 30  # each leaves less than half of the error, for lenses of up to 120 degrees
_ENOUGH = 1e-7  # [rad]
_OFF_PX = 0.1  # of a ray that is projected again


class Maps(NamedTuple):
    """Where a pinhole's pixels are in the images of a lens."""

    column: np.ndarray  # [px]
    row: np.ndarray


def undistortion(camera: Camera, coefficients: Float[np.ndarray, " k"], *, fisheye: bool = False) -> Maps:
    """How images of a lens become those of a pinhole.

    Args:
        camera: The pinhole.
        coefficients: k1 k2 p1 p2 k3 k4 k5 k6 of the lens, which has the same intrinsics otherwise.
        fisheye: Whether they are k1 k2 k3 k4 of a fisheye (equidistant, Kannala and Brandt).

    Returns:
        For `remapped`.
    """
    import cv2

    K, size = pinhole_matrix(*camera[:4]), (camera.width, camera.height)
    module = cv2.fisheye if fisheye else cv2
    return Maps(*module.initUndistortRectifyMap(K, coefficients, np.eye(3), K, size, cv2.CV_32FC1))


def remapped(image: np.ndarray, maps: Maps) -> np.ndarray:
    """An image of a lens as its pinhole has it: colour is interpolated, depth is not.

    Args:
        image: Colour (h, w, 3) or depth (h, w).
        maps: Of `undistortion`.

    Returns:
        The image.
    """
    import cv2

    how = cv2.INTER_LINEAR if image.ndim == 3 else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(image, maps.column, maps.row, how))


def pixel_rays(
    camera: Camera, coefficients: Float[np.ndarray, " k"], *, fisheye: bool = False
) -> Float[np.ndarray, "h w 3"]:
    """Rays of the pixels of a lens.

    Args:
        camera: Its intrinsics.
        coefficients: As for `undistortion`.
        fisheye: Likewise.

    Returns:
        Rays with z = 1; NaN where no ray leads to a pixel, beyond the lens' own circle.
    """
    import cv2

    pixels, focal = pixel_grid(camera).reshape(-1, 2), np.array([camera.fx, camera.fy])
    rays = np.append((pixels - [camera.cx, camera.cy]) / focal, np.ones((len(pixels), 1)), axis=1)
    off = np.zeros_like(pixels)
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):  # OpenCV's undistortPoints stops after 5 in some of its versions
            rays[:, :2] += off
            module = cv2.fisheye if fisheye else cv2
            at = rays[:, None], np.zeros(3), np.zeros(3), pinhole_matrix(*camera[:4]), coefficients
            again = module.projectPoints(*at)[0]
            off = (pixels - again[:, 0]) / focal
            if not (np.abs(off) > _ENOUGH).any():
                break
        rays[~(np.abs(off * focal).max(axis=1) < _OFF_PX)] = np.nan
    return rays.reshape(camera.height, camera.width, 3)

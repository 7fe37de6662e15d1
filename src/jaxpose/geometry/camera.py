"""The pinhole camera with OpenCV's distortion: the only code that knows intrinsics and distortion.

`project` and `unproject` are for JAX; `project_numpy` and `unproject_numpy` are the same formulas in float64
numpy. Model and coefficients are those of OpenCV's `calib3d` documentation (Brown 1971): with x = X / Z,
y = Y / Z and r2 = x^2 + y^2 the distorted point is

    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 y^2) + 2 p2 x y

and the pixel is (fx x' + cx, fy y' + cy).
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = float | Float[Array, ""]  # traced where a caller optimises the intrinsics
_NEWTON_STEPS = 6  # quadratic: the corners of EuRoC's and TUM's lenses reach float64 rounding
_OUTSIDE = -1e6  # [px] where points without a pixel go: outside every image, and finite


class Camera(NamedTuple):
    """Intrinsics of a pinhole camera with distortion.

    Attributes:
        fx: Focal length along the rows [px].
        fy: Focal length along the columns [px].
        cx: Column of the principal point [px]; the centre of the first pixel is (0, 0), as in OpenCV.
        cy: Row of the principal point [px].
        width: Columns of the image.
        height: Rows of the image.
        distortion: OpenCV's k1 k2 p1 p2 [k3]; empty for a pinhole, which then pays nothing for it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """The matrix that takes a point in camera axes to its pixel, times its depth.

    Args:
        fx: As `Camera` has them [px],
        fy: likewise,
        cx: likewise,
        cy: likewise.

    Returns:
        K.

    >>> pinhole_matrix(30.0, 31.0, 15.5, 11.5).tolist()
    [[30.0, 0.0, 15.5], [0.0, 31.0, 11.5], [0.0, 0.0, 1.0]]
    """
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(camera: Camera, point_cam: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """The pixel (u, v) of points in camera axes; differentiable, for any leading axes.

    A point that the camera cannot see has no pixel: it goes to (-1e6, -1e6), outside every image, with zero
    gradient. That is one behind the camera (or within 0.06 degrees of the plane through it), and one so far
    from the optical axis that the radial polynomial falls there, which would fold it back into the image.

    Args:
        camera: The camera; its intrinsics may be traced.
        point_cam: Points (x right, y down, z forward), any unit of length.

    Returns:
        Pixels (column, row) [px].

    Raises:
        ValueError: For points without 3 coordinates, and for a distortion of other than 0, 4 or 5 numbers.

    >>> camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
    >>> project(camera, jnp.array([0.1, 0.0, 1.0])).tolist()
    [370.0, 240.0]
    """
    return _project(jnp, camera, point_cam)


def unproject(camera: Camera, pixel: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """The ray through a pixel in camera axes, of length 1 along z: depth times it is the point.

    The inverse of `project`: the distortion is undone by six steps of Newton's method, which reach rounding
    within the image of the lenses of EuRoC and TUM.

    Args:
        camera: The camera; its intrinsics may be traced.
        pixel: Pixels (column, row) [px], fractions allowed.

    Returns:
        Directions (x, y, 1).

    Raises:
        ValueError: For pixels without 2 coordinates, and for a distortion of other than 0, 4 or 5 numbers.

    >>> camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
    >>> unproject(camera, jnp.array([820.0, 240.0])).tolist()
    [1.0, 0.0, 1.0]
    """
    return _unproject(jnp, camera, pixel)


def pixel_slopes(camera: Camera, direction_cam: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2 2"]:
    """How a pixel moves with its ray: derivatives of (u, v) by x and y at z = 1, where `project` sees it.

    Args:
        camera: The camera.
        direction_cam: Directions (x, y, 1), as `unproject` gives them.

    Returns:
        Rows u and v, columns x and y [px].
    """
    xx = yy = np.ones_like(direction_cam[..., 0])
    xy = np.zeros_like(xx)
    if camera.distortion:
        _, (xx, xy, yy) = _distort(np, camera.distortion, direction_cam[..., :2])
    rows = [camera.fx * xx, camera.fx * xy, camera.fy * xy, camera.fy * yy]
    return np.stack(rows, axis=-1).reshape(*xx.shape, 2, 2)


def project_numpy(camera: Camera, point_cam: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """`project` in float64 numpy.

    Args:
        camera: The camera.
        point_cam: Points (..., 3), any unit of length.

    Returns:
        Pixels (column, row) [px], (..., 2).
    """
    return _project(np, camera, np.asarray(point_cam, np.float64))


def unproject_numpy(camera: Camera, pixel: np.ndarray) -> Float[np.ndarray, "*n 3"]:
    """`unproject` in float64 numpy.

    Args:
        camera: The camera.
        pixel: Pixels (column, row) [px], (..., 2), of any number type.

    Returns:
        Directions (x, y, 1), (..., 3).
    """
    return _unproject(np, camera, np.asarray(pixel, np.float64))


def pixel_grid(camera: Camera, step: int = 1) -> np.ndarray:
    """Pixels (column, row) of the image: the middle of every block of `step` x `step`.

    Args:
        camera: Says how large the image is.
        step: 1 for every pixel.

    Returns:
        Whole numbers (rows, columns, 2), float64.

    >>> pixel_grid(Camera(1.0, 1.0, 0.0, 0.0, 4, 2), 2).tolist()
    [[[1.0, 1.0], [3.0, 1.0]]]
    """
    row, column = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    return np.stack([column, row], axis=-1).astype(np.float64)


def angle_of_view(camera: Camera) -> tuple[float, float]:
    """The angle of view of the pinhole, its distortion left out.

    Args:
        camera: The camera.

    Returns:
        The horizontal and the vertical angle [rad].

    >>> round(math.degrees(angle_of_view(Camera(320.0, 320.0, 319.5, 239.5, 640, 480))[0]), 6)
    90.0
    """
    return 2 * math.atan(camera.width / 2 / camera.fx), 2 * math.atan(camera.height / 2 / camera.fy)


def scale(camera: Camera, factor: float) -> Camera:
    """The camera of the image resized by `factor` (0.5: half as wide), its size rounded to whole pixels.

    Resizing keeps the image's outer edge, half a pixel outside the first centre: u' = (u + 0.5) s - 0.5.

    Args:
        camera: The camera of the image as it is.
        factor: The new size by the old one.

    Returns:
        The camera of the resized image; the distortion stays.

    Raises:
        ValueError: For a factor that leaves no pixel.

    >>> scale(Camera(500.0, 500.0, 319.5, 239.5, 640, 480), 0.5)[:6]
    (250.0, 250.0, 159.5, 119.5, 320, 240)
    """
    if not 0 < factor < math.inf:
        raise ValueError(f"factor: expected a positive number, got {factor}")
    return resized(camera, round(camera.width * factor), round(camera.height * factor))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the image resized to exactly this size, as `scale` says.

    Args:
        camera: The camera of the image as it is.
        width: Columns [px] of the resized image.
        height: Rows [px].

    Returns:
        The camera of the resized image; the distortion stays.

    Raises:
        ValueError: For a size below one pixel.
    """
    if width < 1 or height < 1:
        raise ValueError(f"size: expected at least 1x1 pixels, got {width}x{height}")
    sx, sy = width / camera.width, height / camera.height
    return camera._replace(
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5,
        cy=(camera.cy + 0.5) * sy - 0.5,
        width=width,
        height=height,
    )


# What follows is written once for both libraries: `xp` is numpy or jax.numpy.


def _project(xp: Any, camera: Camera, point_cam: Any) -> Any:
    if point_cam.shape[-1:] != (3,):
        raise ValueError(f"point_cam: expected 3 coordinates (..., 3), got shape {point_cam.shape}")
    xy, z = point_cam[..., :2], point_cam[..., 2:]
    seen = z > 1e-3 * xp.max(xp.abs(xy), axis=-1, keepdims=True)
    point = xp.where(seen, xy, 0) / xp.where(seen, z, 1)
    if camera.distortion:
        r2 = xp.sum(point * point, axis=-1, keepdims=True)
        seen = seen & (r2 < _turning_point(xp, camera.distortion, r2.dtype))
        point = _distort(xp, camera.distortion, xp.where(seen, point, 0))[0]
    pixel = xp.stack([point[..., 0] * camera.fx + camera.cx, point[..., 1] * camera.fy + camera.cy], axis=-1)
    return xp.where(seen, pixel, _OUTSIDE)


def _unproject(xp: Any, camera: Camera, pixel: Any) -> Any:
    if pixel.shape[-1:] != (2,):
        raise ValueError(f"pixel: expected 2 coordinates (..., 2), got shape {pixel.shape}")
    distorted = xp.stack(
        [(pixel[..., 0] - camera.cx) / camera.fx, (pixel[..., 1] - camera.cy) / camera.fy], axis=-1
    )
    point = distorted
    for _ in range(_NEWTON_STEPS if camera.distortion else 0):
        value, (xx, xy, yy) = _distort(xp, camera.distortion, point)
        x, y = (value - distorted)[..., 0], (value - distorted)[..., 1]
        step = xp.stack([yy * x - xy * y, xx * y - xy * x], axis=-1) / (xx * yy - xy * xy)[..., None]
        point = point - step
    return xp.concatenate([point, xp.ones_like(point[..., :1])], axis=-1)


def _coefficients(distortion: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """k1 k2 p1 p2 k3; raises ValueError unless 4 or 5 coefficients."""
    if len(distortion) not in (4, 5):
        raise ValueError(f"distortion: expected k1 k2 p1 p2 [k3] or nothing, got {len(distortion)} numbers")
    return (*distortion, 0.0)[:5]


def _distort(xp: Any, distortion: tuple[Scalar, ...], point: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """The distorted point at z = 1, and its derivatives: x' by x, x' by y (the same as y' by x), y' by y."""
    k1, k2, p1, p2, k3 = _coefficients(distortion)
    x, y = point[..., 0], point[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * (3 * k3)))  # of `radial` by r2, twice
    value = xp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    by_xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return value, (by_xx, by_xy, by_yy)


def _turning_point(xp: Any, distortion: tuple[Scalar, ...], dtype: Any) -> Any:
    """The squared radius at which the distorted radius stops growing; infinite if not within 76 degrees."""
    k1, k2, _, _, k3 = _coefficients(distortion)
    r2 = xp.linspace(0.0625, 16, 256, dtype=dtype)
    falls = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * (7 * k3))) <= 0
    return xp.where(xp.any(falls), r2[xp.argmax(falls)], math.inf)

"""The pinhole camera with OpenCV's lens distortion: pixels to rays and points to pixels."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = float | Float[Array, ""]  # traced where a caller optimises the intrinsics
_NEWTON_STEPS = 6  # quadratic: the corners of EuRoC's and TUM's lenses reach float64 rounding
_OUTSIDE = -1e6  # [px] where points without a pixel go: outside every image, and finite


class Camera(NamedTuple):
    """Intrinsics [px], plain Python numbers; the centre of the first pixel is (0, 0), as in OpenCV.

    `distortion` is OpenCV's k1 k2 p1 p2 [k3]; empty for a pinhole, which then pays nothing for it.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()


def pixel_direction(camera: Camera, pixel: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
    """The ray through a pixel (u, v) in camera axes, of length 1 along z: depth times it is the point."""
    distorted = jnp.stack(
        [(pixel[..., 0] - camera.cx) / camera.fx, (pixel[..., 1] - camera.cy) / camera.fy], axis=-1
    )
    point = _undistort(camera.distortion, distorted)
    return jnp.concatenate([point, jnp.ones_like(point[..., :1])], axis=-1)


def project(camera: Camera, point_cam: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """The pixel (u, v) of a point in camera axes.

    A point behind the camera (or within 0.06 degrees of the plane through it) has no pixel: it goes to
    (-1e6, -1e6), outside every image, with zero gradient. A lens polynomial holds within the image it was
    calibrated on; far outside it may fold points back, so bound the angle of points before they come here.
    """
    xy, z = point_cam[..., :2], point_cam[..., 2:]
    seen = z > 1e-3 * jnp.max(jnp.abs(xy), axis=-1, keepdims=True)
    distorted = _distort(camera.distortion, jnp.where(seen, xy, 0) / jnp.where(seen, z, 1))
    pixel = jnp.stack(
        [distorted[..., 0] * camera.fx + camera.cx, distorted[..., 1] * camera.fy + camera.cy], axis=-1
    )
    return jnp.where(seen, pixel, _OUTSIDE)


def angle_of_view(camera: Camera) -> float:
    """The horizontal angle of view [rad] of the pinhole."""
    return 2 * math.atan(camera.width / 2 / camera.fx)


def scale(camera: Camera, factor: float) -> Camera:
    """The camera of the image resized by `factor` (0.5: half as wide), its size rounded to whole pixels.

    Resizing keeps the image's outer edge, half a pixel outside the first centre: u' = (u + 0.5) s - 0.5.
    """
    return resized(camera, round(camera.width * factor), round(camera.height * factor))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the image resized to exactly this size, as `scale` says."""
    sx, sy = width / camera.width, height / camera.height
    return camera._replace(
        fx=camera.fx * sx,
        fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5,
        cy=(camera.cy + 0.5) * sy - 0.5,
        width=width,
        height=height,
    )


def _distort(distortion: tuple[Scalar, ...], point: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """Where the lens puts an ideal image point at z = 1; raises ValueError unless 0, 4 or 5 coefficients."""
    if not distortion:
        return point
    if len(distortion) not in (4, 5):
        raise ValueError(f"distortion: expected k1 k2 p1 p2 [k3] or nothing, got {len(distortion)} numbers")
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    x, y = point[..., 0], point[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _undistort(distortion: tuple[Scalar, ...], distorted: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """The inverse of `_distort` by Newton's method, a fixed number of steps."""
    if not distortion:
        return distorted
    point = distorted
    unit_x = jnp.broadcast_to(jnp.asarray([1, 0], point.dtype), point.shape)
    for _ in range(_NEWTON_STEPS):
        value, by_x = jax.jvp(lambda p: _distort(distortion, p), (point,), (unit_x,))
        by_y = jax.jvp(lambda p: _distort(distortion, p), (point,), (1 - unit_x,))[1]
        residual = value - distorted
        determinant = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
        step = jnp.stack(
            [
                residual[..., 0] * by_y[..., 1] - residual[..., 1] * by_y[..., 0],
                residual[..., 1] * by_x[..., 0] - residual[..., 0] * by_x[..., 1],
            ],
            axis=-1,
        )
        point = point - step / determinant[..., None]
    return point

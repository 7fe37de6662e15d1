"""OpenCV's distortion a second time, after its documentation: scalars, float64, the inverse by iteration."""

import numpy as np

EUROC_CAM0 = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)


def distorted(distortion, x, y):
    """Where the lens puts a point at z = 1."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5] if distortion else (0.0,) * 5
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def pixel_of(camera, x, y, z):
    """The pixel of a point in front of the camera."""
    xd, yd = distorted(camera.distortion, x / z, y / z)
    return camera.fx * xd + camera.cx, camera.fy * yd + camera.cy


def ray_of(camera, u, v):
    """The point at z = 1 that a pixel sees, by fixed-point iteration as `cv2.undistortPoints` does."""
    xd, yd = (np.asarray(u, float) - camera.cx) / camera.fx, (np.asarray(v, float) - camera.cy) / camera.fy
    x, y = xd, yd
    for _ in range(300):
        dx, dy = distorted(camera.distortion, x, y)
        x, y = x + 0.5 * (xd - dx), y + 0.5 * (yd - dy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)

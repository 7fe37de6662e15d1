"""What a structured-light depth camera makes of exact depth: axial noise, steps, and holes."""

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.geometry.camera import Camera

BASELINE = 0.075  # from the infrared camera to its projector, along -x [m]
STEP = 0.001  # depth is stored in millimetres


def axial_sigma(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Standard deviation of Kinect's depth [m] (Nguyen, Izadi and Lovell, 3DIMPVT 2012)."""
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def add_noise(
    depth: Float[np.ndarray, "h w"], rng: np.random.Generator, *, scale: float
) -> Float[np.ndarray, "h w"]:
    """Independent normal noise of `scale` times Kinect's, then rounding to millimetres."""
    noisy = depth + scale * axial_sigma(depth) * rng.standard_normal(depth.shape, np.float32)
    return (np.round(noisy / STEP) * STEP).astype(np.float32)


def holes(
    depth: Float[np.ndarray, "h w"],
    cosine: Float[np.ndarray, "h w"],
    camera: Camera,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Where the sensor sees nothing: shadows of the projector beside near things, and grazing surfaces.

    `cosine` is that of the angle between the ray and the surface normal; below 0.2 pixels begin to fail,
    below 0.1 all do. Shadows come from the geometry: what the camera sees at a pixel the projector sees
    shifted by fx * baseline / depth, and of all that lands on the same spot it lights the nearest only.
    """
    landing = np.arange(depth.shape[1]) + camera.fx * BASELINE / depth
    before = np.maximum.accumulate(landing, axis=1)[:, :-1]
    shadow = np.zeros(depth.shape, bool)
    shadow[:, 1:] = landing[:, 1:] < before - 1.0
    grazing = cosine < rng.uniform(0.1, 0.2, depth.shape)
    return shadow | grazing

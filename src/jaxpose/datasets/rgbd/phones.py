"""What recorders of phones share: ARKit's axes and confidence, and a camera whose focus moves."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import Pinhole, open_image
from jaxpose.errors import DataError
from jaxpose.imu import GRAVITY_WORLD

Y_UP = np.array([0.0, -np.linalg.norm(GRAVITY_WORLD), 0.0])  # gravity in ARKit's world
# ARKit's camera looks along -z with y up and x along the phone, from its top; the IMU's x is to the right and
# y up on the upright phone's front, z out of it (Apple: ARCamera.transform, CMMotionManager).
R_CAM_PHONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
UNSURE = "depth of confidence 0 left out"
_MOST_FOCUS = 0.01  # share of the focal length, before a note says so


def sure(depth: np.ndarray, confidence: np.ndarray, where: Path | str) -> np.ndarray:
    """Depth without what has confidence 0 (of 0 to 2, or to 255)."""
    if confidence.shape != depth.shape:
        size, got = (f"{s[1]}x{s[0]}" for s in (depth.shape, confidence.shape[:2]))
        raise DataError(f"{where}: expected confidence of {size}, the size of depth, got {got}")
    return np.where(confidence > 0, depth, 0).astype(np.float32)


def sure_by_file(depth: np.ndarray, file: Path) -> np.ndarray:
    """Depth without what the image beside it has no confidence in; as it is where there is no such image."""
    return sure(depth, open_image(file, np.asarray), file) if file.is_file() else depth


def middle(intrinsics: Float[np.ndarray, "n 4"]) -> tuple[Pinhole, tuple[str, ...]]:
    """One camera for frames of fx fy cx cy each: the median, and a note where the focus moved."""
    fx, fy, cx, cy = np.median(intrinsics, axis=0).tolist()
    spread = float(np.ptp(intrinsics[:, 0]) / fx)
    note = f"took the median of intrinsics whose focal length varies by {spread:.1%}"
    return Pinhole(fx, fy, cx, cy), (note,) if spread > _MOST_FOCUS else ()

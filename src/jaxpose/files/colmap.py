"""Poses as COLMAP's text model: cameras.txt, images.txt, points3D.txt."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import write_text
from jaxpose.geometry.camera import Camera


def write_colmap(
    folder: Path | str, camera: Camera, images: Sequence[str], T_world_cam: Float[np.ndarray, "n 4 4"]
) -> None:
    """Write one camera, and the pose of each image by its name, as COLMAP documents its text model.

    Image poses are world-to-camera, quaternions wxyz, camera axes OpenCV's; the centre of the first pixel is
    (0.5, 0.5).

    Args:
        folder: Made if it is not there; `cameras.txt`, `images.txt` and `points3D.txt` are written.
        camera: Of all images.
        images: Their names (n,), without blanks and each its own.
        T_world_cam: Poses (n, 4, 4), finite.

    Raises:
        DataError: For poses with NaN, and for names that repeat or hold blanks.
        ValueError: For an array of another shape.
    """
    folder = Path(folder)
    check_shapes(images=(images, "n"), T_world_cam=(T_world_cam, "n 4 4"))
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(
            f"{folder}: expected finite poses, got NaN or infinity for {images[int(finite.argmin())]}"
        )
    for name in images:
        if not name or any(letter.isspace() for letter in name):
            raise DataError(f"{folder}: expected image names without blanks, got {name!r}")
    if len(set(images)) != len(images):
        raise DataError(f"{folder}: expected a name for each image, got the same one twice")
    folder.mkdir(parents=True, exist_ok=True)
    model, parameters = _model(camera)
    numbers = " ".join(map(repr, map(float, parameters)))
    write_text(
        folder / "cameras.txt",
        f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n1 {model} {camera.width} {camera.height} {numbers}\n",
    )
    R_cam_world = T_world_cam[:, :3, :3].swapaxes(1, 2)
    quaternion_wxyz = Rotation.from_matrix(R_cam_world).as_quat(canonical=True, scalar_first=True)
    translation = -np.einsum("nij,nj->ni", R_cam_world, T_world_cam[:, :3, 3])
    rows = np.hstack([quaternion_wxyz, translation]).tolist()
    lines = [
        f"{number} {' '.join(map(repr, row))} 1 {name}\n\n"  # the empty line: no point is seen in it
        for number, (row, name) in enumerate(zip(rows, images, strict=True), start=1)
    ]
    head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as X Y POINT3D_ID\n"
    write_text(folder / "images.txt", head + "".join(lines))
    write_text(folder / "points3D.txt", "# POINT3D_ID X Y Z R G B ERROR TRACK[]\n")


def _model(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """The least of COLMAP's camera models that holds the distortion, and its parameters."""
    pinhole = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    if not any(camera.distortion):
        return "PINHOLE", pinhole
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
    if k3 == 0:
        return "OPENCV", (*pinhole, k1, k2, p1, p2)
    return "FULL_OPENCV", (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)

"""Poses, their camera and points as a recording of rerun (`.rrd`), by its own SDK."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.timestamps import FLOAT_S, whole_ns
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry.camera import Camera, pinhole_matrix

EXTRA = 'pip install -e ".[rerun]"'
_NAME = "jaxpose"


def write_rerun(
    path: Path | str,
    trajectory: Trajectory,
    camera: Camera | None = None,
    *,
    points: Float[np.ndarray, "m 3"] | None = None,
    rgb: UInt8[np.ndarray, "m 3"] | None = None,
) -> None:
    """Write a recording of rerun. Needs the package rerun-sdk (extra `rerun`).

    `world` is a right-handed frame whose z is up, `world/camera` has its poses on the timeline `time`,
    `world/path` is the line through them. rerun holds float32: poses far from the origin lose digits.

    Args:
        path: The file, written whole or not at all.
        trajectory: Poses `T_world_cam`; those with NaN are left out.
        camera: Draws the camera's view; its distortion is not in the file, as rerun's pinhole has none.
        points: Of the scene (m, 3); None: none.
        rgb: Their colours (m, 3), given with them.

    Raises:
        DataError: Without the package.
        ValueError: For arrays of other shapes.
    """
    check_shapes(t=(trajectory.t, "n"), T=(trajectory.T, "n 4 4"))
    try:
        import rerun as rr
    except ImportError:
        raise DataError(f"{path}: a recording of rerun needs the package rerun-sdk: {EXTRA}") from None
    finite = np.isfinite(trajectory.T).all((1, 2))
    T, ns = trajectory.T[finite], np.array(whole_ns(trajectory.t[finite], trajectory.t0_ns), np.int64)
    since = "timestamp" if len(ns) and ns[0] > FLOAT_S * 1e9 else "duration"  # of a clock since 1970, or not
    unit = "datetime64[ns]" if since == "timestamp" else "timedelta64[ns]"
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    with atomic(path) as temporary:
        stream = rr.RecordingStream(_NAME, send_properties=False)
        stream.save(temporary)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("world/path", rr.LineStrips3D([T[:, :3, 3]]), static=True)
        stream.send_columns(
            "world/camera",
            indexes=[rr.TimeColumn("time", **{since: ns.view(unit)})],
            columns=rr.Transform3D.columns(translation=T[:, :3, 3], quaternion=quaternion),
        )
        if camera is not None:
            # rerun counts pixels from the outer corner of the first one, as its images do.
            K = pinhole_matrix(camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
            size, axes = [camera.width, camera.height], rr.ViewCoordinates.RDF
            pinhole = rr.Pinhole(image_from_camera=K, resolution=size, camera_xyz=axes)
            stream.log("world/camera", pinhole, static=True)
        if points is not None:
            stream.log("world/points", rr.Points3D(points, colors=rgb), static=True)
        stream.flush()
        stream.disconnect()

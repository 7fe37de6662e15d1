"""Checks of RGB-D recordings.

Files of timestamps, camera, depth, ground truth, and what of it fits together.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.inertial import check_inertial
from jaxpose.cli.check.poses import check_poses
from jaxpose.cli.check.reprojection import check_reprojection
from jaxpose.cli.check.timestamps import stamps_of
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera, angle_of_view

_STAMPS = {"tum": ("rgb.txt", "depth.txt", "groundtruth.txt"), "plain": ("times.txt",)}
_LOOKED_AT = 5  # depth images
_FEW_DEPTH = 0.1  # share of the pixels
_DEPTHS = (0.1, 50.0)  # m, of what depth cameras see
_ANGLES = (20.0, 150.0)  # degrees of view
_OFF_CENTRE = 0.15  # of the width or height


def check_recording(path: Path, form: rgbd_registry.Format, topics: Sequence[str] = ()) -> Checked:
    """Everything that is tested of a recording in the format `form`, images looked at here and there only."""
    parts = []
    for name in _STAMPS.get(form, ()):
        if (path / name).is_file():
            parts.append(stamps_of(path / name, gaps="note" if name == "groundtruth.txt" else "warning"))
    if form == "euroc":
        parts.append(check_inertial(path))
    try:
        recording = rgbd_registry.load_recording(path, form, topics=topics)
        parts += [
            Checked(notes=recording.notes),
            _frames(recording, rgbd_registry.has_timestamps(path, form)),
            check_camera(recording.camera),
        ]
        for test in (_depth, _truth, check_reprojection):
            parts.append(test(recording))
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    return join(parts)


def check_camera(camera: Camera) -> Checked:
    """Resolution, field of view, and whether the intrinsics are those of a camera with such images."""
    width, height = camera.width, camera.height
    angles = [math.degrees(angle) for angle in angle_of_view(camera)]
    off = max(abs((camera.cx + 0.5) / width - 0.5), abs((camera.cy + 0.5) / height - 0.5))
    intrinsics = f"fx fy cx cy {' '.join(f'{x:.5g}' for x in camera[:4])}"
    lens = f", lens {' '.join(f'{x:.4g}' for x in camera.distortion)}" if camera.distortion else ""
    text = f"{width}x{height}, {intrinsics}{lens}, field of view {angles[0]:.1f} x {angles[1]:.1f} deg"
    numbers = {"width": width, "height": height, "fov_x_deg": angles[0], "fov_y_deg": angles[1]}
    numbers |= dict(zip(("fx", "fy", "cx", "cy"), camera[:4], strict=True))
    if not all(_ANGLES[0] < angle < _ANGLES[1] for angle in angles) or off > _OFF_CENTRE:
        found = f"{angles[0]:.1f} x {angles[1]:.1f} deg, centre {camera.cx:.4g}, {camera.cy:.4g} "
        found += f"in {width}x{height}"
        expected = f"a field of view of {_ANGLES[0]:g} to {_ANGLES[1]:g} deg and a centre in the middle"
        fix = "check that the intrinsics are for images of this size"
        finding = Finding("warning", "intrinsics", found, expected, fix)
    else:
        finding = Finding("ok", "intrinsics", f"{angles[0]:.1f} x {angles[1]:.1f} deg, centred")
    return Checked((Fact("camera", text, numbers),), (finding,))


def _frames(recording: Recording, stamped: bool) -> Checked:
    t = recording.t
    steps = np.diff(t)
    period = float(np.median(steps)) if len(steps) else np.nan
    text = f"{len(t)}"
    numbers: dict[str, float | str] = {"count": len(t)}
    if len(steps):
        text += f" at {1 / period:.4g} Hz over {t[-1]:.4g} s, largest gap {steps.max():.3g} s"
        text += f" at {t[steps.argmax()]:.4g} s" + (
            "" if stamped else "; no timestamps, so the rate is assumed"
        )
        numbers |= {"rate_hz": 1 / period, "span_s": float(t[-1]), "largest_gap_s": float(steps.max())}
        numbers |= {"largest_gap_at_s": float(t[steps.argmax()]), "stamped": stamped}
    return Checked((Fact("frames", text, numbers),))


def _depth(recording: Recording) -> Checked:
    """How much of some images has depth, and from where to where it reaches."""
    rows = sorted({round(row) for row in np.linspace(0, len(recording.t) - 1, _LOOKED_AT)})
    depth = np.stack([recording.read(row).depth for row in rows])
    valid = depth[depth > 0]
    if not valid.size:
        found = f"none in {len(rows)} frames"
        return Checked((), (Finding("warning", "depth", found, "depth in metres", "check its scale"),))
    covered = valid.size / depth.size
    near, middle, far = (float(x) for x in np.quantile(valid, [0.01, 0.5, 0.99]))
    text = f"{covered:.0%} of the pixels, 98% of it from {near:.3g} to {far:.3g} m, median {middle:.3g} m "
    text += f"({len(rows)} frames)"
    numbers = {"coverage": covered, "near_m": near, "median_m": middle, "far_m": far}
    finding = Finding("ok", "depth", f"{covered:.0%} of the pixels, median {middle:.3g} m")
    if not _DEPTHS[0] < middle < _DEPTHS[1]:
        expected = f"a median of {_DEPTHS[0]:g} to {_DEPTHS[1]:g} m"
        finding = Finding("warning", "depth", f"{middle:.3g} m", expected, "check the depth scale")
    elif covered < _FEW_DEPTH:
        expected = f"depth in {_FEW_DEPTH:.0%} of the pixels"
        finding = Finding("warning", "depth", f"{covered:.1%}", expected, "check which pixels count as none")
    return Checked((Fact("depth", text, numbers),), (finding,))


def _truth(recording: Recording) -> Checked:
    if recording.T_world_cam is None:
        return Checked((Fact("ground_truth", "none", {"coverage": 0.0}),))
    finite = np.asarray(np.isfinite(recording.T_world_cam).all((1, 2)))
    t = recording.t[finite]
    text = f"{finite.sum()} of {len(finite)} frames have a pose, from {t[0]:.4g} to {t[-1]:.4g} s"
    fact = Fact("ground_truth", text, {"coverage": float(finite.mean()), "poses": int(finite.sum())})
    return join([Checked((fact,)), check_poses(t, recording.T_world_cam[finite])])

"""`jaxpose check` on RGB-D recordings: faults put into one that is right, each named."""

from typing import NamedTuple

import numpy as np
import pytest
from helpers.checks import FLIP, T0, T0_NS, checked, faults, flipped, inverted, named_tests
from scipy.spatial.transform import Rotation

from jaxpose.cli.check.command import exit_code, report


class Clip(NamedTuple):
    """A few frames with exact depth [m]."""

    camera: tuple
    t: np.ndarray
    depth: np.ndarray
    T_world_cam: np.ndarray


@pytest.fixture(scope="module")
def clip():
    """A camera in a room of 5 x 4 x 2.6 m with three balls in it, turning and walking; exact depth."""
    t = np.arange(21) / 4
    T = np.tile(np.eye(4), (21, 1, 1))
    turn = Rotation.from_euler("xyz", np.stack([0.15 * np.sin(2 * t), 0.35 * t, 0.1 * np.cos(t)], -1))
    T[:, :3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ turn.as_matrix()
    T[:, :3, 3] = np.stack([0.8 * np.sin(0.5 * t), 0.6 * np.cos(0.7 * t), 1.3 + 0.2 * np.sin(t)], -1)
    camera = (73.0, 73.0, 39.5, 29.5)
    v, u = np.mgrid[0:60, 0:80]
    rays = np.stack([(u - 39.5) / 73, (v - 29.5) / 73, np.ones((60, 80))], axis=-1)
    return Clip(camera, t, np.stack([cast(pose[:3, 3], rays @ pose[:3, :3].T) for pose in T]), T)


def cast(origin, rays):
    """How many times each ray reaches from the origin to the room's walls or a ball."""
    low, high = np.array([-2.5, -2, 0]), np.array([2.5, 2, 2.6])
    with np.errstate(divide="ignore"):
        reach = np.where(rays > 0, (high - origin) / rays, (low - origin) / rays).min(-1)
    for centre, radius in (([1.7, 1.2, 0.6], 0.6), ([-1.6, 1.3, 1.5], 0.5), ([1.8, -1.2, 1.2], 0.5)):
        to = np.array(centre) - origin
        along, size = rays @ to, (rays**2).sum(-1)
        root = along**2 - size * (to @ to - radius**2)
        hit = (along - np.sqrt(np.maximum(root, 0))) / size
        reach = np.where((root > 0) & (hit > 0), np.minimum(reach, hit), reach)
    return reach


def write_images(folder, clip, save, per_metre):
    grey = np.full((*clip.depth.shape[1:], 3), 128, np.uint8)
    for i, depth in enumerate(clip.depth):
        save(folder / f"color/{i}.png", grey)
        save(folder / f"depth/{i}.png", np.round(depth * per_metre).astype(np.uint16))
    fx, fy, cx, cy = clip.camera[:4]
    (folder / "camera-intrinsics.txt").write_text(f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")


def plain(folder, clip, save, *, change=lambda T: T, per_metre=1000.0, seconds=1.0):
    """A folder of the plain layout, whose depth is read as mm."""
    write_images(folder, clip, save, per_metre)
    np.savetxt(folder / "poses.txt", change(clip.T_world_cam).reshape(-1, 16))
    np.savetxt(folder / "times.txt", (T0 + clip.t) * seconds, fmt="%.9g" if seconds == 1 else "%.0f")
    if seconds == 1:
        np.savetxt(folder / "times.txt", T0 + clip.t, fmt="%.6f")
    return folder


def tum(folder, clip, save, *, per_metre=5000.0, order=(0, 1, 2, 3), seconds=1.0):
    """A folder of TUM's layout, `order` of the quaternion's columns, timestamps in units of `seconds`."""
    write_images(folder, clip, save, per_metre)
    timestamps = [
        f"{(T0 + t) / seconds:.6f}" if seconds == 1 else f"{T0_NS + round(t * 1e9)}" for t in clip.t
    ]
    for kind, name in (("color", "rgb"), ("depth", "depth")):
        lines = [f"{timestamp} {kind}/{i}.png" for i, timestamp in enumerate(timestamps)]
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    quaternions = Rotation.from_matrix(clip.T_world_cam[:, :3, :3]).as_quat()[:, list(order)]
    rows = np.column_stack([clip.T_world_cam[:, :3, 3], quaternions])
    lines = [" ".join([timestamp, *map(str, row)]) for timestamp, row in zip(timestamps, rows, strict=True)]
    (folder / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_a_good_recording_has_no_fault(tmp_path, clip, save):
    result = checked(plain(tmp_path, clip, save))
    assert result.format == "RGB-D recording (plain)" and faults(result) == "" and exit_code(result) == 0
    numbers = {fact.name: fact.numbers for fact in result.facts}
    assert numbers["frames"]["count"] == 21 and numbers["frames"]["rate_hz"] == pytest.approx(4)
    assert (
        numbers["times.txt"]["first_stamp_s"] == pytest.approx(T0)
        and numbers["ground_truth"]["coverage"] == 1
    )
    assert numbers["camera"]["fov_x_deg"] == pytest.approx(np.degrees(2 * np.arctan(40 / 73)))
    assert numbers["depth"]["coverage"] == 1
    assert numbers["depth"]["median_m"] == pytest.approx(np.median(clip.depth[::5]), rel=0.01)
    assert "OpenCV axes, and the depth's scale fit" in report(result)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ({"change": inverted}, "world-to-camera poses, OpenCV axes"),
        ({"change": flipped}, "camera-to-world poses, OpenGL axes"),
        ({"change": lambda T: FLIP @ np.linalg.inv(T)}, "world-to-camera poses, OpenGL axes"),
        (
            {"per_metre": 5000.0},
            "depth scale 5000 for 1000 (depth is 5 times too large); multiply the depth by 0.2",
        ),
        ({"per_metre": 200.0}, "5 times too small; multiply the depth by 5"),
        ({"per_metre": 1310.7}, "depth scale 6553.5 for 5000; multiply the depth by 0.763"),
        (
            {"per_metre": 5000.0, "change": inverted},
            "world-to-camera poses, OpenCV axes and depth scale 5000",
        ),
    ],
)
def test_conventions_and_scales_are_named(tmp_path, clip, save, fault, named):
    result = checked(plain(tmp_path, clip, save, **fault))
    assert named_tests(result) == ["poses and depth"] and exit_code(result) == 2
    words = faults(result).replace(": so", ";")
    assert all(part in words for part in named.split("; ")), words


def test_poses_of_other_frames_fit_no_convention(tmp_path, clip, save):
    generator = np.random.default_rng(0)
    turned = Rotation.random(len(clip.t), rng=generator).as_matrix()
    T = np.tile(np.eye(4), (len(clip.t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turned, generator.normal(size=(len(clip.t), 3))
    result = checked(plain(tmp_path, clip, save, change=lambda _: T))
    assert "no other convention fits" in faults(result)


def test_tum_in_its_own_conventions_and_in_others(tmp_path, clip, save):
    assert faults(checked(tum(tmp_path / "good", clip, save))) == ""
    result = checked(tum(tmp_path / "mm", clip, save, per_metre=1000.0))
    assert "depth scale 1000 for 5000" in faults(result)
    result = checked(tum(tmp_path / "order", clip, save, order=(3, 0, 1, 2)))
    assert "quaternions in the order wxyz, read as xyzw" in faults(result)
    result = checked(tum(tmp_path / "ns", clip, save, seconds=1e-9))
    assert faults(result) == ""  # the lists are read in the unit that they are in


def test_a_gap_in_the_frames_is_found_where_it_is(tmp_path, clip, save):
    folder = plain(tmp_path, clip, save)
    late = np.where(np.arange(21) > 9, 3.0, 0.0)
    np.savetxt(folder / "times.txt", T0 + clip.t + late, fmt="%.6f")
    result = checked(folder)
    assert "gaps" in named_tests(result) and "3.25 s at 2.25 s" in faults(result)


def test_what_a_loader_refuses_is_unusable(tmp_path, clip, save):
    folder = plain(tmp_path, clip, save)
    (folder / "poses.txt").write_text("1 2 3\n")
    result = checked(folder)
    assert exit_code(result) == 1 and "poses.txt:1" in faults(result)
    assert "unusable" in report(result)


def test_a_camera_at_rest_tells_nothing(tmp_path, clip, save):
    still = clip._replace(depth=clip.depth[[0] * 21], T_world_cam=clip.T_world_cam[[0] * 21])
    result = checked(plain(tmp_path, still, save))
    assert faults(result) == "" and any("moves too little" in note for note in result.notes)

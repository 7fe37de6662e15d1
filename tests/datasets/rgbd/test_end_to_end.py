"""A run of SLAM, shrunk to seconds, on each kind of recording: bags, videos, archives, folders, lists."""

import json
from typing import NamedTuple

import numpy as np
import pytest
from helpers import phones
from helpers.ros_bags import Maker, Message
from scipy.spatial.transform import Rotation

from jaxpose.experiments.rgbd_slam import main

K = (60.0, 60.0, 39.5, 29.5)
LOWER, UPPER = np.array([-2.0, -1.5, -1.0]), np.array([2.0, 1.5, 3.0])


class Walk(NamedTuple):
    """Frames of a room in closed form, as the fixture of this name has them."""

    rgb: np.ndarray
    counts: np.ndarray
    T_world_cam: np.ndarray


@pytest.fixture(scope="module")
def room():
    """Eight frames of 80 x 60 in a box whose colour is a function of place: 4 cm and 2 degrees a frame."""
    v, u = np.mgrid[0:60, 0:80]
    ray = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones((60, 80))], axis=-1)
    rgb, counts, poses = [], [], np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(8), [0.01, 0.035, 0])).as_matrix()
    poses[:, :3, 3] = np.outer(np.arange(8), [0.03, 0.01, 0.02])
    for T in poses:
        direction = ray @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = np.where(direction > 0, UPPER - T[:3, 3], LOWER - T[:3, 3]) / direction
        depth = np.min(np.where(np.isfinite(depth), depth, np.inf), axis=-1)
        point = T[:3, 3] + depth[..., None] * direction
        rgb.append((255 * (0.5 + 0.4 * np.sin(3 * point))).astype(np.uint8))
        counts.append(np.round(1000 * depth).astype(np.uint16))
    return Walk(np.stack(rgb), np.stack(counts), poses)


def bag(kind):
    def write(folder, walk, save):
        make, rows = Maker(kind), []
        for k in range(8):
            ns, frame = 10**18 + k * 10**8, "camera"
            contents = {
                "/color": make.image(ns, frame, "bgr8", walk.rgb[k][..., ::-1]),
                "/depth": make.image(ns, frame, "16UC1", walk.counts[k]),
                "/camera_info": make.camera_info(ns, frame, K, (80, 60)),
                "/pose": make.pose_stamped(ns, "world", walk.T_world_cam[k]),
            }
            kinds = ("sensor_msgs/msg/Image",) * 2 + (
                "sensor_msgs/msg/CameraInfo",
                "geometry_msgs/msg/PoseStamped",
            )
            rows += [Message(t, k, ns, c) for (t, c), k in zip(contents.items(), kinds, strict=True)]
        return make.write(folder, rows)

    return write


def plain(folder, walk, save):
    for k in range(8):
        save(folder / f"rgb/{k:04d}.png", walk.rgb[k])
        save(folder / f"depth/{k}.png", walk.counts[k])
    matrix = [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]
    text = json.dumps({"width": 80, "height": 60, "intrinsic_matrix": matrix})
    (folder / "camera_intrinsic.json").write_text(text)
    np.savetxt(folder / "poses.txt", walk.T_world_cam.reshape(8, 16))
    return folder


def nerfstudio(folder, walk, save):
    frames = []
    for k in range(8):
        save(folder / f"images/{k}.png", walk.rgb[k])
        save(folder / f"depth/{k}.png", walk.counts[k])
        pose = (walk.T_world_cam[k] @ phones.FLIP).tolist()
        frames.append(
            {"file_path": f"images/{k}", "depth_file_path": f"depth/{k}.png", "transform_matrix": pose}
        )
    camera = {"fl_x": K[0], "fl_y": K[1], "cx": K[2] + 0.5, "cy": K[3] + 0.5}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return folder


def sun3d(folder, walk, save):
    for k in range(8):
        name = f"{k:07d}-{100_000 * k:012d}"
        save(folder / f"image/{name}.png", walk.rgb[k])
        save(folder / f"depth/{name}.png", (walk.counts[k] << 3) | (walk.counts[k] >> 13))
    (folder / "intrinsics.txt").write_text(f"{K[0]} 0 {K[2]}\n0 {K[1]} {K[3]}\n0 0 1\n")
    (folder / "extrinsics").mkdir()
    np.savetxt(folder / "extrinsics/1.txt", walk.T_world_cam[:, :3].reshape(24, 4))
    return folder


def tum(folder, walk, save):
    lines = {"rgb": [], "depth": [], "groundtruth": []}
    for k in range(8):
        t = f"{1548339828 + k / 10:.4f}"
        save(folder / f"rgb/{t}.png", walk.rgb[k])
        save(folder / f"depth/{t}.png", 5 * walk.counts[k])
        T = walk.T_world_cam[k]
        lines["rgb"].append(f"{t} rgb\\{t}.PNG")
        lines["depth"].append(f"{t} ./depth/{t}.png")
        row = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
        lines["groundtruth"].append(" ".join([t, *(f"{x:.9f}" for x in row)]))
    for name, rows in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
    (folder / "calibration.txt").write_text(" ".join(map(str, K)))
    return folder


KINDS = {
    "ros1": bag("ros1"),
    "mcap": bag("mcap"),
    "sqlite3": bag("sqlite3"),
    "stray_scanner": lambda folder, walk, save: phones.stray_scanner(folder, walk, save, K=K),
    "record3d": lambda folder, walk, save: phones.record3d(folder / "a.r3d", walk, K=K),
    "arkitscenes": lambda folder, walk, save: phones.arkitscenes(folder, walk, save, K=K),
    "polycam": lambda folder, walk, save: phones.polycam(folder, walk, save, K=K),
    "nerfstudio": nerfstudio,
    "sun3d": sun3d,
    "eth3d": tum,
    "open3d": plain,
}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS])
def test_slam_runs_on_each_kind(tmp_path, room, save, capsys, kind):
    """The box is tracked to centimetres even by a run that is shrunk: axes, lens and scale are right."""
    (tmp_path / "data").mkdir()
    path = KINDS[kind](tmp_path / "data", room, save)
    main(["--data", str(path), "--smoke", "--out", str(tmp_path / "run"), "--json"])
    results = json.loads(capsys.readouterr().out)["results"]
    assert results["ate_rmse_m"] < 0.05, results["ate_rmse_m"]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data", "run"]

"""More of what is fuzzed: bags, captures of phones and scanners, files of event cameras, maps and settings.

The folders are written by the writers that the readers' own tests use.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from helpers import event_writers, phones
from helpers.ros_bags import Maker, Message
from PIL import Image

from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.photos import colmap as colmap_photographs
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.experiments.checks import own_folder
from jaxpose.experiments.slam.map_file import read_map, write_map
from jaxpose.scenes.voxel_blocks import CHANNELS, NODES, BlockConfig, unpacked
from jaxpose.slam import SavedMap
from jaxpose.slam.map.texture import SIDE, Texture
from jaxpose.slam.tracking.features import Features

COUNT, WIDTH, HEIGHT = 4, 16, 12
K = (15.0, 15.5, 7.5, 5.5)
NS = 1403715523912140001
SIZE = (640, 480)


class Walk(NamedTuple):
    """Frames with poses."""

    rgb: np.ndarray
    counts: np.ndarray  # depth [mm]
    T_world_cam: np.ndarray


def _walk() -> Walk:
    rows = np.arange(COUNT * WIDTH * HEIGHT).reshape(COUNT, HEIGHT, WIDTH)
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    angle = 0.1 * np.arange(COUNT)
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
    T[:, 1, 0], T[:, 0, 1] = np.sin(angle), -np.sin(angle)
    T[:, :3, 3] = np.arange(3 * COUNT).reshape(COUNT, 3) / 10
    return Walk(np.stack([rows % 256] * 3, -1).astype(np.uint8), (1000 + rows).astype(np.uint16), T)


def _save(file: Path, pixels: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file)


def _recording(folder: Path) -> Any:
    recording = rgbd_registry.load_recording(folder)
    frames = [recording.read(k) for k in (0, len(recording.t) - 1)]
    return recording.t, recording.T_body_cam, recording.camera[:4], [f.depth for f in frames], recording.imu


# --- captures of phones and scanners ----------------------------------------------------------------------


def _record3d(folder: Path) -> None:
    phones.record3d(folder / "a.r3d", _walk(), K=K)


def _open3d(folder: Path) -> None:
    walk, blocks = _walk(), []
    for k, T in enumerate(walk.T_world_cam):
        _save(folder / f"color/{k:06d}.jpg", walk.rgb[k])
        _save(folder / f"depth/{k:06d}.png", walk.counts[k])
        blocks.append(f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(str, row)) for row in T))
    fx, fy, cx, cy = K
    matrix = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    content = {"width": WIDTH, "height": HEIGHT, "depth_scale": 1000, "intrinsic_matrix": matrix}
    (folder / "camera_intrinsic.json").write_text(json.dumps(content))
    (folder / "trajectory.log").write_text("\n".join(blocks) + "\n")


def _nerfstudio(folder: Path) -> None:
    walk, frames = _walk(), []
    for k, T in enumerate(walk.T_world_cam @ phones.FLIP):
        _save(folder / f"images/{k}.png", walk.rgb[k])
        _save(folder / f"depth/{k}.png", walk.counts[k])
        names = {"file_path": f"images/{k}.png", "depth_file_path": f"depth/{k}.png"}
        frames.append({**names, "timestamp": k / 10, "transform_matrix": T.tolist()})
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), K, strict=True)) | {"w": WIDTH, "h": HEIGHT, "k1": 0.1}
    (folder / "transforms.json").write_text(
        json.dumps({**camera, "camera_model": "OPENCV", "frames": frames})
    )


def _colmap(folder: Path) -> None:
    walk, lines = _walk(), []
    for k, T in enumerate(walk.T_world_cam):
        _save(folder / f"images/{k}.png", walk.rgb[k])
        lines.append(f"{k + 1} 1 0 0 0 {' '.join(map(str, T[:3, 3]))} 1 {k}.png\n1.5 2.5 1 3.5 4.5 -1\n")
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 16 12 15 15 8 6 0.1 0 0 0\n")
    (model / "images.txt").write_text("# images\n" + "".join(lines))
    (model / "points3D.txt").write_text(
        "1 0.5 0.5 2 10 20 30 0.5 1 0 2 0\n2 0.1 0.2 3 10 20 30 0.5 1 0 2 0\n"
    )


def _photographs(folder: Path) -> Any:
    return [
        (part.T_world_cam, part.t, part.near, part.far, part.camera[:4])
        for part in colmap_photographs.load(folder)
    ]


def _bag(kind: str, folder: Path) -> None:
    make, walk, rows = Maker(kind), _walk(), []
    optical, body = "camera_color_optical_frame", "base_link"
    image, topic = "sensor_msgs/msg/Image", "/camera/aligned_depth_to_color/image_raw"
    for k, T in enumerate(walk.T_world_cam):
        at = NS + 50_000_000 * k
        color = make.image(at, optical, "rgb8", walk.rgb[k])
        info = make.camera_info(at, optical, K, (WIDTH, HEIGHT), D=(0.1, -0.05, 0.001, 0.002, 0.01))
        rows.append(Message("/camera/color/image_raw", image, at, color))
        rows.append(Message(topic, image, at + 1, make.image(at, optical, "16UC1", walk.counts[k])))
        rows.append(Message("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", at, info))
        rows.append(Message("/odom", "nav_msgs/msg/Odometry", at, make.odometry(at, "odom", body, T)))
    rows.append(Message("/tf_static", "tf2_msgs/msg/TFMessage", NS, make.tf(NS, body, optical, np.eye(4))))
    for k in range(20):
        at = NS + 10_000_000 * k
        rows.append(Message("/imu", "sensor_msgs/msg/Imu", at, make.imu(at, body, (0, 0, 0.1), (0, 0, 9.8))))
    make.write(folder, rows)


# --- files of event cameras -------------------------------------------------------------------------------


def _rows() -> np.ndarray:
    k = np.arange(120)
    return np.column_stack([20 * k, k % 640, 3 * k % 480, k % 2])


def _events(folder: Path) -> Any:
    file = next((path for path in folder.iterdir() if path.stem == "recording"), folder)
    found = event_registry.load_events(file)
    return found.events.t, found.camera[:4]


def _file(suffix: str, content: Callable[[np.ndarray], bytes], folder: Path) -> None:
    (folder / f"recording.{suffix}").write_bytes(content(_rows()))


_EVENT_FILES: dict[str, tuple[str, Callable[[np.ndarray], bytes]]] = {
    "evt2": ("raw", lambda rows: b"% evt 2.0\n% geometry 640x480\n% end\n" + event_writers.evt2(rows)),
    "evt21": (
        "raw",
        lambda rows: b"% evt 2.1\n% geometry 640x480\n% end\n" + event_writers.evt21(rows, swapped=False),
    ),
    "evt3": ("raw", lambda rows: b"% evt 3.0\n% geometry 640x480\n% end\n" + event_writers.evt3(rows)),
    "dat": (
        "dat",
        lambda rows: b"% Version 2\n% Height 480\n% Width 640\n" + event_writers.dat(rows),
    ),
    "es": ("es", lambda rows: event_writers.es(rows, SIZE)),
    "csv": (
        "csv",
        lambda rows: b"t [us],x,y,p\n" + b"".join(b"%d,%d,%d,%d\n" % tuple(row) for row in rows.tolist()),
    ),
}


def _aedat4(folder: Path) -> None:
    import dv_processing as dv

    options = dv.io.MonoCameraWriter.EventOnlyConfig("DAVIS", (346, 260))
    writer, store = dv.io.MonoCameraWriter(str(folder / "recording.aedat4"), options), dv.EventStore()
    for t, x, y, p in _rows().tolist():
        store.push_back(1_700_000_000_000_000 + t, x % 346, y % 260, bool(p))
    writer.writeEvents(store)


def _table(named: bool, folder: Path) -> None:
    import h5py

    table = _rows()
    if named:
        kind = np.dtype([("timestamp", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])
        table = np.array([tuple(row) for row in table.tolist()], kind)
    with h5py.File(folder / "recording.h5", "w") as content:
        content["events"] = table


# --- files of runs ----------------------------------------------------------------------------------------


def _map(folder: Path) -> None:
    config, coords = BlockConfig(0.05, 0.2), np.array([[0, 0, 0], [1, 0, 0]])
    values = np.full((2, NODES, NODES, NODES, CHANNELS), 1000, np.int16)
    slot = np.zeros(16, np.int32)
    texture = Texture(slot, np.zeros((1, SIDE, SIDE, SIDE, 4), np.uint8))
    few = Features(np.ones((2, 3)), np.ones(2), np.ones(2), np.zeros((2, 32), np.uint8))
    poses, blocks = np.tile(np.eye(4), (3, 1, 1)), unpacked(config, coords, values)
    saved = SavedMap(config, blocks, texture, np.arange(3), poses, (few, few, few), (1.0, 0.02))
    write_map(folder / "map.npz", saved)


def _read_map(folder: Path) -> Any:
    saved = read_map(folder / "map.npz")
    features = [(f.direction_cam, f.depth, f.scale) for f in saved.features]
    known = saved.T_world_cam, np.asarray(saved.usual), *sum(features, ())
    return saved.config.voxel, np.asarray(saved.blocks.values), np.asarray(saved.keyframes), *known


_SETTINGS = {"seed": 0, "field": {"width": 64, "rates": [1.0, 2.0]}, "data": "room"}


def _settings(folder: Path) -> None:
    (folder / "settings.json").write_text(json.dumps(_SETTINGS))
    (folder / "results.json").write_text("{}")


def _resumed(folder: Path) -> Any:
    return own_folder(folder, folder / "settings.json", _SETTINGS, True, "results.json")


Writer, Reader = Callable[[Path], None], Callable[[Path], Any]
CAPTURES: dict[str, tuple[Writer, Reader]] = {
    "stray_scanner": (lambda folder: phones.stray_scanner(folder, _walk(), _save, K=K) and None, _recording),
    "record3d": (_record3d, lambda folder: _recording(folder / "a.r3d")),
    "polycam": (lambda folder: phones.polycam(folder, _walk(), _save, K=K) and None, _recording),
    "arkitscenes": (lambda folder: phones.arkitscenes(folder, _walk(), _save, K=K) and None, _recording),
    "open3d": (_open3d, _recording),
    "nerfstudio": (_nerfstudio, _recording),
    "colmap_photographs": (_colmap, _photographs),
    "ros1": (partial(_bag, "ros1"), lambda folder: _recording(folder / "walk.bag")),
    "ros2_sqlite3": (partial(_bag, "sqlite3"), lambda folder: _recording(folder / "walk")),
    "ros2_mcap": (partial(_bag, "mcap"), lambda folder: _recording(folder / "walk")),
    **{f"events_{name}": (partial(_file, *of), _events) for name, of in _EVENT_FILES.items()},
    "events_aedat4": (_aedat4, _events),
    "events_table": (partial(_table, False), _events),
    "events_named_table": (partial(_table, True), _events),
    "map": (_map, _read_map),
    "settings": (_settings, _resumed),
}

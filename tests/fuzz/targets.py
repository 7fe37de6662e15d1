"""What is fuzzed: for each reader a small folder that it reads, and how it is called."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from captures import CAPTURES
from PIL import Image

from jaxpose.cli.check import command as check
from jaxpose.cli.source import read_field, read_source
from jaxpose.cli.view.scene import read_scene
from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.photos import blender, llff
from jaxpose.datasets.photos.sigmas import read_sigmas, write_sigmas
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.datasets.rgbd.imu_csv import read_imu, read_mounting
from jaxpose.experiments.noisy_nerf import registration
from jaxpose.fields import serialization
from jaxpose.files import checkpoint, colmap, ply, trajectories
from jaxpose.files.camera_json import read_camera, write_camera
from jaxpose.files.kalibr import CameraImu, write_camchain
from jaxpose.geometry.camera import Camera

COUNT, WIDTH, HEIGHT = 5, 16, 12
CAMERA = Camera(15.0, 15.0, 7.5, 5.5, WIDTH, HEIGHT)
_NAMES = tuple(f"{k}.png" for k in range(COUNT))
_BOX = (0.0, 0.0, 2.0), (1.0, 1.0, 1.0)
NS = 1403715523912140001


class Target(NamedTuple):
    """A reader."""

    write: Callable[[Path], None]  # a folder that it reads
    read: Callable[[Path], Any]  # reads the folder; the numbers of what it returns are finite


def _poses() -> np.ndarray:
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    angle = 0.1 * np.arange(COUNT)
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
    T[:, 1, 0], T[:, 0, 1] = np.sin(angle), -np.sin(angle)
    T[:, :3, 3] = np.arange(3 * COUNT).reshape(COUNT, 3) / 10
    return T


def _trajectory() -> trajectories.Trajectory:
    return trajectories.Trajectory(np.arange(COUNT) / 10, _poses())


def _image(file: Path, depth: bool = False) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    pixels = (1000 + rows).astype(np.uint16) if depth else np.stack([rows % 256] * 3, -1).astype(np.uint8)
    Image.fromarray(pixels).save(file)


def _rows(file: Path, rows: Any, before: str = "", separator: str = " ") -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [separator.join(str(x) for x in row) for row in rows]
    file.write_text(before + "\n".join(lines) + "\n")


def _matrix(file: Path, size: int = 3) -> None:
    K = np.eye(size)
    K[0, 0] = K[1, 1] = 15
    K[0, 2], K[1, 2] = 7.5, 5.5
    _rows(file, K)


# --- recordings -------------------------------------------------------------------------------------------


def _sevenscenes(folder: Path) -> None:
    for k, T in enumerate(_poses()):
        _image(folder / f"frame-{k:06d}.color.png")
        _image(folder / f"frame-{k:06d}.depth.png", depth=True)
        _rows(folder / f"frame-{k:06d}.pose.txt", T)
    _matrix(folder / "camera-intrinsics.txt")


def _tum(folder: Path) -> None:
    for kind in ("rgb", "depth"):
        for k in range(COUNT):
            _image(folder / kind / f"{k}.png", kind == "depth")
        _rows(folder / f"{kind}.txt", [(k / 10, f"{kind}/{k}.png") for k in range(COUNT)], "# list\n")
    _matrix(folder / "camera-intrinsics.txt")
    trajectories.write_tum(folder / "groundtruth.txt", _trajectory())
    _rows(
        folder / "accelerometer.txt", [(k / 50, 0.1, -9.8, 0.2) for k in range(5 * COUNT)], "# t ax ay az\n"
    )


def _replica(folder: Path) -> None:
    for k in range(COUNT):
        _image(folder / f"results/frame{k:06d}.jpg")
        _image(folder / f"results/depth{k:06d}.png", depth=True)
    _rows(folder / "traj.txt", _poses().reshape(-1, 16))
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 15, "fy": 15, "cx": 7.5, "cy": 5.5, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))


def _scannet(folder: Path) -> None:
    for k, T in enumerate(_poses()):
        _image(folder / f"color/{k}.jpg")
        _image(folder / f"depth/{k}.png", depth=True)
        _rows(folder / f"pose/{k}.txt", T)
    _matrix(folder / "intrinsic/intrinsic_depth.txt", 4)


def _icl(folder: Path) -> None:
    for k in range(COUNT):
        _image(folder / f"rgb/{k}.png")
        _image(folder / f"depth/{k}.png", depth=True)
    _rows(folder / "associations.txt", [(k, f"depth/{k}.png", k, f"rgb/{k}.png") for k in range(COUNT)])
    trajectories.write_tum(
        folder / "groundtruth.txt", trajectories.Trajectory(np.arange(1.0, COUNT + 1), _poses())
    )


def _plain(folder: Path) -> None:
    for k in range(COUNT):
        _image(folder / f"color/{k}.png")
        _image(folder / f"depth/{k}.png", depth=True)
    (folder / "intrinsics.json").write_text(
        json.dumps(
            {"fx": 15, "fy": 15, "cx": 7.5, "cy": 5.5, "width": WIDTH, "height": HEIGHT, "depth_scale": 1000}
        )
    )
    _rows(folder / "times.txt", [(k / 10,) for k in range(COUNT)])
    trajectories.write_tum(folder / "poses.txt", _trajectory())


def _sheet(file: Path, camera: bool) -> None:
    data = ", ".join(str(float(x)) for x in np.eye(4).ravel())
    text = f"%YAML:1.0\n# a sheet\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
    if camera:
        text += (
            f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [15.0, 15.0, 7.5, 5.5]\n"
        )
        text += "distortion_model: radial-tangential\ndistortion_coefficients: [0.1, 0.01, 0.0, 0.0]\n"
    else:
        text += "gyroscope_noise_density: 1.7e-04\ngyroscope_random_walk: 1.9e-05\n"
        text += "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def _euroc(folder: Path) -> None:
    mav0, stamps = folder / "mav0", [NS + 100_000_000 * k for k in range(COUNT)]
    for name in ("cam0", "depth0"):
        for stamp in stamps:
            _image(mav0 / name / "data" / f"{stamp}.png", name == "depth0")
        _rows(mav0 / name / "data.csv", [(s, f"{s}.png") for s in stamps], "#timestamp [ns],filename\n", ",")
    _sheet(mav0 / "cam0/sensor.yaml", True)
    _sheet(mav0 / "depth0/sensor.yaml", True)
    _sheet(mav0 / "imu0/sensor.yaml", False)
    readings = [(NS + 10_000_000 * k, 0, 0, 0.1, 0, 0.1, 9.8) for k in range(-2, 10 * COUNT)]
    _rows(mav0 / "imu0/data.csv", readings, "#timestamp\n", ",")
    truth = [(NS + 10_000_000 * k, k / 9, 0, 1, 1, 0, 0, 0, *[0.0] * 9) for k in range(-2, 10 * COUNT)]
    _rows(mav0 / "state_groundtruth_estimate0/data.csv", truth, "#timestamp\n", ",")


def _recording(folder: Path) -> Any:
    recording = rgbd_registry.load_recording(folder)
    frames = [recording.read(k) for k in (0, len(recording.t) - 1)]
    return recording.t, recording.T_body_cam, recording.camera[:4], [f.depth for f in frames], recording.imu


# --- photographs and events -------------------------------------------------------------------------------


def _blender(folder: Path) -> None:
    frames = [
        {"file_path": f"r_{k}", "time": k / 10, "transform_matrix": T.tolist()}
        for k, T in enumerate(_poses())
    ]
    for split in ("train", "test", "val"):
        (folder / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": 0.9, "frames": frames})
        )
    for k in range(COUNT):
        _image(folder / f"r_{k}.png")


def _llff(folder: Path) -> None:
    columns = np.concatenate([_poses()[:, :3], np.tile([[[12.0], [16.0], [15.0]]], (COUNT, 1, 1))], axis=-1)
    np.save(
        folder / "poses_bounds.npy", np.hstack([columns.reshape(COUNT, 15), np.tile([1.0, 9.0], (COUNT, 1))])
    )
    for k in range(COUNT):
        _image(folder / f"images/{k}.png")


def _photographs(load: Callable, folder: Path) -> Any:
    return [
        (part.T_world_cam, part.t, part.rgb, part.near, part.far, part.camera[:4]) for part in load(folder)
    ]


def _sidecars(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    _rows(folder / "calib.txt", [(200.0, 200.0, 119.5, 89.5, 0.1, 0, 0, 0, 0)])
    T = _poses()
    trajectories.write_tum(folder / "poses.txt", trajectories.Trajectory(np.arange(COUNT) / 500 - 0.001, T))


def _columns() -> dict[str, np.ndarray]:
    k = np.arange(60)
    return {"t": 20 * k, "x": k % 240, "y": 2 * k % 180, "p": k % 2}


def _event_npz(folder: Path) -> None:
    _sidecars(folder)
    np.savez_compressed(folder / "events.npz", **_columns())


def _event_hdf5(folder: Path) -> None:
    import h5py

    _sidecars(folder)
    with h5py.File(folder / "events.h5", "w") as content:
        for name, values in _columns().items():
            content.create_dataset(f"events/{name}", data=values, chunks=(20,), compression="gzip")
        content["t_offset"] = 10**6


def _davis(folder: Path) -> None:
    _sidecars(folder)
    _rows(
        folder / "events.txt", [(t * 1e-6, x, y, p) for t, x, y, p in zip(*_columns().values(), strict=True)]
    )


def _eventnerf(folder: Path) -> None:
    for k, T in enumerate(_poses()):
        _rows(folder / f"train/pose/r_{k:05d}.txt", [T.ravel()])
        K = np.eye(4)
        K[0, 0] = K[1, 1] = 200
        K[0, 2], K[1, 2] = 120, 90
        _rows(folder / f"train/intrinsics/r_{k:05d}.txt", [K.ravel()])
    (folder / "train/events").mkdir()
    np.savez(folder / "train/events/e.npz", **_columns())


def _events(folder: Path) -> Any:
    found = event_registry.load_events(folder)
    return found.events.t, found.T_world_cam, found.t, found.camera[:4]


# --- files of runs and of others ----------------------------------------------------------------------------


def _field(kind: str, folder: Path) -> None:
    entries: dict[str, Any] = {
        "version": 1,
        "span": [0.0, 0.4],
        "count": 1,
        "0.kind": kind,
        "0.span": [0.0, 0.4],
    }
    if kind == "bspline":
        entries["0.control_points"] = np.arange(49.0).reshape(7, 7) / 100
    elif kind == "posenet":
        entries |= {
            "0.weights": np.ones(2),
            "0.activation": "relu",
            "0.head": "paper",
            "0.translation_scale": 1.0,
        }
        for network, outputs in (("translation", 3), ("rotation", 4)):
            entries |= {f"0.{network}.0.kernel": np.ones((5, 6)), f"0.{network}.0.bias": np.ones(6)}
            entries |= {
                f"0.{network}.1.kernel": np.ones((11, outputs)),
                f"0.{network}.1.bias": np.ones(outputs),
            }
    else:
        entries |= {"0.times": np.arange(COUNT) / 10, "0.poses": _poses()}
    entries |= {"covariance_times": [0.0, 0.4], "covariance": np.tile(np.eye(6), (2, 1, 1))}
    np.savez(folder / "field.npz", **entries)
    trajectories.write_tum(folder / "trajectory.txt", _trajectory())


def _read_field(folder: Path) -> Any:
    return read_field(read_source(folder))(np.linspace(-0.1, 0.5, 7))


def _load_field(folder: Path) -> Any:
    field, params = serialization.load(folder / "field.npz")
    return field.span, params


def _run(folder: Path) -> None:
    _field("stamped", folder)
    for k in range(COUNT):
        _image(folder / f"images/{k}.png")
    write_camera(folder / "camera.json", CAMERA, tuple(f"{k}.png" for k in range(COUNT)), "images")
    trajectories.write_tum(folder / "reference.txt", _trajectory())
    (folder / "results.json").write_text(json.dumps({"experiment": "rgbd_slam", "seed": 0}))
    ply.write_ply(folder / "points.ply", np.zeros((3, 3)), np.zeros((3, 3), np.uint8))


def _scene(folder: Path) -> Any:
    scene = read_scene(folder, 2)
    return scene.path, scene.reference, scene.up, scene.t


_TREE = {"weights": np.ones((3, 2), np.float32), "step": np.asarray(4)}


def _colmap(text: bool, folder: Path) -> None:
    if text:
        images = "".join(f"{k + 1} 1 0 0 0 0 0 {k} 1 {k}.png\n1.5 2.5 1 3.5 4.5 -1\n" for k in range(COUNT))
        (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 16 12 15 15 8 6 0.1 0 0 0\n")
        (folder / "images.txt").write_text("# images\n" + images)
        (folder / "points3D.txt").write_text("# points\n1 0.5 0.5 2 10 20 30 0.5 1 0 2 0\n")
    else:
        import pycolmap

        _colmap(True, folder)
        pycolmap.Reconstruction(folder).write_binary(folder)
        for file in folder.glob("*.txt"):
            file.unlink()


def _read_colmap(folder: Path) -> Any:
    model = colmap.read_colmap(folder)
    return model.T_world_cam, model.points, [camera.parameters for camera in model.cameras.values()]


def _ply(text: bool, folder: Path) -> None:
    if not text:
        return ply.write_ply(folder / "a.ply", np.arange(12.0).reshape(4, 3), np.zeros((4, 3), np.uint8))
    head = "ply\nformat ascii 1.0\ncomment x\nelement vertex 3\nproperty float x\nproperty double y\n"
    (folder / "a.ply").write_text(head + "property float z\nend_header\n0 1 2\n3 4.5 5\n6 7 8e-1\n")
    return None


def _table(write: Callable, folder: Path) -> None:
    write(folder / "a.txt", _trajectory())


def _camchain(folder: Path) -> None:
    write_camchain(folder / "a.yaml", CameraImu(_poses()[1], 0.01))


def _camera(folder: Path) -> None:
    write_camera(folder / "camera.json", CAMERA, ("a.png",), ".")


def _imu(folder: Path) -> None:
    _rows(folder / "a.csv", [(k / 100, 0, 0, 0.1, 0, 0, 9.8) for k in range(9)])


def _of(name: str, read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda folder: read(folder / name)


def _points(folder: Path) -> np.ndarray:
    """Points of a scan, less those with NaN, which its reader leaves out and counts."""
    points = ply.read_points(folder / "a.ply")
    return points[np.isfinite(points).all(1)]


def _unseen(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """A reader whose result may hold NaN."""
    return lambda folder: read(folder) and None


_RECORDINGS = {
    "sevenscenes": _sevenscenes,
    "tum": _tum,
    "replica": _replica,
    "scannet": _scannet,
    "icl": _icl,
    "plain": _plain,
    "euroc": _euroc,
}
_EVENTS = {"event_npz": _event_npz, "event_hdf5": _event_hdf5, "davis": _davis, "eventnerf": _eventnerf}
_CHECKED = {**_RECORDINGS, "blender": _blender, "llff": _llff, "event_npz": _event_npz}
_tum_file = partial(_table, trajectories.write_tum)
_euroc_file = partial(_table, trajectories.write_euroc)
_ANY_FILE = _of("a.txt", lambda file: trajectories.read_trajectory(file).trajectory)
_kitti_file = partial(_table, lambda file, trajectory: trajectories.write_kitti(file, trajectory.T))

TARGETS = {
    **{name: Target(*functions) for name, functions in CAPTURES.items()},
    **{name: Target(write, _recording) for name, write in _RECORDINGS.items()},
    **{name: Target(write, _events) for name, write in _EVENTS.items()},
    **{
        f"check_{name}": Target(write, _unseen(lambda folder: check.run(check.Config(folder))))
        for name, write in _CHECKED.items()
    },
    **{
        f"field_{kind}": Target(partial(_field, kind), _read_field)
        for kind in ("bspline", "posenet", "table", "stamped")
    },
    "field_jax": Target(partial(_field, "posenet"), _load_field),
    "view": Target(_run, _scene),
    "camera": Target(_camera, _of("camera.json", lambda file: read_camera(file).camera[:4])),
    "checkpoint": Target(
        lambda folder: checkpoint.save(folder / "c.npz", _TREE),
        _unseen(_of("c.npz", lambda file: checkpoint.load(file, _TREE))),
    ),
    "registration": Target(
        lambda folder: registration.save(
            folder / "r.npz",
            registration.Registered(
                *(_poses(), np.ones(COUNT, bool), *_BOX, 0.5, 9.0, 7, 0.3, True, np.full((COUNT, 3), 1.25)),
                *(np.tile(np.eye(6), (COUNT, 1, 1)), 1.5),
            ),
        ),
        _of("r.npz", lambda file: registration.load(file, COUNT)._replace(far=1.0)),  # may be infinite
    ),
    "pose_sigmas": Target(
        lambda folder: write_sigmas(folder / "s.csv", _NAMES, np.full((COUNT, 2), 0.25)),
        _of("s.csv", lambda file: read_sigmas(file, _NAMES)[0]),
    ),
    "blender": Target(_blender, partial(_photographs, blender.load)),
    "llff": Target(_llff, partial(_photographs, llff.load)),
    "colmap_text": Target(partial(_colmap, True), _read_colmap),
    "colmap_binary": Target(partial(_colmap, False), _read_colmap),
    "ply_text": Target(partial(_ply, True), _points),
    "ply_binary": Target(partial(_ply, False), _points),
    "ply_coloured": Target(partial(_ply, False), _unseen(_of("a.ply", ply.read_coloured_points))),
    "tum_file": Target(_tum_file, _of("a.txt", trajectories.read_tum)),
    "euroc_file": Target(_euroc_file, _of("a.txt", trajectories.read_euroc)),
    "kitti_file": Target(
        _kitti_file, _of("a.txt", lambda file: trajectories.read_trajectory(file).trajectory)
    ),
    "any_file": Target(_tum_file, _ANY_FILE),
    "check_file": Target(_tum_file, _unseen(_of("a.txt", lambda file: check.run(check.Config(file))))),
    "timestamps": Target(_tum_file, _of("a.txt", trajectories.read_timestamps)),
    "camchain": Target(_camchain, _of("a.yaml", read_mounting)),
    "mounting": Target(lambda folder: _sheet(folder / "a.yaml", True), _of("a.yaml", read_mounting)),
    "imu": Target(_imu, _of("a.csv", lambda file: read_imu(file).since(0))),
}

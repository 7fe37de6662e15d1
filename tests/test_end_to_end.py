"""One run, shrunk to seconds, on every row of the table of formats: read, and what a run leaves written."""

import contextlib
import functools
import io
import json

import numpy as np
import pycolmap
import pytest
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from evo.tools import file_interface
from helpers import room_layouts, rooms
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from jaxpose.cli.formats import all_formats
from jaxpose.cli.main import main
from jaxpose.fields import numpy_evaluator
from jaxpose.files.trajectories import read_tum

ROWS = all_formats()
T = room_layouts.WALK.T_world_cam
NS = [room_layouts.T0_NS + k * 10**8 for k in range(rooms.COUNT)]  # on the recording's clock, and its run's
SLAM = ("--no-loops", "--refine", "none", "--smoke")  # what is left out compiles for long


def ran(*args) -> dict:
    """What a command prints as JSON."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        main([*map(str, args), "--json"])
    return json.loads(printed.getvalue())


def relative(T):
    """Poses against the first, lengths against the longest."""
    T = np.linalg.inv(T[0]) @ T
    T[:, :3, 3] /= np.linalg.norm(T[:, :3, 3], axis=1).max()
    return T


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    """A run of SLAM on a format's recording, once each: the recording, the run, its results."""

    @functools.cache
    def run(name):
        folder = tmp_path_factory.mktemp(name)
        data = room_layouts.RECORDINGS[name](folder)
        out = tmp_path_factory.mktemp("runs") / name
        return data, out, ran("slam", "--data", data, "--imu", "none", *SLAM, "--out", out)["results"]

    return run


# --- what is read ----------------------------------------------------------------------------------------


def slam(name):
    """The box is tracked to centimetres even by a run that is shrunk: axes, lens and scale are right."""

    def test(folder, track):
        _, run, results = track(name)
        found = read_tum(run / "trajectory.txt")
        assert len(found.t) == rooms.COUNT
        if name == "azure_kinect":  # whose files have no poses
            times = [f"{at:.6f}" for at in found.t]
            rows = room_layouts.tum_rows(rooms.poses(np.arange(rooms.COUNT) / 30), times)
            (folder / "poses.txt").write_text("\n".join(rows) + "\n")
            against = ran("eval", run, folder / "poses.txt")
            errors = against["ate_m"]["rmse"], against["rpe"][0]["rotation_deg"]["rmse"]
        else:
            errors = results["ate_rmse_m"], results["rpe"]["rotation_rmse_deg"]
        assert errors[0] < 0.03 and errors[1] < 1

    return test


def nerf(name):
    """The poses that a training has are those of the files, but for the world's place and unit."""

    def test(folder, track):
        data, run = room_layouts.PHOTOS[name](folder / "data"), folder / "run"
        alone = name in ("plain", "video")
        options = ("--noise", "unknown" if alone else "none", "--test-pose-steps", "0", "--smoke")
        options += ("--focal-px", rooms.K[0]) if name == "video" else ()
        results = ran("nerf", "--data", data, *options, "--out", run)["results"]
        assert results["data"]["images"] == 8
        found = read_tum(run / ("trajectory.txt" if alone else "reference.txt"))
        if alone:  # nothing is known of them
            assert len(found.t) == 8 and not (run / "reference.txt").exists()
            return
        taken = room_layouts.PHOTOGRAPHS.T_world_cam[np.rint(found.t).astype(int)]
        np.testing.assert_allclose(relative(found.T), relative(taken), atol=1e-6)

    return test


def events(name):
    """All events are there, and the poses are those of the files on the clock of the events."""

    def test(folder, track):
        data, run = room_layouts.EVENT_FILES[name](folder / "data"), folder / "run"
        results = ran("events", "--data", data, "--smoke", "--out", run)["results"]
        assert results["data"]["events"] == len(room_layouts.EVENTS)
        assert results["data"]["size"] == list(rooms.SIZE)
        found = read_tum(run / "reference.txt")
        first_s = 0 if name == "eventnerf" else room_layouts.EVENTS[0, 0] / 1e6
        assert len(found.t) >= 13
        np.testing.assert_allclose(found.T, rooms.poses(found.t + first_s), atol=1e-6)

    return test


def evaluated(write):
    """A tracked run against the true poses in a file."""

    def test(folder, track):
        _, run, results = track("euroc")
        errors = ran("eval", run, write(folder))
        assert errors["pairs"] == rooms.COUNT
        assert errors["ate_m"]["rmse"] == pytest.approx(results["ate_rmse_m"], rel=1e-3)

    return test


def by_evo(folder):
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    path = PoseTrajectory3D(T[:, :3, 3], np.roll(xyzw, 1, axis=1), np.array(NS) / 1e9)
    file_interface.write_tum_trajectory_file(str(folder / "poses.txt"), path)
    return folder / "poses.txt"


def kitti_by_evo(folder):
    file_interface.write_kitti_poses_file(str(folder / "poses.txt"), PosePath3D(poses_se3=list(T)))
    return folder / "poses.txt"


def table(header, order, seconds=False):
    """Rows of a csv whose columns are t x y z qx qy qz qw in another order."""

    def write(folder):
        times = [f"{ns // 10**9}.{ns % 10**9:09d}" if seconds else str(ns) for ns in NS]
        rows = [row.split() for row in room_layouts.tum_rows(T, times)]
        lines = [",".join(row[k] for k in order) for row in rows]
        (folder / "poses.csv").write_text("\n".join([header, *lines]) + "\n")
        return folder / "poses.csv"

    return write


def matrices(folder):
    np.savetxt(folder / "poses.txt", T.reshape(-1, 4))
    return folder / "poses.txt"


def with_imu(mounting, mode):
    """SLAM with readings of a file, of whole microseconds beside frames of seconds."""

    def test(folder, track):
        data, T_cam_body = room_layouts.plain(folder / "data"), np.eye(4)
        header = "timestamp [us],gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"
        room_layouts.write_readings(folder / "imu.csv", header, np.arange(-0.1, 0.9, 0.005), 1e6)
        T_cam_body[:3, :3] = room_layouts.R_BODY_CAM.T
        rows = [f"  - {row}" for row in T_cam_body.tolist()]
        chain = ["cam0:", "  T_cam_imu:", *rows, "  camera_model: pinhole", "  timeshift_cam_imu: 0.0"]
        (folder / "chain.yaml").write_text("\n".join(chain) + "\n")
        np.savetxt(folder / "T_body_cam.txt", np.linalg.inv(T_cam_body))
        files = ("--imu-file", folder / "imu.csv", "--imu-extrinsics", folder / mounting)
        options = ("--imu", mode, *SLAM, "--out", folder / "run")
        results = ran("slam", "--data", data, *files, *options)["results"]
        assert results["imu"]["mode"] == mode and "imu.csv" in results["imu"]["readings"]
        assert results["ate_rmse_m"] < 0.03

    return test


READ = {
    **{("RGB-D", name): slam(name) for name in room_layouts.RECORDINGS},
    **{("photographs", name): nerf(name) for name in room_layouts.PHOTOS},
    **{("events", name): events(name) for name in room_layouts.EVENT_FILES},
    ("trajectories", "TUM: t tx ty tz qx qy qz qw; ORB-SLAM3's ns"): evaluated(by_evo),
    ("trajectories", "csv of the same, tables with a header (evo, rostopic)"): evaluated(
        table("qw,qx,qy,qz,x,y,z,timestamp", [7, 4, 5, 6, 1, 2, 3, 0], seconds=True)
    ),
    ("trajectories", "KITTI: 3x4 matrices"): evaluated(kitti_by_evo),
    ("trajectories", "EuRoC, TUM-VI, VINS: csv of ns, position, quaternion wxyz"): evaluated(
        table("#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z", [0, 1, 2, 3, 7, 4, 5, 6])
    ),
    ("trajectories", "lists of 4x4 matrices"): evaluated(matrices),
    ("IMU", "tables whose header names the columns, EuRoC's csv, t wx wy wz ax ay az"): with_imu(
        "T_body_cam.txt", "combined"
    ),
    ("IMU", "mounting: sensor.yaml, Kalibr's camchain (written too), 4x4"): with_imu("chain.yaml", "loose"),
}


# --- what is written -------------------------------------------------------------------------------------


def same_poses(of):
    """What another library reads in an export, `of(file)`, against the run's own list."""

    def test(form, folder, track):
        run, file = track("euroc")[1], folder / f"out.{form}"
        ran("export", run, "--format", form, "--out", file)
        wanted = read_tum(run / "trajectory.txt")
        found = of(file)
        np.testing.assert_allclose(found, wanted.T, atol=1e-6)

    return test


def of_quaternions(positions, xyzw):
    found = np.tile(np.eye(4), (len(positions), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = Rotation.from_quat(xyzw).as_matrix(), positions
    return found


def of_csv(file):
    rows = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
    return of_quaternions(rows[:, 1:4], rows[:, 4:])


def of_json(file):
    frames = json.loads(file.read_text())["frames"]
    assert all((file.parent / frame["file_path"]).is_file() for frame in frames)
    return np.array([frame["transform_matrix"] for frame in frames]) @ np.diag([1.0, -1, -1, 1])


def of_model(folder):
    model = pycolmap.Reconstruction(folder / "sparse/0")
    images = sorted(model.images.values(), key=lambda image: image.name)
    assert len(model.points3D) > 100 and all((folder / "images" / image.name).is_file() for image in images)
    poses = [np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images]
    return np.linalg.inv(np.stack(poses))


def of_bag(file):
    with AnyReader([file], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        poses = [
            getattr(message.pose, "pose", message.pose)  # with covariance
            for connection, _, raw in reader.messages()
            if connection.topic == "/pose"
            for message in [reader.deserialize(raw, connection.msgtype)]
        ]
    numbers = lambda of, names: np.array([[getattr(of(pose), name) for name in names] for pose in poses])
    return of_quaternions(
        numbers(lambda pose: pose.position, "xyz"), numbers(lambda pose: pose.orientation, "xyzw")
    )


def of_rerun(file):
    found = {}
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        found |= {(chunk.entity_path, name): batch[name].to_pylist() for name in batch.schema.names}
    at = lambda name: np.array(found["/world/camera", f"Transform3D:{name}"])[:, 0]
    return of_quaternions(at("translation"), at("quaternion"))


def of_field(file):
    return numpy_evaluator.load(file)(np.array(NS) / 1e9)


def copied(form, folder, track):
    """The copy of a recording has the poses and frames of what it was made from."""
    data, run, results = track("euroc")
    out = folder / "copy"
    assert ran("convert", data, "--to", form, "--out", out)["frames"] == rooms.COUNT
    errors = ran("eval", run, out)
    assert errors["pairs"] >= rooms.COUNT - 1
    assert errors["ate_m"]["rmse"] == pytest.approx(results["ate_rmse_m"], rel=0.2)
    images = sorted(path for path in out.rglob("*.png") if "depth" not in str(path.relative_to(out)))
    for file, original in zip(images, sorted((data / "mav0/cam0/data").iterdir()), strict=True):
        assert file.read_bytes() == original.read_bytes()


WRITTEN = {
    "tum": same_poses(lambda file: file_interface.read_tum_trajectory_file(str(file)).poses_se3),
    "csv": same_poses(of_csv),
    "kitti": same_poses(lambda file: file_interface.read_kitti_poses_file(str(file)).poses_se3),
    "euroc": same_poses(lambda file: file_interface.read_euroc_csv_trajectory(str(file)).poses_se3),
    "transforms": same_poses(of_json),
    "colmap": same_poses(of_model),
    "colmap_binary": same_poses(of_model),
    "mcap": same_poses(of_bag),
    "bag": same_poses(of_bag),
    "rerun": same_poses(of_rerun),
    "npz": same_poses(of_field),
}
COPIED = ("plain", "tum", "euroc")


# --- every row of the table ------------------------------------------------------------------------------


def row_of(row):
    return row.kind, row.name or row.title


def written_by(row):
    """The formats that a row's commands write: `export --format colmap`, `colmap_binary`."""
    words = [word.strip("`") for word in row.written.replace(",", " ").split()]
    return [word for word in words if word and word not in ("export", "convert", "--format", "--to")]


def test_no_row_is_without_a_run():
    """A format that is new in a registry needs an entry above."""
    assert READ.keys() == {row_of(row) for row in ROWS if row.read_by}
    assert set(WRITTEN) == {form for row in ROWS if "export" in row.written for form in written_by(row)}
    assert set(COPIED) == {form for row in ROWS if "convert" in row.written for form in written_by(row)}


@pytest.mark.slow
@pytest.mark.parametrize("row", READ, ids=" ".join)
def test_what_is_read(row, tmp_path, track):
    (tmp_path / "data").mkdir()
    READ[row](tmp_path, track)


@pytest.mark.slow
@pytest.mark.parametrize("form", WRITTEN)
def test_what_is_written(form, tmp_path, track):
    WRITTEN[form](form, tmp_path, track)


@pytest.mark.slow
@pytest.mark.parametrize("form", COPIED)
def test_what_is_copied(form, tmp_path, track):
    copied(form, tmp_path, track)

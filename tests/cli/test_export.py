"""`jaxpose export`: poses through every format and back, no motion that nobody measured, wrong calls."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose import fields
from jaxpose.cli import export
from jaxpose.cli import main as main_command
from jaxpose.cli.export import Config
from jaxpose.datasets.photos import blender
from jaxpose.datasets.rgbd import nerfstudio
from jaxpose.errors import DataError
from jaxpose.fields import numpy_evaluator
from jaxpose.files import atomic, trajectories
from jaxpose.files.camera_json import read_camera, write_camera
from jaxpose.files.ply import write_ply
from jaxpose.geometry.camera import Camera

COUNT, SPAN = 16, (0.0, 3.0)
CAMERA = Camera(22.0, 21.0, 11.0, 7.5, 24, 16, (0.1, 0.0, 0.002, 0.01))


@pytest.fixture
def recording(tmp_path):
    """Images on disk, twice as large as a run used them; names lack the suffix, as Blender's do."""
    folder = tmp_path / "recording"
    (folder / "train").mkdir(parents=True)
    for k in range(COUNT):
        Image.new("RGB", (48, 32), (k, 0, 0)).save(folder / "train" / f"r_{k}.png")
    return folder


@pytest.fixture
def run(tmp_path, recording):
    """What a run leaves: its frames' poses, the continuous trajectory near them, its camera."""
    folder = tmp_path / "run"
    folder.mkdir()
    rng = np.random.default_rng(0)
    points = np.cumsum(0.2 * rng.normal(size=(23, 7)), axis=0)
    fields.save(folder / "field.npz", fields.bspline(SPAN, len(points) - 3), jnp.asarray(points))
    t = np.linspace(*SPAN, COUNT)
    poses = numpy_evaluator.load(folder / "field.npz")(t)
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(0.01 * rng.normal(size=(COUNT, 3))).as_matrix()
    trajectories.write_tum(folder / "trajectory.txt", trajectories.Trajectory(t, poses))
    atomic.write_json(folder / "results.json", {"experiment": "noisy_nerf"})
    names = tuple(f"./train/r_{k}" for k in range(COUNT))
    write_camera(folder / "camera.json", CAMERA, names, recording)
    return folder


def poses_of(run):
    return trajectories.read_tum(run / "trajectory.txt")


def exported(run, format, out, **options):
    result = export.run(Config(run, format=format, out=out, **options))
    assert result.out == out and out.exists()
    return result


@pytest.mark.parametrize("format, stamped", [("tum", True), ("euroc", True), ("kitti", False)])
def test_poses_come_back_from_trajectory_files(run, tmp_path, format, stamped):
    result = exported(run, format, tmp_path / "new" / "out")
    read = trajectories.read_trajectory(tmp_path / "new" / "out")
    written = poses_of(run)
    assert read.has_timestamps == stamped and result.poses == COUNT
    np.testing.assert_allclose(read.trajectory.T, written.T, atol=1e-12)
    if stamped:
        np.testing.assert_allclose(read.trajectory.t, written.t, rtol=0, atol=1e-9)
    else:
        assert "no timestamps" in " ".join(result.notes)


def test_times_of_kitti_lie_beside(run, tmp_path):
    exported(run, "kitti", tmp_path / "00.txt")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "00_times.txt"), poses_of(run).t)


def test_keys_that_nerfstudio_documents(run, tmp_path):
    """fl_x, w, h and ply_file_path as its documentation lists them; time as D-NeRF has it."""
    write_ply(run / "points.ply", np.zeros((2, 3)), np.zeros((2, 3), np.uint8))
    exported(run, "transforms", tmp_path / "out" / "transforms.json")
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert (content["w"], content["h"], content["fl_x"], content["camera_model"]) == (48, 32, 44.0, "OPENCV")
    assert (tmp_path / "out" / content["ply_file_path"]).samefile(run / "points.ply")
    assert [frame["time"] for frame in content["frames"]] == poses_of(run).t.tolist()


def test_poses_come_back_from_transforms(run, tmp_path):
    result = exported(run, "transforms", tmp_path / "poses" / "transforms.json")
    assert "48x32; the run used 24x16" in " ".join(result.notes)
    parts = blender.load(tmp_path / "poses" / "transforms.json")  # which finds and opens the images
    written = poses_of(run).T
    assert sum(len(part.files) for part in parts) == COUNT
    for part in parts:
        assert part.camera[:6] == pytest.approx((44.0, 42.0, 22.5, 15.5, 48, 32))
        for name, rgb, pose in zip(part.files, part.rgb, part.T_world_cam, strict=True):
            k = int(rgb[0, 0, 0])  # each image holds its number
            assert name.endswith(f"train/r_{k}.png")
            np.testing.assert_allclose(pose, written[k], atol=1e-12)


@pytest.mark.parametrize("format", ["colmap", "colmap_binary"])
def test_poses_points_and_images_come_back_from_colmap(run, recording, tmp_path, format):
    points, rgb = np.random.default_rng(1).normal(size=(9, 3)), np.full((9, 3), 7, np.uint8)
    write_ply(run / "points.ply", points, rgb)
    result = exported(run, format, tmp_path / "scene")
    assert "9 points of points.ply" in " ".join(result.notes)
    read = pycolmap.Reconstruction(tmp_path / "scene" / "sparse" / "0")
    assert {tuple(p.xyz) for p in read.points3D.values()} == {
        tuple(p) for p in points.astype(np.float32).tolist()
    }
    written = poses_of(run).T
    assert len(read.images) == COUNT
    for image in read.images.values():
        pose = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        k = int(image.name.removeprefix("train/r_").removesuffix(".png"))
        np.testing.assert_allclose(pose, written[k], atol=1e-12)
        copy = tmp_path / "scene" / "images" / image.name  # where trainers of Gaussian splatting look for it
        assert copy.read_bytes() == (recording / image.name).read_bytes()
    (camera,) = read.cameras.values()
    assert camera.model.name == "OPENCV"
    np.testing.assert_allclose(camera.params, [44, 42, 23, 16, 0.1, 0, 0.002, 0.01])


def test_depth_goes_to_transforms_and_back(run, recording, tmp_path):
    """nerfstudio's documented key; read by the loader of folders with depth."""
    counts = np.arange(48 * 32).reshape(32, 48).astype(np.uint16)
    for k in range(COUNT):
        Image.fromarray(counts + np.uint16(k)).save(recording / f"d_{k}.png")
    names, depths = (tuple(text.format(k) for k in range(COUNT)) for text in ("train/r_{}.png", "d_{}.png"))
    pinhole = CAMERA._replace(distortion=())
    write_camera(run / "camera.json", pinhole, names, recording, depths=depths, depth_per_metre=5000.0)
    result = exported(run, "transforms", recording / "transforms.json")
    assert "--depth-unit-scale-factor 0.0002" in result.notes[-1]
    content = json.loads((recording / "transforms.json").read_text())
    assert [frame["depth_file_path"] for frame in content["frames"]] == list(depths)
    read = nerfstudio.load(recording)
    np.testing.assert_allclose(read.read(3).depth, (counts + 3) / np.float32(5000))
    np.testing.assert_allclose(read.T_world_cam, poses_of(run).T, atol=1e-12)


def test_the_continuous_trajectory(run, tmp_path):
    result = exported(run, "npz", tmp_path / "motion.npz")
    times = np.linspace(-0.1, 3.1, 77)
    field = numpy_evaluator.load(run / "field.npz")
    np.testing.assert_array_equal(numpy_evaluator.load(tmp_path / "motion.npz")(times), field(times))
    assert result.poses is None and result.times == "made for 0.000 to 3.000 s"


def test_other_times(run, tmp_path):
    field, out = numpy_evaluator.load(run / "field.npz"), tmp_path / "out.txt"
    result = exported(run, "tum", out, rate_hz=40.0)
    read = trajectories.read_tum(out)
    np.testing.assert_allclose(read.t, np.arange(121) / 40)
    np.testing.assert_allclose(read.T, field(read.t), atol=1e-12)
    assert result.times == "of the continuous trajectory at 40 Hz"
    (tmp_path / "timestamps.csv").write_text("#ns\n" + "".join(f"{s}\n" for s in (-0.5, 0.25, 1.5, 3.0, 3.1)))
    result = exported(run, "euroc", out, at=tmp_path / "timestamps.csv")
    read = trajectories.read_euroc(out)
    np.testing.assert_allclose(read.t, [0.25, 1.5, 3.0])
    np.testing.assert_allclose(read.T, field(read.t), atol=1e-12)
    assert result.notes == ("2 of 5 timestamps are beyond the ends of the run: left out",)
    (tmp_path / "timestamps.csv").write_text("7\n8\n")
    with pytest.raises(DataError, match="expected timestamps from 0.000 to 3.000 s, as the run has, got 7"):
        export.run(Config(run, format="tum", out=out, at=tmp_path / "timestamps.csv"))


def test_a_trajectory_file_has_its_own_stamps_only(run, tmp_path):
    file, out = run / "trajectory.txt", tmp_path / "out"
    written = trajectories.read_tum(file)
    exported(file, "euroc", out)
    np.testing.assert_allclose(trajectories.read_euroc(out).T, written.T, atol=1e-12)
    (tmp_path / "some.txt").write_text("".join(f"{t!r} x.png\n" for t in written.t[[1, 4, 5]].tolist()))
    exported(file, "tum", out, at=tmp_path / "some.txt")
    np.testing.assert_allclose(trajectories.read_tum(out).T, written.T[[1, 4, 5]], atol=1e-12)
    (tmp_path / "between.txt").write_text(f"{written.t[1] + 0.01}\n")
    out.unlink()
    for options, message in (
        (
            {"at": tmp_path / "between.txt"},
            "between.txt: expected timestamps of .*, as its motion between",
        ),
        ({"rate_hz": 5.0}, "trajectory.txt: expected a run folder with field.npz, got a TUM file"),
    ):
        with pytest.raises(DataError, match=message):
            export.run(Config(file, format="tum", out=out, **options))
    for format in ("npz", "colmap", "transforms"):
        with pytest.raises(DataError, match="trajectory.txt: expected a run folder"):
            export.run(Config(file, format=format, out=out))
    trajectories.write_kitti(tmp_path / "kitti", written.T)
    with pytest.raises(DataError, match="kitti: expected timestamps for --format tum, got a KITTI file"):
        export.run(Config(tmp_path / "kitti", format="tum", out=out))
    assert not out.exists()


def test_images_that_are_not_there(run, recording, tmp_path):
    """Names and camera as the run had them, and a word on it; made up only where there never were any."""
    (recording / "train" / "r_3.png").unlink()
    result = exported(run, "transforms", tmp_path / "t.json")
    assert "not all images are in" in result.notes[0]
    frames = json.loads((tmp_path / "t.json").read_text())
    assert frames["frames"][3]["file_path"] == "train/r_3" and frames["w"] == 24
    write_camera(run / "camera.json", CAMERA, (), ".")
    result = exported(run, "colmap", tmp_path / "sparse")
    assert "names are made up" in result.notes[0]
    names = {
        image.name for image in pycolmap.Reconstruction(tmp_path / "sparse" / "sparse" / "0").images.values()
    }
    assert names == {f"frame-{k:06d}.png" for k in range(COUNT)}


def test_runs_of_before(run, tmp_path):
    (run / "camera.json").unlink()
    with pytest.raises(DataError, match="camera.json: expected the camera of a run, got nothing"):
        export.run(Config(run, format="colmap", out=tmp_path / "sparse"))
    np.savez(run / "field.npz", control_points=np.zeros((5, 7)), span=np.array([0.0, 3.0]))
    with pytest.raises(
        DataError, match="field.npz: expected a trajectory of version 1, got none .what older runs left"
    ):
        export.run(Config(run, format="npz", out=tmp_path / "motion.npz"))
    (run / "field.npz").write_bytes(b"half a file")
    with pytest.raises(DataError, match="field.npz: "):
        export.run(Config(run, format="npz", out=tmp_path / "motion.npz"))
    exported(run, "tum", tmp_path / "still.txt")
    assert [path.name for path in tmp_path.glob("*.npz")] == []


def test_camera_files(tmp_path):
    write_camera(tmp_path / "camera.json", CAMERA, ("a.png", "b.png"), "images")
    assert read_camera(tmp_path / "camera.json")[:3] == (CAMERA, ("a.png", "b.png"), tmp_path / "images")
    whole = json.loads((tmp_path / "camera.json").read_text())
    for change, message in (
        ({"fx": 0}, "camera.json: fx: expected a finite number above 0 up to 1e+09, got 0"),
        ({"cy": None}, "camera.json: cy: expected a finite number from -1e+09 to 1e+09, got None"),
        ({"fy": True}, "camera.json: fy: expected a finite number above 0 up to 1e+09, got True"),
        ({"width": -32}, "camera.json: width: expected a whole number from 1 to 100000, got -32"),
        ({"height": 20.5}, "camera.json: height: expected a whole number from 1 to 100000, got 20.5"),
        ({"distortion": [0.1]}, "camera.json: distortion: expected 0, 4 or 5 numbers, got 1"),
        (
            {"images": ["../a.png"]},
            "camera.json: expected a file name that stays in its folder, got '../a.png'",
        ),
        ({"depths": ["a.png"]}, "camera.json: depth_per_metre: expected a finite number above 0"),
        (
            {"depths": ["a.png"], "depth_per_metre": 1000},
            "camera.json: depths: expected one an image, 2, got 1",
        ),
        ({"images": [1]}, "camera.json: images: expected a list of file names, got [1]"),
        ({"images_folder": 3}, "camera.json: images_folder: expected a text, got 3"),
    ):
        (tmp_path / "camera.json").write_text(json.dumps(whole | change))
        with pytest.raises(DataError, match=re.escape(message)):
            read_camera(tmp_path / "camera.json")
    for text, message in (
        ("{", "camera.json:1: expected the camera of a run, got Expecting property"),
        ("[]", "camera.json: expected the camera of a run, got no JSON object but"),
        ("[" * 100_000, "camera.json: expected the camera of a run, got nesting without end"),
        ('{"fx": ' + 9999 * "1" + "}", "camera.json: expected the camera of a run, got Exceeds the limit"),
    ):
        (tmp_path / "camera.json").write_text(text)
        with pytest.raises(DataError, match=re.escape(message)):
            read_camera(tmp_path / "camera.json")


def test_the_command(run, tmp_path, capsys):
    out = tmp_path / "out.txt"
    main_command.main(["export", str(run), "--format", "tum", "--out", str(out), "--rate-hz", "2"])
    said = capsys.readouterr().out
    assert "noisy_nerf run, 16 poses, 0.000 to 3.000 s" in said and f"{out}  tum, 7 poses" in said
    main_command.main(["export", str(run), "--format", "kitti", "--out", str(out), "--json"])
    read = json.loads(capsys.readouterr().out)
    assert (read["format"], read["poses"], read["out"]) == ("kitti", COUNT, str(out))
    for args, message in (
        (["--format", "tum"], "Missing from jaxpose export: --out"),
        (["--format", "tmu", "--out", "x"], "invalid choice 'tmu'"),
        (["--format", "tum", "--out", "x", "--rate-hz", "0"], "--rate-hz: expected a positive number"),
        (["--format", "tum", "--out", "x", "--rate-hz", "1", "--at", "y"], "--at: expected no --rate-hz"),
        (["--format", "colmap", "--out", "x", "--rate-hz", "5"], "--format colmap: expected no --rate-hz"),
        (["--format", "npz", "--out", "x", "--at", "y"], "--format npz: expected no --rate-hz and no --at"),
        (["--format", "tum", "--out", "x", "--at", str(tmp_path / "y")], "No such file"),
    ):  # fmt: skip
        with pytest.raises(SystemExit) as stop:
            main_command.main(["export", str(run), *args])
        line = stop.value.code
        assert isinstance(line, str) and "\n" not in line and message in line, line


def test_same_keeps_every_digit(tmp_path):
    """Nanoseconds since 1970, positions in UTM, quaternions of five digits, in the ASL layout."""
    rows = [
        [
            str(1_403_715_523_912_143_101 + 5_000_001 * k),
            "453217.123456789",
            "5411932.987654321",
            f"0.{k}",
            *q,
        ]
        for k, q in enumerate([["0.70711", "0.0", "0.0", "-0.70711"]] * 9, 1)
    ]
    (tmp_path / "data.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    result = exported(tmp_path / "data.csv", "same", tmp_path / "out.csv")
    assert result.format == "euroc"
    assert [line.split(",") for line in (tmp_path / "out.csv").read_text().splitlines()[1:]] == rows
    exported(tmp_path / "data.csv", "tum", tmp_path / "out.txt")
    exported(tmp_path / "out.txt", "euroc", tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "out.csv").read_text()
    exported(tmp_path / "out.txt", "csv", tmp_path / "seconds.csv")
    assert exported(tmp_path / "seconds.csv", "same", tmp_path / "same.csv").format == "csv"
    assert (tmp_path / "same.csv").read_text() == (tmp_path / "seconds.csv").read_text()

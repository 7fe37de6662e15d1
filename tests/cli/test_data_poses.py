"""Poses of COLMAP's models, of `transforms.json` and beside events, for `eval`, `fit` and `export`."""

import json

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.cli import evaluate, export
from jaxpose.cli.source import read_source
from jaxpose.errors import DataError
from jaxpose.files.camera_json import write_camera
from jaxpose.files.trajectories import Trajectory, read_tum, write_tum
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

COUNT = 8
rng = np.random.default_rng(7)
POSES = rigid.make(Rotation.from_rotvec(rng.normal(size=(COUNT, 3))).as_matrix(), rng.normal(size=(COUNT, 3)))


def model(folder, names, poses):
    """A sparse model by pycolmap, without images."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24], camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for number, (name, T) in enumerate(zip(names, poses, strict=True), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        cam_from_world = np.linalg.inv(T)
        turn = pycolmap.Rotation3d(cam_from_world[:3, :3])
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, cam_from_world[:3, 3]))
    folder.mkdir(parents=True)
    reconstruction.write(folder)
    return folder


def test_images_are_paired_by_name(tmp_path):
    """A model of some images in another order, scaled and moved, against a run's and another model's."""
    names = [f"cam/shot_{k}.jpg" for k in range(COUNT)]
    some = [5, 0, 3, 7, 2]
    moved = rigid.make(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.ones(3)) @ POSES
    moved[:, :3, 3] *= 4.0
    found = model(tmp_path / "found" / "sparse" / "0", [names[k][4:] for k in some], moved[some])
    run = tmp_path / "run"
    run.mkdir()
    write_tum(run / "trajectory.txt", Trajectory(np.arange(COUNT) / 5, POSES))
    write_camera(run / "camera.json", Camera(50, 50, 31.5, 23.5, 64, 48), tuple(names), ".")
    for estimate, reference in (
        (found.parents[1], run),
        (found, model(tmp_path / "all", names, POSES)),
    ):
        result = evaluate.run(evaluate.Config(estimate, reference, align="sim3"))
        assert result.pairs == 5 and "names of images" in result.association
        assert result.ate_m.max < 1e-9 and result.transform.scale == pytest.approx(0.25)
    other = model(tmp_path / "other", ["a.png", "b.png"], POSES[:2])
    with pytest.raises(DataError, match="expected names of images as shot_0.jpg, .*, got a.png"):
        evaluate.run(evaluate.Config(other, found))


def test_names_that_are_timestamps(tmp_path):
    ns = [1_403_715_523_912_143_104 + 50_000_000 * k for k in range(COUNT)]
    for kind, names in (
        ("ns", [f"{at}.png" for at in ns]),
        ("s", [f"rgb/{at // 10**9}.{at % 10**9:09d}.png" for at in ns]),
    ):
        source = model(tmp_path / kind, names, POSES)
        export.run(export.Config(source, format="tum", out=tmp_path / f"{kind}.txt"))
        written = read_tum(tmp_path / f"{kind}.txt")
        assert written.t0_ns + round(written.t[3] * 1e9) == ns[3]
        np.testing.assert_allclose(written.T, POSES, atol=1e-12)
    frames = [1, 2, 3, 5, 8, 9, 11, 12]
    numbered = read_source(model(tmp_path / "n", [f"frame_{k}.png" for k in frames], POSES))
    assert not numbered.stamped and numbered.trajectory.t.tolist() == frames


def test_poses_beside_events(tmp_path):
    lines = [f"{1e-4 * k:.6f} {k % 240} {k % 180} {k % 2}" for k in range(200)]
    (tmp_path / "events.txt").write_text("\n".join(lines))
    (tmp_path / "calib.txt").write_text("200 200 120 90 0 0 0 0 0")
    with pytest.raises(DataError, match="expected groundtruth.txt or poses.txt with the events .davis., got"):
        read_source(tmp_path)
    write_tum(tmp_path / "groundtruth.txt", Trajectory(np.arange(COUNT) / 100, POSES))
    np.testing.assert_allclose(read_source(tmp_path).trajectory.T, POSES, atol=1e-12)


def test_transforms_are_poses_too(tmp_path):
    from PIL import Image

    flip = np.diag([1.0, -1, -1, 1])
    frames = []
    for k, T in enumerate(POSES):
        Image.new("RGB", (16, 12)).save(tmp_path / f"{k}.png")
        frames.append({"file_path": f"{k}.png", "transform_matrix": (T @ flip).tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 20, "frames": frames}))
    for path in (tmp_path, tmp_path / "transforms.json"):
        source = read_source(path)
        np.testing.assert_allclose(source.trajectory.T, POSES, atol=1e-12)
        assert source.names == tuple(f"{k}.png" for k in range(COUNT))

"""Poses written back: read again by the loader they are what they were, and nothing else has changed."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.datasets.photos import blender
from jaxpose.datasets.photos.transforms_json import write_transforms
from jaxpose.datasets.types import Photographs
from jaxpose.errors import DataError
from jaxpose.geometry.camera import Camera

W, H = 12, 8
BLENDER = {"camera_angle_x": 0.7}
NERFSTUDIO = {
    "camera_model": "OPENCV", "w": W, "h": H, "fl_x": 15.0, "fl_y": 14.0, "cx": 6.5, "cy": 3.0, "k1": 0.1,
    "k2": 0.0, "p1": 0.0, "p2": 0.01, "aabb_scale": 16,
}  # fmt: skip


def poses(n, seed):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(n, 3))
    return T


def write_source(folder, header, name="transforms.json", n=9):
    (folder / "images").mkdir(exist_ok=True)
    frames = []
    for i, T in enumerate(poses(n, 0)):
        Image.new("RGB", (W, H), (i, 0, 0)).save(folder / "images" / f"{i:03d}.png")
        frames.append(
            {"file_path": f"images/{i:03d}.png", "transform_matrix": T.tolist(), "sharpness": 10.0 + i}
        )
    content = {**header, "frames": frames}
    (folder / name).write_text(json.dumps(content))
    return content


@pytest.mark.parametrize("header", [BLENDER, NERFSTUDIO])
def test_refined_poses_stand_in_for_the_source(tmp_path, header):
    content = write_source(tmp_path, header)
    train, _ = blender.load(tmp_path)
    refined = train._replace(T_world_cam=poses(len(train.t), 1))
    write_transforms(tmp_path / "refined.json", refined, source=blender.transforms_file(tmp_path))
    written = json.loads((tmp_path / "refined.json").read_text())
    assert {k: v for k, v in written.items() if k != "frames"} == header
    kept = [frame for frame in content["frames"] if frame["file_path"] in train.files]
    for before, after in zip(kept, written["frames"], strict=True):
        assert {**before, "transform_matrix": None} == {**after, "transform_matrix": None}
    # Read as another would: the matrix's columns are right, up, back, centre.
    right, up, back = np.array(written["frames"][2]["transform_matrix"])[:3, :3].T
    np.testing.assert_allclose(refined.T_world_cam[2, :3, :3].T, [right, -up, -back], atol=1e-15)
    again = np.concatenate([part.T_world_cam for part in blender.load(tmp_path / "refined.json")])
    names = [name for part in blender.load(tmp_path / "refined.json") for name in part.files]
    order = [train.files.index(name) for name in names]
    np.testing.assert_allclose(again, refined.T_world_cam[order], atol=1e-12)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(15.0, 14.0, W / 2 - 0.5, H / 2 - 0.5, W, H),
        Camera(15.0, 14.0, 6.0, 2.5, W, H),
        Camera(15.0, 14.0, 6.0, 2.5, W, H, (0.1, 0.0, 0.0, 0.01, 0.0)),
        Camera(15.0, 14.0, 6.0, 2.5, W, H, (0.1, 0.0, 0.0, 0.01)),
    ],
)
def test_a_camera_without_a_source(tmp_path, camera):
    write_source(tmp_path, BLENDER)
    files = tuple(f"images/{i:03d}.png" for i in range(9))
    own = Photographs(
        "own", camera, np.arange(9.0), np.zeros((9, H, W, 3), np.uint8), poses(9, 2), 1.5, 7.0, "depth", files
    )
    write_transforms(tmp_path / "new.json", own)
    train, held_out = blender.load(tmp_path / "new.json")
    assert train.camera[:6] == pytest.approx(camera[:6])
    assert train.camera.distortion[:4] == camera.distortion[:4]
    assert (train.near, train.far, train.spacing) == (1.5, 7.0, "depth")
    np.testing.assert_allclose(train.T_world_cam, own.T_world_cam[1:8], atol=1e-12)
    assert held_out.files == (files[0], files[8])
    write_transforms(tmp_path / "new.json", own._replace(spacing="disparity"))
    assert "near" not in json.loads((tmp_path / "new.json").read_text())


def test_what_cannot_be_written(tmp_path):
    write_source(tmp_path, BLENDER)
    train, _ = blender.load(tmp_path)
    broken = train.T_world_cam.copy()
    broken[1] = np.nan
    with pytest.raises(
        DataError, match="out.json: expected finite poses, got NaN or infinity for images/002.png"
    ):
        write_transforms(tmp_path / "out.json", train._replace(T_world_cam=broken))
    other = train._replace(files=("images/other.png", *train.files[1:]))
    with pytest.raises(DataError, match="transforms.json: expected a frame of images/other.png, got none"):
        write_transforms(tmp_path / "out.json", other, source=tmp_path / "transforms.json")
    assert not (tmp_path / "out.json").exists()


def test_lists_of_a_split_name_images_in_any_spelling(tmp_path):
    frames = []
    for k in range(6):
        Image.new("RGB", (16, 12), (k, 0, 0)).save(tmp_path / f"Shot_{k}.PNG")
        matrix = np.eye(4)
        matrix[0, 3] = k
        frames.append({"file_path": f".\\shot_{k}", "transform_matrix": matrix.tolist()})
    lists = {
        "train_filenames": ["./Shot_0.PNG", "Shot_1.PNG", "shot_2.png"],
        "test_filenames": [f"C:\\data\\Shot_{k}.PNG" for k in (3, 4)],
    }
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 20, "frames": frames, **lists}))
    train, held_out = blender.load(tmp_path)
    assert [image[0, 0, 0] for image in train.rgb] == [0, 1, 2]
    assert [image[0, 0, 0] for image in held_out.rgb] == [3, 4]
    assert "1 images left out, which are in neither of the lists used" in train.notes

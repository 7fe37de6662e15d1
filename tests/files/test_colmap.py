"""COLMAP's models, written by COLMAP and read here, and the other way round."""

import struct

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files.colmap import MODELS, is_colmap, read_colmap, write_colmap
from jaxpose.geometry.camera import Camera, project

LENS = (0.1, -0.05, 0.002, 0.01)


def poses(count):
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


@pytest.mark.parametrize(
    "distortion, model",
    [((), "PINHOLE"), (LENS, "OPENCV"), ((*LENS, 0.0), "OPENCV"), ((*LENS, 0.03), "FULL_OPENCV")],
)
@pytest.mark.parametrize("binary", [False, True])
def test_colmap_reads_poses_names_camera_and_points(tmp_path, distortion, model, binary):
    camera = Camera(300.0, 310.0, 159.5, 118.0, 320, 240, distortion)
    names, T_world_cam = [f"left/{k}.png" for k in range(5)], poses(5)
    cloud = np.random.default_rng(1).normal(size=(7, 3))
    rgb = np.arange(21, dtype=np.uint8).reshape(7, 3)
    write_colmap(tmp_path / "sparse", camera, names, T_world_cam, points=cloud, rgb=rgb, binary=binary)
    read = pycolmap.Reconstruction(tmp_path / "sparse")
    images = {image.name: image for image in read.images.values()}
    assert sorted(images) == names
    np.testing.assert_array_equal([read.points3D[k].xyz for k in range(1, 8)], cloud)
    np.testing.assert_array_equal([read.points3D[k].color for k in range(1, 8)], rgb)
    for name, pose in zip(names, T_world_cam, strict=True):
        T_cam_world = np.eye(4)
        T_cam_world[:3] = images[name].cam_from_world().matrix()
        np.testing.assert_allclose(np.linalg.inv(T_cam_world), pose, atol=1e-12)
    (theirs,) = read.cameras.values()
    assert (theirs.model.name, theirs.width, theirs.height) == (model, 320, 240)
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.5], (20, 3))
    pixels = np.asarray(project(camera, jnp.asarray(points, jnp.float32)))
    # COLMAP's first pixel has its centre at (0.5, 0.5), OpenCV's at (0, 0).
    np.testing.assert_allclose(np.asarray(theirs.img_from_cam(points)) - 0.5, pixels, atol=2e-3)


@pytest.mark.parametrize(
    "names, message",
    [
        (["a b.png", "c.png"], "expected image names without blanks, got 'a b.png'"),
        (["a.png", "a.png"], "expected a name for each image, got the same one twice"),
        (["a.png", "bad.png"], "expected finite poses, got NaN or infinity for bad.png"),
    ],
)
def test_what_cannot_be_written(tmp_path, names, message):
    T_world_cam = poses(2)
    if "bad.png" in names:
        T_world_cam[1] = np.nan
    with pytest.raises(DataError, match=message):
        write_colmap(tmp_path / "sparse", Camera(300.0, 300.0, 160.0, 120.0, 320, 240), names, T_world_cam)
    assert not (tmp_path / "sparse").exists()


# --- reading ------------------------------------------------------------------------------------------------


def test_the_numbers_of_the_models_are_those_of_colmap():
    for number, (name, length) in enumerate(MODELS):
        camera = pycolmap.Camera.create_from_model_name(0, name, 500, 640, 480)
        assert (int(camera.model), len(camera.params)) == (number, length)
    newest = pycolmap.CameraModelId.__members__.keys() - {"INVALID"}
    assert newest <= {name for name, _ in MODELS}, "COLMAP has a model more"


@pytest.fixture(scope="module")
def synthetic():
    """A scene seen by a rig of two cameras, by COLMAP's own generator."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_rigs, options.num_frames_per_rig = 40, 1, 3
    options.num_cameras_per_rig, options.num_points2D_without_point3D = 2, 3
    pycolmap.set_random_seed(1)
    return pycolmap.synthesize_dataset(options)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_what_colmap_has_written(tmp_path, synthetic, form):
    assert not is_colmap(tmp_path)
    getattr(synthetic, f"write_{form}")(tmp_path)
    assert is_colmap(tmp_path)
    model = read_colmap(tmp_path)
    theirs = {image.name: image for image in synthetic.images.values()}
    assert sorted(model.names) == sorted(theirs)
    points = [tuple(xyz) for xyz in model.points]
    assert sorted(points) == sorted(tuple(point.xyz) for point in synthetic.points3D.values())
    for name, number, T, seen in zip(
        model.names, model.camera_ids, model.T_world_cam, model.seen, strict=True
    ):
        image = theirs[name]
        assert number == image.camera_id
        np.testing.assert_allclose(T[:3], image.cam_from_world().inverse().matrix(), atol=1e-12)
        matched = {p.point3D_id for p in image.points2D if p.has_point3D()}
        assert len(matched) == 40
        assert {points[k] for k in seen} == {tuple(synthetic.points3D[k].xyz) for k in matched}
    for number, camera in synthetic.cameras.items():
        ours = model.cameras[number]
        assert (ours.model, ours.width, ours.height) == (camera.model.name, camera.width, camera.height)
        assert ours.parameters == tuple(camera.params)


def test_a_text_model_without_points_and_with_blanks_in_names(tmp_path):
    (tmp_path / "cameras.txt").write_text("# c\n\n7 SIMPLE_PINHOLE 64 48 50 32 24\n")
    (tmp_path / "images.txt").write_text(
        "# i\n3 1 0 0 0 1 2 3 7 my photo.JPG\n1 2 -1 3 4 9\n4 1 0 0 0 0 0 0 7 b.png"
    )
    model = read_colmap(tmp_path)
    assert model.names == ("my photo.JPG", "b.png") and model.points.shape == (0, 3)
    assert [len(seen) for seen in model.seen] == [0, 0]  # point 9 is in no file
    np.testing.assert_array_equal(model.T_world_cam[0, :3, 3], [-1, -2, -3])


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_file_that_ends_anywhere(tmp_path, synthetic, name):
    synthetic.write_binary(tmp_path)
    file = tmp_path / f"{name}.bin"
    whole = file.read_bytes()
    for length in {*range(0, len(whole), max(len(whole) // 40, 1)), len(whole) - 1}:
        file.write_bytes(whole[:length])
        with pytest.raises(
            DataError, match=rf"{name}.bin: expected a whole file of COLMAP, got .* ends early"
        ):
            read_colmap(tmp_path)


def spoiled(name, old, new):
    def change(folder):
        file = folder / f"{name}.txt"
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (spoiled("cameras", "PINHOLE", "PINHALL"), "got PINHALL with 4 parameters"),
        (spoiled("cameras", "300.0", "nan"), "got PINHOLE of 320x240 with nan"),
        (spoiled("cameras", " 320 ", " 0 "), "PINHOLE of 0x240"),
        (spoiled("cameras", "1 PINHOLE", "2 PINHOLE"), "expected a camera of cameras.txt for a.png, got 1"),
        (spoiled("images", "1 1.0", "1 7.0"), "a unit quaternion and a position for a.png, got 7"),
        (spoiled("images", "1.0", "one"), "images.txt: .*, got could not convert"),
        (lambda folder: (folder / "images.txt").write_text("#\n"), "expected images with poses, got none"),
        (lambda folder: (folder / "images.txt").unlink(), "images.txt: expected a file of COLMAP, .*nothing"),
    ],
)  # fmt: skip
def test_what_cannot_be_read(tmp_path, change, message):
    T = np.tile(np.eye(4), (2, 1, 1))
    write_colmap(tmp_path, Camera(300.0, 300.0, 160.0, 120.0, 320, 240), ["a.png", "b.png"], T)
    change(tmp_path)
    with pytest.raises(DataError, match=message) as error:
        read_colmap(tmp_path)
    assert "\n" not in str(error.value)


def test_unknown_models_in_binary(tmp_path, synthetic):
    synthetic.write_binary(tmp_path)
    file = tmp_path / "cameras.bin"
    content = bytearray(file.read_bytes())
    struct.pack_into("<i", content, 12, 99)
    file.write_bytes(content)
    with pytest.raises(DataError, match="cameras.bin: .*got a camera model of number 99"):
        read_colmap(tmp_path)

"""COLMAP's text model, read back by COLMAP itself."""

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files.colmap import write_colmap
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
def test_colmap_reads_poses_names_and_camera(tmp_path, distortion, model):
    camera = Camera(300.0, 310.0, 159.5, 118.0, 320, 240, distortion)
    names, T_world_cam = [f"left/{k}.png" for k in range(5)], poses(5)
    write_colmap(tmp_path / "sparse", camera, names, T_world_cam)
    read = pycolmap.Reconstruction(tmp_path / "sparse")
    images = {image.name: image for image in read.images.values()}
    assert sorted(images) == names and not read.points3D
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

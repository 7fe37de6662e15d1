"""LLFF scenes against BARF's conventions written out again, and the real fern."""

import re

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates, uniform_filter
from scipy.spatial.transform import Rotation

from jaxpose.datasets.photos import llff
from jaxpose.errors import DataError

N = 29
FULL = (320, 240)  # the original images, of which the folders hold smaller ones
FOCAL = 300.0


def axes(i):
    """Right, up, back and centre of camera i, forward-facing but for small turns."""
    turn = Rotation.from_rotvec(0.1 * np.array([np.sin(i), np.cos(2 * i), np.sin(3 * i)]))
    centre = np.array([0.4 * np.sin(1.3 * i), 0.3 * np.cos(0.7 * i), 0.05 * i])
    return (Rotation.from_rotvec([0.3, -0.2, 0.1]) * turn).as_matrix(), 10 * centre


def rows():
    """Rows of the file: 3x5 matrices with columns down, right, back, centre, size; then two depths."""
    table = []
    for i in range(N):
        R, centre = axes(i)
        matrix = np.stack([-R[:, 1], R[:, 0], R[:, 2], centre, [FULL[1], FULL[0], FOCAL]], -1)
        table.append([*matrix.ravel(), 20.0 + i, 100.0 + i])
    return np.array(table)


def write(folder, table=None, **folders):
    """The scene, with folders of images of these widths."""
    np.save(folder / "poses_bounds.npy", rows() if table is None else table)
    for name, width in (folders or {"images_4": 80}).items():
        (folder / name).mkdir()
        for i in range(N):
            size = (width, round(width * FULL[1] / FULL[0]))
            Image.new("RGB", size, (i, width % 256, 0)).save(folder / name / f"IMG_{4026 + i}.png")
    return folder


def barf():
    """Camera-to-world poses as BARF's loader has them, from its description; world-to-camera at the end."""
    scale = 1 / (0.75 * 20.0)
    poses = [(R, scale * centre) for R, centre in map(axes, range(N))]
    centre = np.mean([c for _, c in poses], axis=0)
    v1, v2 = (np.mean([R[:, k] for R, _ in poses], axis=0) for k in (1, 2))
    v1, v2 = v1 / np.linalg.norm(v1), v2 / np.linalg.norm(v2)
    mean = np.stack([np.cross(v1, v2), v1, v2], -1)
    flip = np.diag([1.0, -1, -1])
    expected = []
    for R, c in poses:
        R, c = np.linalg.inv(mean) @ R, np.linalg.inv(mean) @ (c - centre)
        R = R @ flip
        R_w2c, t_w2c = R.T, -R.T @ c
        R_w2c = R_w2c @ flip  # the world as well
        expected.append(
            np.block([[R_w2c.T, (-R_w2c.T @ t_w2c)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        )
    return np.stack(expected)


def test_poses_follow_barf(tmp_path):
    train, held_out = llff.load(write(tmp_path))
    poses = np.concatenate([train.T_world_cam, held_out.T_world_cam])
    # BARF's mean camera is not quite orthonormal, ours is: they differ in second order of the spread.
    np.testing.assert_allclose(poses, barf(), atol=2e-3)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (N, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 3].mean(0), np.zeros(3), atol=1e-12)
    forward = R[:, :, 2].mean(0)
    assert forward[2] / np.linalg.norm(forward) > 0.9999  # the scene is in front, y is down
    gaps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    stated = np.linalg.norm(np.diff([axes(i)[1] for i in range(N)], axis=0), axis=1)
    np.testing.assert_allclose(gaps, stated / (0.75 * 20), rtol=1e-9)


def test_split_order_and_depths(tmp_path):
    train, held_out = llff.load(write(tmp_path))
    assert (len(train.t), len(held_out.t)) == (27, 2)  # int(0.1 * 29)
    assert held_out.files == ("images_4/IMG_4053.png", "images_4/IMG_4054.png")
    np.testing.assert_array_equal(train.t, 4026 + np.arange(27))
    assert held_out.rgb[1, 0, 0, 0] == 28
    assert train.rgb[3, 0, 0, 0] == 3
    assert (train.near, train.spacing) == (1.0, "disparity")
    assert 1 / train.far == pytest.approx(1e-8)
    assert any("1.33 to 8" in note for note in train.notes)
    assert any("frame number" in note for note in train.notes)


@pytest.mark.parametrize(
    "width, folder, size",
    [
        (None, "images", (160, 120)),
        (40, "images_8", (40, 30)),
        (41, "images_4", (41, 31)),
        (81, "images", (81, 61)),
    ],
)
def test_the_folder_that_fits(tmp_path, width, folder, size):
    train, _ = llff.load(write(tmp_path, images_4=80, images=160, images_8=40), width=width)
    assert train.files[0].startswith(f"{folder}/")
    assert train.rgb.shape[1:] == (size[1], size[0], 3)
    assert train.camera[4:6] == size
    assert train.camera.fx == pytest.approx(FOCAL * size[0] / FULL[0])
    assert train.camera.fy == pytest.approx(FOCAL * size[1] / FULL[1])
    assert train.camera[2:4] == pytest.approx(((size[0] - 1) / 2, (size[1] - 1) / 2))


# --- what cannot be used --------------------------------------------------------------------------------


def changed(row, column, value):
    table = rows()
    table[row, column] = value
    return table


@pytest.mark.parametrize(
    "table, message",
    [
        (changed(4, 3, np.nan), "poses_bounds.npy: row 4: expected finite numbers, got NaN"),
        (changed(4, 0, 9.0), "poses_bounds.npy: row 4: expected a rotation"),
        (changed(4, 15, 0.0), "row 4: expected a near depth above 0 and a far one beyond it, got 0 and 104"),
        (changed(4, 14, 200.0), "row 4: expected one height, width and focal length for all views"),
        (rows()[:1], "poses_bounds.npy: expected at least 3 views, 2 and one held out, got 1"),
        (rows()[:20], "images_4: expected 20 images, one for each row of poses_bounds.npy, got 29"),
        (rows()[:, :16], "expected rows of 17 numbers, got float64 of shape (29, 16)"),
        (np.array([{"a": 1}]), "poses_bounds.npy: expected an array of numbers, got entries of type |O"),
    ],
)
def test_bad_tables(tmp_path, table, message):
    with pytest.raises(DataError, match=re.escape(message)) as error:
        llff.load(write(tmp_path, table))
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_bad_images(tmp_path):
    write(tmp_path)
    with pytest.raises(DataError, match="expected images at least 81 wide, got at most 80"):
        llff.load(tmp_path, width=81)
    image = tmp_path / "images_4" / "IMG_4030.png"
    Image.new("RGB", (80, 61)).save(image)
    with pytest.raises(DataError, match="IMG_4030.png: expected 80x60, the size of the first, got 80x61"):
        llff.load(tmp_path)
    for file in image.parent.iterdir():
        Image.new("RGB", (80, 80)).save(file)
    with pytest.raises(DataError, match="IMG_4026.png: expected the shape of 320x240, as .*got 80x80"):
        llff.load(tmp_path)
    for file in image.parent.iterdir():
        file.unlink()
    with pytest.raises(DataError, match="expected images in images, images_4 or the like, got none"):
        llff.load(tmp_path)
    (tmp_path / "poses_bounds.npy").write_bytes(b"")
    with pytest.raises(DataError, match="poses_bounds.npy: expected an array of numbers"):
        llff.load(tmp_path)
    (tmp_path / "poses_bounds.npy").unlink()
    with pytest.raises(DataError, match="poses_bounds.npy: expected a file of poses and bounds, got nothing"):
        llff.load(tmp_path)


# --- the real one ---------------------------------------------------------------------------------------


def sweep(reference, other, T_other_reference, focal):
    """Mean over the image of the least difference to the other, warped by planes at 32 depths."""
    height, width = reference.shape
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(u)])
    costs = []
    for disparity in np.linspace(1 / 6.3, 1 / 1.33, 32):
        points = np.einsum("ij,jkl->ikl", T_other_reference[:3, :3], rays / disparity)
        x, y, z = points + T_other_reference[:3, 3, None, None]
        at = [focal * y / z + (height - 1) / 2, focal * x / z + (width - 1) / 2]
        costs.append(
            uniform_filter(np.abs(map_coordinates(other, at, order=1, mode="nearest") - reference), 7)
        )
    return np.min(costs, axis=0).mean()


@pytest.mark.data
def test_fern_matches_its_own_images(data_dir):
    train, held_out = llff.load(data_dir / "llff_fern", width=126)
    assert (len(train.t), len(held_out.t)) == (18, 2)
    assert train.rgb.shape == (18, 94, 126, 3)
    assert train.camera.fx == pytest.approx(3260.526 * 126 / 4032, rel=1e-4)
    gray = train.rgb.mean(-1) / 255
    for a, b in ((1, 2), (4, 14), (8, 7)):
        T_b_a = np.linalg.inv(train.T_world_cam[b]) @ train.T_world_cam[a]
        flip = np.diag([1.0, -1, -1, 1])
        right = sweep(gray[a], gray[b], T_b_a, train.camera.fx)
        for wrong in (np.linalg.inv(T_b_a), flip @ T_b_a @ flip, np.eye(4)):
            assert right < 0.75 * sweep(gray[a], gray[b], wrong, train.camera.fx)

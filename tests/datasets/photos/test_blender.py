"""Photographs of Blender, nerfstudio and instant-ngp against files written here, and the real lego."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxpose.datasets.photos import blender
from jaxpose.errors import DataError
from jaxpose.geometry import camera, se3

W, H = 24, 16
ANGLE = 0.8
POINT = np.array([0.2, -0.3, 0.1])  # the scene: one red point on nothing
LENS = {"k1": 0.05, "k2": -0.02, "p1": 0.003, "p2": -0.002}


def looking_at_the_origin(angle, radius=4.0):
    """Camera-to-world with axes right, up, back, as these files have it."""
    centre = radius * np.array([np.cos(angle), np.sin(angle), 0.3])
    back = centre / np.linalg.norm(centre)
    right = np.cross([0.0, 0, 1], back)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.stack([right, np.cross(back, right), back, centre], -1)
    return T


def dot(T, focal, lens=None, centre=(W / 2, H / 2)):
    """An image of `POINT`: transparent but for the pixel it falls in, counted from the outer corner."""
    x, y, z = np.linalg.inv(T)[:3] @ [*POINT, 1]
    x, y = x / -z, -y / -z
    if lens:
        r2 = x * x + y * y
        radial = 1 + lens["k1"] * r2 + lens["k2"] * r2 * r2
        x, y = (
            x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x * x),
            y * radial + lens["p1"] * (r2 + 2 * y * y) + 2 * lens["p2"] * x * y,
        )
    pixels = np.zeros((H, W, 4), np.uint8)
    pixels[int(np.floor(focal * y + centre[1])), int(np.floor(focal * x + centre[0]))] = [255, 0, 0, 255]
    return Image.fromarray(pixels)


def write(folder, name, count, *, header, suffix="", radius=4.0, draw=None, start=0.0):
    """A json file and its images; returns the content for a test to spoil."""
    split = name.removesuffix(".json").replace("transforms", "images").strip("_")
    (folder / split).mkdir(parents=True)
    frames = []
    for i in range(count):
        T = looking_at_the_origin(start + 0.3 * i, radius)
        image = draw(T) if draw else dot(T, 0.5 * W / np.tan(ANGLE / 2))
        image.save(folder / split / f"r_{i}.png")
        frames.append({"file_path": f"./{split}/r_{i}{suffix}", "transform_matrix": T.tolist()})
    content = {**header, "frames": frames}
    (folder / name).write_text(json.dumps(content))
    return content


def rewrite(folder, name, content):
    (folder / name).write_text(json.dumps(content))


def assert_the_point_is_where_it_was_drawn(photographs):
    points = jax.vmap(lambda T: se3.apply(se3.inverse(T), jnp.asarray(POINT, jnp.float32)))(
        jnp.asarray(photographs.T_world_cam, jnp.float32)
    )
    pixels = np.asarray(jax.jit(lambda p: camera.project(photographs.camera, p))(points))
    for image, (u, v) in zip(photographs.rgb, pixels, strict=True):
        red = np.argwhere((image == [255, 0, 0]).all(-1))
        assert len(red) == 1
        assert np.abs(red[0] - [v, u]).max() <= 0.5 + 1e-4
        assert (np.delete(image.reshape(-1, 3), red[0, 0] * W + red[0, 1], 0) == 255).all()


@pytest.fixture
def synthetic(tmp_path):
    write(tmp_path, "transforms_train.json", 12, header={"camera_angle_x": ANGLE})
    write(tmp_path, "transforms_test.json", 3, header={"camera_angle_x": ANGLE}, start=0.1)
    return tmp_path


def test_blender(synthetic):
    train, held_out = blender.load(synthetic)
    assert train.rgb.shape == (12, H, W, 3)
    assert held_out.rgb.shape == (3, H, W, 3)
    assert train.files[10] == "./images_train/r_10"  # by number, not r_1, r_10, r_11, r_2
    np.testing.assert_array_equal(train.t, np.arange(12))
    assert (train.near, train.far, train.spacing) == (2, 6, "depth")
    assert train.camera.fx == train.camera.fy == pytest.approx(0.5 * W / np.tan(ANGLE / 2))
    assert train.camera[2:] == (W / 2 - 0.5, H / 2 - 0.5, W, H, ())
    assert "frame number" in train.notes[0]
    for photographs in (train, held_out):
        assert photographs.T_world_cam.dtype == np.float64
        assert_the_point_is_where_it_was_drawn(photographs)


def test_a_file_may_be_named_and_a_test_file_lack(synthetic):
    (synthetic / "transforms_test.json").unlink()
    train, held_out = blender.load(synthetic / "transforms_train.json")
    assert [name.split("_")[-1] for name in held_out.files] == ["0", "8"]
    assert len(train.files) == 10
    assert any("every 8th" in note for note in train.notes)


@pytest.mark.parametrize("per_frame", [False, True])
def test_nerfstudio_with_a_lens(tmp_path, per_frame):
    focal, centre = 30.0, (11.0, 9.0)
    header = {"fl_x": focal, "fl_y": focal, "cx": 11.0, "cy": 9.0, "w": W, "h": H, **LENS}
    content = write(
        tmp_path,
        "transforms.json",
        10,
        header={"camera_model": "OPENCV"} if per_frame else header,
        suffix=".png",
        draw=lambda T: dot(T, focal, LENS, centre),
    )
    if per_frame:
        for frame in content["frames"]:
            frame.update(header)
    content["frames"].reverse()  # the order in the file does not matter
    rewrite(tmp_path, "transforms.json", content)
    (tmp_path / "images" / "r_3.png").unlink()
    train, held_out = blender.load(tmp_path)
    assert train.camera == (focal, focal, 10.5, 8.5, W, H, (0.05, -0.02, 0.003, -0.002, 0.0))
    assert train.t.tolist() == [1, 2, 4, 5, 6, 7, 8]  # a missing frame leaves its gap
    assert held_out.t.tolist() == [0, 9]
    assert "transforms.json: 1 frames without an image skipped" in train.notes
    assert_the_point_is_where_it_was_drawn(train)
    assert_the_point_is_where_it_was_drawn(held_out)


@pytest.mark.parametrize("key", ["time", "timestamp"])
def test_stamps_order_the_images(synthetic, key):
    for name, first in (("transforms_train.json", 100.0), ("transforms_test.json", 100.5)):
        content = json.loads((synthetic / name).read_text())
        for i, frame in enumerate(content["frames"]):
            frame[key] = first + (7 * i % 12)
        rewrite(synthetic, name, content)
    train, held_out = blender.load(synthetic)
    assert train.t.tolist() == list(range(12))
    assert train.files[1] == "./images_train/r_7"
    assert held_out.t.tolist() == [0.5, 2.5, 7.5]
    assert_the_point_is_where_it_was_drawn(train)
    assert not any("timestamp" in note for note in train.notes)
    for frame in content["frames"]:
        frame[key] = 0
    rewrite(synthetic, "transforms_test.json", content)
    _, held_out = blender.load(synthetic)
    assert f"transforms_test.json: {key} is not each frame's own, so not used" in held_out.notes
    assert held_out.t.tolist() == [0, 1, 2]


def test_resizing_averages_areas_on_white_and_keeps_directions(tmp_path):
    generator = np.random.default_rng(0)
    pixels = generator.integers(0, 256, (H, W, 4), np.uint8)
    write(
        tmp_path,
        "transforms.json",
        3,
        header={"camera_angle_x": ANGLE},
        draw=lambda _: Image.fromarray(pixels),
    )
    full, _ = blender.load(tmp_path)
    small, _ = blender.load(tmp_path, width=W // 2)
    alpha = pixels[..., 3:] / 255
    white = alpha * pixels[..., :3] + (1 - alpha) * 255
    assert np.abs(full.rgb[0] - white).max() <= 1
    means = white.reshape(H // 2, 2, W // 2, 2, 3).mean((1, 3))
    assert np.abs(small.rgb[0] - means).max() <= 1.5
    edges = jnp.asarray([[-0.5, -0.5], [W - 0.5, H - 0.5]])
    half = jnp.asarray([[-0.5, -0.5], [W / 2 - 0.5, H / 2 - 0.5]])
    np.testing.assert_allclose(
        camera.unproject(full.camera, edges), camera.unproject(small.camera, half), rtol=1e-6
    )


def opaque(_):
    return Image.new("RGB", (W, H), "gray")


@pytest.mark.parametrize(
    "header, draw, radius, expected",
    [
        ({"near": 1.0, "far": 9.0}, None, 4.0, (1.0, 9.0, "depth")),
        ({}, None, 40.0, (0.5 * 41.761, 1.5 * 41.761, "depth")),  # 40 sqrt(1 + 0.3^2) from the origin
        ({"fl_x": 20.0}, opaque, 40.0, (0.25 * 41.761, 8 * 41.761, "disparity")),
    ],
)
def test_depth_range(tmp_path, header, draw, radius, expected):
    header = {"camera_angle_x": ANGLE, **header}
    write(tmp_path, "transforms.json", 5, header=header, draw=draw, radius=radius)
    train, held_out = blender.load(tmp_path)
    assert train[5:8] == held_out[5:8]
    assert (train.near, train.far) == pytest.approx(expected[:2], rel=1e-4)
    assert train.spacing == expected[2]
    assert any("guessed" in note for note in train.notes) == ("near" not in header)


def test_cameras_that_look_all_one_way(tmp_path):
    content = write(tmp_path, "transforms.json", 5, header={"fl_x": 20.0}, draw=opaque)
    for i, frame in enumerate(content["frames"]):
        frame["transform_matrix"] = np.eye(4).tolist()
        frame["transform_matrix"][0][3] = float(i)
    rewrite(tmp_path, "transforms.json", content)
    train, _ = blender.load(tmp_path)
    assert (train.near, train.far, train.spacing) == (pytest.approx(0.2), pytest.approx(200), "disparity")


# --- what cannot be used --------------------------------------------------------------------------------


def spoil(**changes):
    def change(folder, content):
        content.update(changes)
        rewrite(folder, "transforms.json", content)

    return change


def spoil_frame(key, value):
    def change(folder, content):
        content["frames"][2][key] = value
        rewrite(folder, "transforms.json", content)

    return change


def fewer(count):
    return lambda folder, content: spoil(frames=content["frames"][:count])(folder, content)


def no_focal(folder, content):
    del content["camera_angle_x"]
    rewrite(folder, "transforms.json", content)


def no_images(folder, content):
    for image in (folder / "images").iterdir():
        image.unlink()


def other_size(folder, content):
    Image.new("RGB", (W, H + 1)).save(folder / "images" / "r_2.png")


def damaged(folder, content):
    (folder / "images" / "r_2.png").write_bytes(b"no image")


def deep(folder, content):
    Image.fromarray(np.zeros((H, W), np.uint16)).save(folder / "images" / "r_2.png")


NAN = [[float("nan")] * 4] * 4
MIRROR = np.diag([1.0, 1, -1, 1]).tolist()


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda folder, _: (folder / "transforms.json").unlink(),
            r"expected transforms_train.json or .*neither",
        ),
        (
            lambda folder, _: (folder / "transforms.json").write_text("{,"),
            r"transforms.json:1: expected JSON",
        ),
        (lambda folder, _: rewrite(folder, "transforms.json", []), r"expected a JSON object"),
        (spoil(frames="many"), r"expected a list of frames, got many"),
        (spoil_frame("file_path", None), r"expected a file_path in every frame"),
        (no_images, r"transforms.json: expected images beside it, got none of the 5"),
        (fewer(1), r"transforms.json: expected at least 3 images, got 1"),
        (fewer(0), r"expected images beside it, got none of the 0"),
        (no_focal, r"transforms.json: expected a focal length, fl_x or camera_angle_x, got neither"),
        (spoil(fl_x=0), r"expected a focal length above 0 px, got 0"),
        (spoil(camera_angle_x=0), r"expected a focal length above 0 px, got 0"),
        (spoil(fl_x="30"), r"expected a number for fl_x, got 30"),
        (spoil(cx=float("nan")), r"expected a number for cx, got nan"),
        (spoil(w=W + 1, h=H), rf"r_0.png: expected {W + 1}x{H}, as transforms.json states, got {W}x{H}"),
        (other_size, rf"r_2.png: expected {W}x{H}, the size of the first, got {W}x{H + 1}"),
        (damaged, r"r_2.png: expected an image, got cannot identify"),
        (deep, r"r_2.png: expected an image, got pixels of kind I;16, not of 8 bits"),
        (spoil_frame("transform_matrix", NAN), r"images/r_2: expected a finite pose, got NaN"),
        (spoil_frame("transform_matrix", MIRROR), r"images/r_2: expected a rotation, got a matrix"),
        (spoil_frame("transform_matrix", [[1.0]]), r"images/r_2: expected a transform_matrix of 4 rows"),
        (spoil_frame("transform_matrix", "none"), r"images/r_2: expected a transform_matrix of 4 rows"),
        (spoil_frame("fl_x", 31.0), r"images/r_2: expected the camera of ./images/r_0"),
        (spoil(camera_model="OPENCV_FISHEYE"), r"expected a camera_model of OPENCV, .*got OPENCV_FISHEYE"),
        (spoil(k4=0.1), r"expected a lens of k1 k2 p1 p2 k3, got k4 0.1"),
        (spoil(near=2, far=1), r"expected near above 0 and far beyond it, got 2 and 1"),
    ],
)
def test_bad_input_is_told_in_one_line(tmp_path, change, message):
    content = write(tmp_path, "transforms.json", 5, header={"camera_angle_x": ANGLE})
    change(tmp_path, content)
    with pytest.raises(DataError, match=message) as error:
        blender.load(tmp_path)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_bad_widths_and_unlike_cameras(synthetic):
    with pytest.raises(DataError, match="expected an image at least 25 wide, got 24"):
        blender.load(synthetic, width=25)
    with pytest.raises(ValueError, match="width: expected at least 1"):
        blender.load(synthetic, width=0)
    content = json.loads((synthetic / "transforms_test.json").read_text())
    rewrite(synthetic, "transforms_test.json", {**content, "camera_angle_x": 0.9})
    with pytest.raises(DataError, match="transforms_test.json: expected the camera of transforms_train.json"):
        blender.load(synthetic)


# --- the real one ---------------------------------------------------------------------------------------


@pytest.mark.data
def test_lego_is_one_solid_thing_in_all_views(data_dir):
    """Points that every training silhouette holds are inside those of the held-out views too."""
    train, held_out = blender.load(data_dir / "nerf_synthetic_lego", width=100)
    assert (len(train.t), len(held_out.t)) == (100, 25)
    assert (train.near, train.far, train.spacing) == (2, 6, "depth")
    assert train.camera.fx == pytest.approx(1111.111 / 8, rel=1e-5)
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (4000, 3))

    def inside(photographs):
        seen = []
        for T, image in zip(photographs.T_world_cam, photographs.rgb, strict=True):
            x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
            u = np.rint(train.camera.fx * x / z + train.camera.cx).astype(int)
            v = np.rint(train.camera.fy * y / z + train.camera.cy).astype(int)
            assert z.min() > 1
            known = (np.clip(u, 0, 99) == u) & (np.clip(v, 0, 99) == v)
            seen.append(known & (image[np.clip(v, 0, 99), np.clip(u, 0, 99)].min(-1) < 250))
        return np.stack(seen)

    solid = inside(train).mean(0) > 0.99
    assert 100 < solid.sum() < 1000
    assert inside(held_out)[:, solid].mean() > 0.98

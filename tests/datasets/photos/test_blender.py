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
        (lambda folder, _: rewrite(folder, "transforms.json", []), r"expected JSON, got no JSON object"),
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
        (damaged, r"r_2.png: expected an image, got bytes of no kind"),
        (deep, r"r_2.png: expected an image, got pixels of kind I;16, not of 8 bits"),
        (spoil_frame("transform_matrix", NAN), r"images/r_2: expected a finite pose, got NaN"),
        (spoil_frame("transform_matrix", MIRROR), r"images/r_2: expected a rotation, got a matrix"),
        (spoil_frame("transform_matrix", [[1.0]]), r"images/r_2: expected a transform_matrix of 4 rows"),
        (spoil_frame("transform_matrix", "none"), r"images/r_2: expected a transform_matrix of 4 rows"),
        (spoil(camera_model="EQUIRECTANGULAR"), r"expected a camera_model of OPENCV, .*got EQUIRECTANGULAR"),
        (spoil(w=0), r"expected w and h of at least 1 pixel, got 0 and 16"),
        (spoil_frame("mask_path", "m.png"), r"expected the mask of ./images/r_2, got no m.png"),
        (
            spoil(train_filenames=["a"], test_filenames=["b"]),
            r"to name frames with images, got 0 and 0 of them",
        ),
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


def test_bad_widths(synthetic):
    with pytest.raises(DataError, match="expected an image at least 25 wide, got 24"):
        blender.load(synthetic, width=25)
    with pytest.raises(ValueError, match="width: expected at least 1"):
        blender.load(synthetic, width=0)


# --- cameras that differ, masks, names, splits --------------------------------------------------------------


def red_points(photographs):
    """Where the red point is seen, to a fraction of a pixel, and where it should be."""
    points = (np.append(POINT, 1) @ np.linalg.inv(photographs.T_world_cam).swapaxes(1, 2))[:, :3]
    expected = camera.project_numpy(photographs.camera, points)
    away = 255.0 - photographs.rgb[..., 1]  # how far from white: the point is red on white
    grid = camera.pixel_grid(photographs.camera)
    found = (away[..., None] * grid).sum((1, 2)) / away.sum((1, 2))[:, None]
    return found, expected


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_each_frame_through_its_own_lens(tmp_path, model):
    """Focal lengths that differ, and a fisheye: images brought to one pinhole camera show the point alike."""
    focal = [30.0 + 2 * (i % 3) for i in range(9)]
    lens = {"k1": 0.05, "k2": -0.02, "k3": 0.0, "k4": 0.0} if "FISH" in model else LENS
    content = write(
        tmp_path, "transforms.json", 9, header={"camera_model": model, "h": H, "w": W}, suffix=".png"
    )
    for i, frame in enumerate(content["frames"]):
        T = np.array(frame["transform_matrix"])
        x, y, z = np.linalg.inv(T)[:3] @ [*POINT, 1]
        x, y, r2 = x / -z, -y / -z, (x * x + y * y) / (z * z)
        if "FISH" in model:
            theta = np.arctan(np.sqrt(r2))
            bent = theta * (1 + 0.05 * theta**2 - 0.02 * theta**4) / np.sqrt(r2)
            x, y = x * bent, y * bent
        else:
            bent, p1, p2 = 1 + 0.05 * r2 - 0.02 * r2 * r2, 0.003, -0.002
            x, y = (
                x * bent + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * bent + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        row, column = np.mgrid[:H, :W]
        away = (column + 0.5 - W / 2 - focal[i] * x) ** 2 + (row + 0.5 - H / 2 - focal[i] * y) ** 2
        white = np.rint(255 - 255 * np.exp(-away / 2)).astype(np.uint8)
        image = Image.fromarray(np.stack([np.full_like(white, 255), white, white], -1))
        image.save(tmp_path / "images" / f"r_{i}.png")
        frame.update({"fl_x": focal[i], "fl_y": focal[i], **lens})
    rewrite(tmp_path, "transforms.json", content)
    train, held_out = blender.load(tmp_path)
    assert train.camera == held_out.camera and not train.camera.distortion
    assert train.mask is not None and train.mask.mean() > 0.8
    assert any("brought to one pinhole camera" in note for note in train.notes)
    for photographs in (train, held_out):
        found, expected = red_points(photographs)
        assert np.abs(found - expected).max() < 0.06


def test_masks(tmp_path):
    """nerfstudio's count where they are bright, instant-ngp's where they are dark."""
    content = write(tmp_path, "transforms.json", 8, header={"camera_angle_x": ANGLE})
    kept = np.zeros((H, W), np.uint8)
    kept[4:12, 6:20] = 1
    (tmp_path / "masks").mkdir()
    Image.fromarray(255 * kept).save(tmp_path / "masks" / "m.png")
    Image.fromarray(kept).save(tmp_path / "masks" / "of_ones.png")
    Image.fromarray(np.uint8(255 * (1 - kept))).save(tmp_path / "images" / "dynamic_mask_r_3.png")
    content["frames"][1]["mask_path"] = "masks/m.png"
    content["frames"][2]["mask_path"] = "masks\\of_ones.png"
    rewrite(tmp_path, "transforms.json", content)
    train, held_out = blender.load(tmp_path)
    assert held_out.mask.all() and len(held_out.mask) == 1
    for row in range(3):
        np.testing.assert_array_equal(train.mask[row], kept == 1)
    assert train.mask[3:].all()
    small, _ = blender.load(tmp_path, width=W // 4)
    whole = kept.reshape(H // 4, 4, W // 4, 4).all((1, 3))  # only pixels whose whole area counts
    np.testing.assert_array_equal(small.mask[0], whole)
    Image.new("L", (W, W)).save(tmp_path / "masks" / "m.png")
    with pytest.raises(DataError, match=rf"m.png: expected a mask of {W}x{H}, as the image has, got {W}x{W}"):
        blender.load(tmp_path)


@pytest.mark.parametrize(
    "listed, train_rows, held_rows, said",
    [
        ({"train_filenames": [0, 1], "test_filenames": [2], "val_filenames": [3]}, [0, 1], [2], "2 images"),
        ({"val_filenames": [3]}, [0, 1, 2, 4], [3], "held out: the 1 images of val_filenames"),
        ({"train_filenames": [0, 1, 2, 3, 9], "test_filenames": [4]}, [0, 1, 2, 3], [4], "1 names of"),
    ],
)  # fmt: skip
def test_stated_splits(tmp_path, listed, train_rows, held_rows, said):
    content = write(tmp_path, "transforms.json", 5, header={"camera_angle_x": ANGLE})
    names = {key: [f"images/r_{i}" for i in rows] for key, rows in listed.items()}
    rewrite(tmp_path, "transforms.json", {**content, **names})
    train, held_out = blender.load(tmp_path)
    assert train.t.tolist() == train_rows and held_out.t.tolist() == held_rows
    assert any(said in note for note in train.notes), train.notes


def test_names_of_other_systems(tmp_path):
    """Backslashes, another case of name or suffix, a path of another machine; `._*` files are none."""
    content = write(tmp_path, "transforms.json", 6, header={"camera_angle_x": ANGLE}, suffix=".png")
    for i in (3, 4):
        (tmp_path / "images" / f"r_{i}.png").rename(tmp_path / "images" / f"R_{i}.PNG")
    for i in range(6):
        (tmp_path / "images" / f"._r_{i}.png").write_bytes(b"Mac OS X")
    frames = content["frames"]
    frames[1]["file_path"] = "images\\r_1.png"
    frames[2]["file_path"] = "C:\\Users\\me\\scan\\images\\r_2.png"
    frames[4]["file_path"] = "/home/me/scan/images/r_4.JPG"
    frames[5]["file_path"] = "images/../images//r_5"
    rewrite(tmp_path, "transforms.json", content)
    train, held_out = blender.load(tmp_path)
    assert len(train.t) + len(held_out.t) == 5  # there is no JPG: counted
    assert "transforms.json: 1 frames without an image skipped" in train.notes
    for photographs in (train, held_out):
        assert_the_point_is_where_it_was_drawn(photographs)


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags


def test_orientation_of_exif(tmp_path):
    """Images are turned if only so they have the stated size; else a note says that they are not."""
    content = write(tmp_path, "transforms.json", 5, header={"camera_angle_x": ANGLE, "w": W, "h": H})
    for i in range(5):
        with Image.open(tmp_path / "images" / f"r_{i}.png") as image:
            upright = image.copy()
        if i < 3:  # stored on its side: 6 says to turn it by 90 degrees to the right
            upright.transpose(Image.Transpose.ROTATE_90).save(
                tmp_path / "images" / f"r_{i}.png", exif=exif(6)
            )
        else:
            upright.save(tmp_path / "images" / f"r_{i}.png", exif=exif(3))
    train, held_out = blender.load(tmp_path)
    assert any("3 images turned by their EXIF orientation" in note for note in train.notes)
    assert any("EXIF orientation of 2 images not applied" in note for note in train.notes)
    for photographs in (train, held_out):
        assert_the_point_is_where_it_was_drawn(photographs)
    for frame in content["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]  # and rows of 3x4 are poses too
    rewrite(tmp_path, "transforms.json", content)
    np.testing.assert_array_equal(blender.load(tmp_path)[0].T_world_cam, train.T_world_cam)


def test_what_a_file_says_beside_is_reported(tmp_path):
    header = {
        "fl_x": 20.0,
        "fl_y": 20.0 * W / H,
        "w": W,
        "h": H,
        "rolling_shutter": [0, 0, 0.01],
        "aabb_scale": 4,
    }
    content = write(tmp_path, "transforms.json", 5, header=header, draw=opaque)
    content["frames"][0] |= {"exposure": 0.1, "sharpness": 5.0, "depth_file_path": "d.png"}
    rewrite(tmp_path, "transforms.json", content)
    notes = blender.load(tmp_path)[0].notes
    assert "transforms.json: keys not used: exposure, rolling_shutter" in notes
    assert any(
        "20 and 30 px, pixels that are not square, by the ratio of width and height" in n for n in notes
    )


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

"""Photographs with COLMAP's models, which COLMAP writes; and photographs alone."""

import json
import math

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from jaxpose.cli.check import command as check
from jaxpose.datasets.photos import colmap, plain, registry
from jaxpose.errors import DataError
from jaxpose.geometry.camera import project_numpy

W, H, COUNT = 48, 32, 10


def make(
    folder, *, models=("SIMPLE_RADIAL",), sparse="sparse/0", form="binary", images="images", size=(W, H)
):
    """A scene by COLMAP's generator; each image is white with a red blob where its point 1 is."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D, options.num_rigs, options.num_frames_per_rig = 60, len(models), COUNT // len(models)
    options.num_cameras_per_rig, options.camera_width, options.camera_height = 1, *size
    options.camera_model_id = getattr(pycolmap.CameraModelId, models[0])
    extra = {"SIMPLE_RADIAL": [0.05], "OPENCV_FISHEYE": [0.05, -0.01, 0.0, 0.0]}[models[0]]
    focal = [60.0] if models[0].startswith("SIMPLE") else [60.0, 60.0]
    options.camera_params = [*focal, size[0] / 2, size[1] / 2, *extra]
    pycolmap.set_random_seed(2)
    scene = pycolmap.synthesize_dataset(options)
    for number, camera in scene.cameras.items():
        camera.params = [*(np.array(focal) + 3 * (number - 1)), size[0] / 2, size[1] / 2, *extra]
    point = scene.points3D[1].xyz
    for image in scene.images.values():
        image.name = f"left/IMG_{image.image_id:04d}.JPG"
        u, v = scene.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)
        row, column = np.mgrid[: size[1], : size[0]]
        away = (column + 0.5 - u) ** 2 + (row + 0.5 - v) ** 2
        white = np.rint(255 - 255 * np.exp(-away / 4)).astype(np.uint8)
        file = folder / images / image.name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.stack([np.full_like(white, 255), white, white], -1)).save(file, quality=100)
    (folder / sparse).mkdir(parents=True, exist_ok=True)
    getattr(scene, f"write_{form}")(folder / sparse)
    return scene


def assert_point_is_seen(scene, photographs, most=0.25):
    """The red blob is where the point of the model falls by pose and camera."""
    T = np.linalg.inv(photographs.T_world_cam)
    points = (T @ np.append(scene.points3D[1].xyz, 1))[:, :3]
    expected = project_numpy(photographs.camera, points)
    column, row = np.meshgrid(np.arange(photographs.camera.width), np.arange(photographs.camera.height))
    for image, (u, v) in zip(photographs.rgb, expected, strict=True):
        near = (np.abs(column - u) < 6) & (np.abs(row - v) < 6)
        away = np.where(near, 255.0 - image[..., 1], 0)
        if min(u, v, photographs.camera.width - u, photographs.camera.height - v) < 6:
            continue
        found = np.array([(away * column).sum(), (away * row).sum()]) / away.sum()
        assert np.abs(found - [u, v]).max() < most


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("sparse", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_a_model_and_its_images(tmp_path, form, sparse):
    scene = make(tmp_path, sparse=sparse, form=form)
    assert registry.find_format(tmp_path) == "colmap"
    train, held_out = registry.load_photographs(tmp_path)
    assert (len(train.t), len(held_out.t)) == (8, 2)
    assert train.files[0] == "images/left/IMG_0002.JPG" and train.t[0] == 2
    assert train.camera.distortion[:2] == (0.05, 0.0) and train.mask is None
    for part in (train, held_out):
        assert_point_is_seen(scene, part)
    theirs = {image.name: image for image in scene.images.values()}
    for name, T in zip(train.files, train.T_world_cam, strict=True):
        image = theirs[name.removeprefix("images/")]
        np.testing.assert_allclose(T[:3], image.cam_from_world().inverse().matrix(), atol=1e-12)
    depths = [
        (image.cam_from_world() * point.xyz)[2]
        for image in scene.images.values()
        for point in scene.points3D.values()
    ]
    assert train.near == pytest.approx(0.8 * min(depths), rel=0.05) and train.spacing == "disparity"
    assert train.far == pytest.approx(4 * max(depths), rel=0.05)
    assert colmap.images_folder(tmp_path) == tmp_path.resolve()


@pytest.mark.parametrize("models", [("OPENCV_FISHEYE",), ("SIMPLE_RADIAL", "SIMPLE_RADIAL")])
def test_fisheyes_and_several_cameras(tmp_path, models):
    scene = make(tmp_path, models=models)
    train, held_out = registry.load_photographs(tmp_path)
    assert train.camera.distortion == () and train.mask is not None
    assert any("brought to one pinhole camera" in note for note in train.notes)
    for part in (train, held_out):
        assert_point_is_seen(scene, part)
    assert len(set(train.lenses)) == len(models)


def test_reduced_images_masks_and_images_that_lack(tmp_path):
    scene = make(tmp_path, images="images_2", size=(W // 2, H // 2))
    for camera in scene.cameras.values():  # the model is of images twice as large, which are not there
        camera.rescale(W, H)
    scene.write_binary(tmp_path / "sparse" / "0")
    mask = np.full((H // 2, W // 2), 255, np.uint8)
    mask[:, :4] = 0
    (tmp_path / "masks" / "left").mkdir(parents=True)
    Image.fromarray(mask).save(tmp_path / "masks" / "left" / "IMG_0002.JPG.png")
    (tmp_path / "images_2" / "left" / "IMG_0005.JPG").unlink()
    train, held_out = registry.load_photographs(tmp_path)
    assert "9 images are smaller than the model states: intrinsics scaled" in train.notes
    assert any("1 images of the model are not in" in note and "IMG_0005" in note for note in train.notes)
    assert train.camera.fx == pytest.approx(30) or train.camera.fx == pytest.approx(60)
    for part in (train, held_out):
        assert_point_is_seen(scene, part)
    np.testing.assert_array_equal(train.mask[0], mask > 0)
    assert train.mask[1:].all()
    checked = check.run(check.Config(tmp_path))
    assert checked.format == "photographs, COLMAP" and not checked.findings[0].severity == "error"


def test_a_model_without_images_is_checked_and_not_trained_on(tmp_path):
    make(tmp_path, images="elsewhere")
    with pytest.raises(
        DataError, match="sparse/0: expected its 10 images in images beside or above it, got none"
    ):
        registry.load_photographs(tmp_path / "sparse")
    checked = check.run(check.Config(tmp_path / "sparse"))
    assert any(fact.text == "10 images, 1 cameras, 60 points" for fact in checked.facts)
    assert [f.test for f in checked.findings if f.severity == "warning"] == ["images"]


def test_what_is_no_photographs(tmp_path):
    with pytest.raises(
        DataError, match=r"expected photographs, with poses_bounds.npy .*, got an empty folder"
    ):
        registry.load_photographs(tmp_path)
    make(tmp_path)
    with pytest.raises(DataError, match="expected no focal length with a sparse model"):
        registry.load_photographs(tmp_path, focal_px=3.0)
    cameras = tmp_path / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(cameras.read_bytes()[:-4])
    with pytest.raises(DataError, match="cameras.bin: expected a whole file of COLMAP"):
        registry.load_photographs(tmp_path)
    with pytest.raises(DataError, match="expected a model of COLMAP, cameras and images .*, got none"):
        colmap.find_model(tmp_path / "images")


# --- photographs alone ----------------------------------------------------------------------------------


def photos(folder, count=5, *, film=None, plane=None, orientation=1, name="P{}.JPG"):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        inner = exif.get_ifd(ExifTags.IFD.Exif)
        if film:
            inner[ExifTags.Base.FocalLengthIn35mmFilm] = film
        if plane:
            inner |= plane
        pixels = np.zeros((H, W, 3), np.uint8)
        pixels[: H // 2] = [0, 200, 0]
        Image.fromarray(pixels).save(folder / name.format(i + 8), exif=exif, quality=95)


def test_focal_lengths_by_exif(tmp_path):
    photos(tmp_path / "film" / "images", film=26)
    (tmp_path / "film" / "images" / "._P8.JPG").write_bytes(b"Mac OS X")
    train, held_out = plain.load(tmp_path / "film")
    assert train.files == tuple(f"images/P{i}.JPG" for i in range(8, 13)) and len(held_out.t) == 0
    diagonal = 2 * math.atan(math.hypot(36, 24) / 2 / 26)  # the angle that a 26 mm lens sees on film
    assert train.camera.fx == pytest.approx(math.hypot(W, H) / 2 / math.tan(diagonal / 2), rel=1e-4)
    assert np.isnan(train.T_world_cam).all() and (train.near, train.spacing) == (1.0, "disparity")
    assert train.t.tolist() == [8, 9, 10, 11, 12]
    # A 6 mm lens on a sensor with 4000 pixels on 8 mm, the photograph kept at 48 pixels across.
    names = ExifTags.Base
    plane = {
        names.FocalLength: 6.0,
        names.FocalPlaneXResolution: 500.0,
        names.FocalPlaneResolutionUnit: 4,
        names.ExifImageWidth: 4000,
    }
    photos(tmp_path / "plane", plane=plane)
    assert plain.load(tmp_path / "plane")[0].camera.fx == pytest.approx(6 / 8 * W)


def test_photographs_alone_stand_upright(tmp_path):
    photos(tmp_path, film=26, orientation=6)  # to be turned to the right: the upper edge as stored
    train, _ = registry.load_photographs(tmp_path)
    assert train.rgb.shape[1:3] == (W, H)
    assert train.rgb[:, :, -4:, 1].min() > 150 and train.rgb[:, :, :4].max() < 60
    assert "5 images turned by their EXIF orientation, to the size of the camera" in train.notes


def test_photographs_alone_that_cannot_be_used(tmp_path):
    photos(tmp_path / "bare")
    with pytest.raises(DataError, match="P8.JPG: expected a focal length in its EXIF, got none: --focal-px"):
        plain.load(tmp_path / "bare")
    assert plain.load(tmp_path / "bare", focal_px=40.0)[0].camera.fx == 40
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(
        DataError, match="raw: expected photographs, got files to convert to JPEG .*IMG_1.HEIC"
    ):
        plain.load(tmp_path / "raw")
    (tmp_path / "bare" / "P9.JPG").write_bytes(b"")
    with pytest.raises(DataError, match="P9.JPG: expected an image"):
        plain.load(tmp_path / "bare", focal_px=40.0)


def test_notes_are_json(tmp_path):
    photos(tmp_path, film=26)
    assert json.dumps(plain.load(tmp_path)[0].notes)

"""COLMAP's sparse models, binary and text: cameras, images with their poses, points.

The layout is that of COLMAP's documentation ("Output Format"). The reader is an own one: COLMAP's hangs on a
points3D.bin that ends early, and takes a cameras.bin that ends early for whole.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.opening import open_text, read_bytes
from jaxpose.files.schema import FARTHEST_M
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera

# The models by their numbers in binary files, and how many parameters each has.
MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)  # fmt: skip
_FILES = ("cameras", "images", "points3D")
_NO_POINT = 2**64 - 1


class ColmapCamera(NamedTuple):
    """A camera as COLMAP has it: the centre of the first pixel is (0.5, 0.5)."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class ColmapModel(NamedTuple):
    """A sparse model.

    Attributes:
        cameras: By their numbers.
        names: Of the images, in the order of the file.
        camera_ids: The camera of each image.
        T_world_cam: Poses (n, 4, 4), camera axes OpenCV's.
        points: Of the scene (m, 3).
        rgb: Their colours (m, 3).
        seen: For each image the rows of the points that were matched in it.
    """

    cameras: dict[int, ColmapCamera]
    names: tuple[str, ...]
    camera_ids: tuple[int, ...]
    T_world_cam: Float[np.ndarray, "n 4 4"]
    points: Float[np.ndarray, "m 3"]
    rgb: UInt8[np.ndarray, "m 3"]
    seen: tuple[Int[np.ndarray, " k"], ...]


def is_colmap(folder: Path) -> bool:
    """Whether a folder holds a sparse model: the files of cameras and images, binary or text.

    Args:
        folder: Any folder.

    Returns:
        Whether `read_colmap` should read it.
    """
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in _FILES[:2]) for suffix in (".bin", ".txt")
    )


def read_colmap(folder: Path | str) -> ColmapModel:
    """Read a sparse model; binary files go before text, as in COLMAP, and points may lack.

    Args:
        folder: With `cameras`, `images` and `points3D`, each `.bin` or `.txt`.

    Returns:
        The model.

    Raises:
        DataError: Naming the file for what is missing, ends early, or is no number where one belongs.
    """
    folder = Path(folder)
    suffix = ".bin" if all((folder / f"{name}.bin").is_file() for name in _FILES[:2]) else ".txt"
    files = [folder / f"{name}{suffix}" for name in _FILES]
    for file in files[:2]:
        if not file.is_file():
            raise DataError(f"{file}: expected a file of COLMAP, cameras and images, got nothing")
    readers = (_binary_cameras, _binary_images, _binary_points)
    if suffix == ".txt":
        readers = (_text_cameras, _text_images, _text_points)
    cameras = dict(_parsed(files[0], readers[0]))
    images = list(_parsed(files[1], readers[1]))
    points = list(_parsed(files[2], readers[2])) if files[2].is_file() else []
    if not images:
        raise DataError(f"{files[1]}: expected images with poses, got none")
    names, camera_ids, wxyz, translation, matched = zip(*images, strict=True)
    for name, camera in zip(names, camera_ids, strict=True):
        if camera not in cameras:
            raise DataError(f"{files[1]}: expected a camera of {files[0].name} for {name}, got {camera}")
    rows = {number: row for row, (number, *_) in enumerate(points)}
    xyz = np.array([xyz for _, xyz, _ in points], np.float64).reshape(-1, 3)
    for row in np.flatnonzero(~(np.abs(xyz) <= FARTHEST_M).all(1)):
        raise DataError(f"{files[2]}: expected points up to {FARTHEST_M:g} away, got {xyz[row]}")
    seen = tuple(np.array([rows[k] for k in ids if k in rows], np.int64) for ids in matched)
    return ColmapModel(
        cameras,
        names,
        camera_ids,
        _poses(files[1], names, np.array(wxyz), np.array(translation)),
        xyz,
        np.array([rgb for *_, rgb in points], np.uint8).reshape(-1, 3),
        seen,
    )


def write_colmap(
    folder: Path | str,
    camera: Camera,
    images: Sequence[str],
    T_world_cam: Float[np.ndarray, "n 4 4"],
    *,
    points: Float[np.ndarray, "m 3"] | None = None,
    rgb: UInt8[np.ndarray, "m 3"] | None = None,
    binary: bool = False,
) -> None:
    """Write one camera, the pose of each image by its name, and points without their matches.

    Image poses are world-to-camera, quaternions wxyz, camera axes OpenCV's; the centre of the first pixel is
    (0.5, 0.5).

    Args:
        folder: Made if it is not there; `cameras`, `images` and `points3D` are written, each whole.
        camera: Of all images.
        images: Their names (n,), each its own, in text without blanks.
        T_world_cam: Poses (n, 4, 4), finite.
        points: Of the scene (m, 3); None: none.
        rgb: Their colours (m, 3), given with them.
        binary: Whether the files are binary.

    Raises:
        DataError: For poses with NaN, and for names that repeat or hold blanks.
        ValueError: For an array of another shape.
    """
    folder = Path(folder)
    points = np.zeros((0, 3)) if points is None else points
    rgb = np.zeros((0, 3), np.uint8) if rgb is None else rgb
    check_shapes(
        images=(images, "n"), T_world_cam=(T_world_cam, "n 4 4"), points=(points, "m 3"), rgb=(rgb, "m 3")
    )
    _check_images(folder, images, T_world_cam, blanks=binary)
    folder.mkdir(parents=True, exist_ok=True)
    R_cam_world = T_world_cam[:, :3, :3].swapaxes(1, 2)
    wxyz = Rotation.from_matrix(R_cam_world).as_quat(canonical=True, scalar_first=True)
    translation = -np.einsum("nij,nj->ni", R_cam_world, T_world_cam[:, :3, 3])
    poses = np.hstack([wxyz, translation]).tolist()
    write = _binary_content if binary else _text_content
    for name, content in zip(_FILES, write(_model(camera), images, poses, points, rgb), strict=True):
        with atomic(folder / f"{name}{'.bin' if binary else '.txt'}") as temporary:
            temporary.write_bytes(content)


def _check_images(
    folder: Path, images: Sequence[str], T_world_cam: Float[np.ndarray, "n 4 4"], *, blanks: bool
) -> None:
    finite = np.isfinite(T_world_cam).all((1, 2))
    if not finite.all():
        raise DataError(
            f"{folder}: expected finite poses, got NaN or infinity for {images[int(finite.argmin())]}"
        )
    for name in images:
        if not name or "\0" in name or (not blanks and any(letter.isspace() for letter in name)):
            raise DataError(f"{folder}: expected image names without blanks, got {name!r}")
    if len(set(images)) != len(images):
        raise DataError(f"{folder}: expected a name for each image, got the same one twice")


def _model(camera: Camera) -> ColmapCamera:
    """The least of COLMAP's camera models that holds the distortion, and its parameters."""
    pinhole = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    size = (camera.width, camera.height)
    if not any(camera.distortion):
        return ColmapCamera("PINHOLE", *size, pinhole)
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
    if k3 == 0:
        return ColmapCamera("OPENCV", *size, (*pinhole, k1, k2, p1, p2))
    return ColmapCamera("FULL_OPENCV", *size, (*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))


def _poses(
    file: Path, names: Sequence[str], wxyz: Float[np.ndarray, "n 4"], translation: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world of COLMAP's world-to-camera."""
    norm = np.linalg.norm(wxyz, axis=1)
    for row in np.flatnonzero(~((np.abs(norm - 1) < 1e-2) & np.isfinite(translation).all(1))):
        got = " ".join(f"{number:g}" for number in (*wxyz[row], *translation[row]))
        raise DataError(f"{file}: expected a unit quaternion and a position for {names[int(row)]}, got {got}")
    rotation = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    return rigid.inverse(rigid.make(rotation, translation))


# Both encodings give cameras as (number, camera), points as (number, xyz, rgb), and images as (name, camera,
# wxyz, translation, numbers of matched points).


def _parsed(file: Path, read: Any) -> Iterator[Any]:
    try:
        yield from read(file)
    except (struct.error, EOFError, ValueError, IndexError, OverflowError) as error:
        raise DataError(f"{file}: expected a whole file of COLMAP, got {_words(error)}") from None


def _words(error: Exception) -> str:
    return "one that ends early" if isinstance(error, struct.error | EOFError) else str(error)[:80]


def _binary_cameras(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    content = memoryview(read_bytes(file))
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<IiQQ", content, at)
        if not 0 <= model < len(MODELS):
            raise ValueError(f"a camera model of number {model}")
        name, length = MODELS[model]
        yield number, _camera(name, width, height, struct.unpack_from(f"<{length}d", content, at + 24))
        at += 24 + 8 * length


def _binary_images(file: Path) -> Iterator[tuple[Any, ...]]:
    content = read_bytes(file)
    kind = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<I7dI", content, at)
        end = content.find(b"\0", at + 64)
        if end < 0:
            raise EOFError
        name = content[at + 64 : end].decode("utf-8", "surrogateescape")
        (matches,) = struct.unpack_from("<Q", content, end + 1)
        at = end + 9 + kind.itemsize * matches
        if at > len(content):
            raise EOFError
        points = np.frombuffer(content, kind, matches, end + 9)["point"]
        yield name, camera, pose[:4], pose[4:], points[points != _NO_POINT].tolist()


def _binary_points(file: Path) -> Iterator[tuple[int, Any, Any]]:
    content = memoryview(read_bytes(file))
    point = struct.Struct("<Q3d3BdQ")
    (count,), at = struct.unpack_from("<Q", content), 8
    for _ in range(count):
        number, x, y, z, red, green, blue, _, track = point.unpack_from(content, at)
        at += point.size + 8 * track
        if at > len(content):
            raise EOFError
        yield number, (x, y, z), (red, green, blue)


def _camera(model: str, width: Any, height: Any, parameters: Sequence[Any]) -> ColmapCamera:
    """A camera, checked; ValueError for another number of parameters, and for no size."""
    length = dict(MODELS).get(model)
    if length != len(parameters):
        raise ValueError(f"{model} with {len(parameters)} parameters")
    camera = ColmapCamera(model, int(width), int(height), tuple(map(float, parameters)))
    if not (0 < camera.width < 1 << 20 and 0 < camera.height < 1 << 20 and np.isfinite(parameters).all()):
        raise ValueError(f"{model} of {width}x{height} with {' '.join(map(str, parameters))}")
    return camera


def _lines(file: Path) -> Iterator[str]:
    with open_text(file, "surrogateescape") as lines:
        yield from (line.rstrip("\r\n") for line in lines if not line.startswith("#"))


def _text_cameras(file: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for line in _lines(file):
        if line.strip():
            number, model, width, height, *parameters = line.split()
            yield int(number), _camera(model, width, height, [float(word) for word in parameters])


def _text_images(file: Path) -> Iterator[tuple[Any, ...]]:
    lines = _lines(file)
    for line in lines:
        if not line.strip():
            continue
        _, *pose, camera, name = line.split(maxsplit=9)
        points = np.array(next(lines, "").split()[2::3], np.int64)  # the line of matches may be empty
        numbers = [float(word) for word in pose]
        if len(numbers) != 7:
            raise ValueError(f"{line[:60]!r}, not a number, a pose, a camera and a name")
        yield name.strip(), int(camera), numbers[:4], numbers[4:], points[points >= 0].tolist()


def _text_points(file: Path) -> Iterator[tuple[int, Any, Any]]:
    for line in _lines(file):
        if line.strip():
            number, *xyz_rgb = line.split()[:7]
            numbers = [float(word) for word in xyz_rgb]
            if len(numbers) != 6 or not all(0 <= channel <= 255 for channel in numbers[3:]):
                raise ValueError(f"{line[:60]!r}, not a number, x y z and r g b to 255")
            yield int(number), numbers[:3], numbers[3:]


def _text_content(
    model: ColmapCamera, images: Sequence[str], poses: list[list[float]], points: Any, rgb: Any
) -> Iterator[bytes]:
    numbers = " ".join(map(repr, map(float, model.parameters)))
    head = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n"
    yield f"{head}1 {model.model} {model.width} {model.height} {numbers}\n".encode()
    lines = [
        f"{number} {' '.join(map(repr, row))} 1 {name}\n\n"  # the empty line: no point is matched in it
        for number, (row, name) in enumerate(zip(poses, images, strict=True), start=1)
    ]
    head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as X Y POINT3D_ID\n"
    yield (head + "".join(lines)).encode("utf-8", "surrogateescape")
    rows = enumerate(zip(np.asarray(points, float).tolist(), np.asarray(rgb).tolist(), strict=True), start=1)
    lines = [
        f"{number} {' '.join(map(repr, xyz))} {' '.join(map(str, colour))} 0\n"
        for number, (xyz, colour) in rows
    ]
    yield ("# POINT3D_ID X Y Z R G B ERROR TRACK[]\n" + "".join(lines)).encode()


def _binary_content(
    model: ColmapCamera, images: Sequence[str], poses: list[list[float]], points: Any, rgb: Any
) -> Iterator[bytes]:
    number = [name for name, _ in MODELS].index(model.model)
    sizes = struct.pack("<QIiQQ", 1, 1, number, model.width, model.height)
    yield sizes + np.asarray(model.parameters, "<f8").tobytes()
    records = [struct.pack("<Q", len(images))]
    for image, (pose, name) in enumerate(zip(poses, images, strict=True), start=1):
        encoded = name.encode("utf-8", "surrogateescape")
        records.append(struct.pack("<I7dI", image, *pose, 1) + encoded + b"\0" + struct.pack("<Q", 0))
    yield b"".join(records)
    kind = [("number", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    table = np.zeros(len(points), np.dtype(kind))
    table["number"], table["xyz"], table["rgb"] = np.arange(1, len(points) + 1), points, rgb
    yield struct.pack("<Q", len(points)) + table.tobytes()

"""PLY files (Stanford's polygon format): point clouds and meshes."""

from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.atomic import atomic
from jaxpose.files.opening import open_file
from jaxpose.files.schema import FARTHEST_M
from jaxpose.files.untrusted import reading

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_coloured_points(path: Path | str) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Read points with colours, as `write_ply` writes them.

    Args:
        path: A binary PLY file whose vertices have x, y, z and red, green, blue of 8 bits.

    Returns:
        x, y, z (n, 3), float64, and colours (n, 3).

    Raises:
        DataError: Naming the file for what cannot be read.
    """
    path = Path(path)
    with open_file(path) as stream, reading(path, "a PLY file"):
        form, count, properties, _ = _header(path, stream)
        wanted = dict.fromkeys(("red", "green", "blue"), "u1")
        found = dict(properties)
        if form == "ascii" or any(found.get(name) != code for name, code in wanted.items()):
            raise DataError(f"{path}: expected binary vertices with red green blue of 8 bits, got others")
        if missing := [axis for axis in "xyz" if axis not in found]:
            raise DataError(f"{path}: expected vertices with x y z, got no {' '.join(missing)}")
        vertices = _vertices(path, stream, form, count, properties)
        points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
        return _near(path, points), np.stack([vertices[name] for name in wanted], axis=1)


def read_points(path: Path | str) -> Float[np.ndarray, "n 3"]:
    """Read the vertices of a PLY file, ascii or binary; all else in it is passed over.

    Args:
        path: Vertices must come before other elements and have no lists, as scanners and mesh tools write
            them.

    Returns:
        x, y, z (n, 3), float64.

    Raises:
        DataError: Naming the file (and the line of a header or text) for what cannot be read.
    """
    path = Path(path)
    with open_file(path) as stream, reading(path, "a PLY file"):
        form, count, properties, lines = _header(path, stream)
        names = [name for name, _ in properties]
        missing = [axis for axis in "xyz" if axis not in names]
        if missing or count == 0:
            got = f"no {' '.join(missing)}" if missing else "none"
            raise DataError(f"{path}: expected vertices with x y z, got {got}")
        if form == "ascii":
            most = (path.stat().st_size - stream.tell() + 1) // (2 * len(names))  # a digit and what ends it
            if most < count:
                raise DataError(f"{path}: expected {count} vertices, got at most {most}")
            return _text(path, stream, count, [names.index(axis) for axis in "xyz"], lines)
        vertices = _vertices(path, stream, form, count, properties)
        points = np.empty((count, 3))
        for k, axis in enumerate("xyz"):
            points[:, k] = vertices[axis]
        return _near(path, points)


def write_ply(
    path: Path | str,
    points: Float[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"] | None = None,
) -> None:
    """Write coloured points, or triangles between them too, as binary PLY in float32.

    Args:
        path: The file, written whole or not at all.
        points: (n, 3) [m].
        rgb: Colours (n, 3), uint8.
        faces: Corners (m, 3) of triangles, as rows of `points`.

    Raises:
        ValueError: For arrays of other shapes or types, and for corners that are no rows of `points`.
    """
    check_shapes(points=(points, "n 3"), rgb=(rgb, "n 3"))
    if np.asarray(rgb).dtype != np.uint8:
        raise ValueError(f"rgb: expected uint8, got {np.asarray(rgb).dtype}")
    if faces is not None:
        check_shapes(faces=(faces, "m 3"))
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(points):
            raise ValueError(
                f"faces: expected rows of {len(points)} points, got {faces.min()} to {faces.max()}"
            )
    vertex = np.dtype([(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    vertices = np.empty(len(points), vertex)
    for k, axis in enumerate("xyz"):
        vertices[axis] = points[:, k]
    for k, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = rgb[:, k]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    triangles = np.empty(0 if faces is None else len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles["count"], triangles["corners"] = 3, faces
    with atomic(path) as temporary, temporary.open("wb") as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode())
        stream.write(vertices.tobytes())
        stream.write(triangles.tobytes())


def _header(path: Path, stream: BinaryIO) -> tuple[str, int, list[tuple[str, str]], int]:
    """Encoding, number of vertices, their properties as numpy types, and the lines of the header."""
    form, count, element, number = "", 0, "", 0
    properties: list[tuple[str, str]] = []
    elements: list[str] = []
    for number, line in enumerate(iter(lambda: stream.readline(1000), b""), start=1):
        words = line.decode("ascii", "replace").split() or [""]
        match words:
            case ["ply"] if number == 1:
                continue
            case _ if number == 1:
                raise DataError(f"{path}:1: expected a PLY file, which begins with ply, got {line[:20]!r}")
            case ["end_header"]:
                break
            case ["format", encoding, _] if encoding == "ascii" or encoding in _ORDERS:
                form = encoding
            case ["element", name, size] if size.isdecimal():
                element = name
                elements.append(name)
                count = int(size) if name == "vertex" else count
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                properties.append((name, _TYPES[kind]))
            case ["property", *_] if element not in ("vertex", ""):
                continue
            case ["comment" | "obj_info", *_]:
                continue
            case _:
                raise DataError(f"{path}:{number}: expected a line of a PLY header, got {line[:60]!r}")
    else:
        raise DataError(f"{path}: expected a PLY header with end_header, got {number} lines without")
    if not form or elements[:1] != ["vertex"]:
        got = "no format" if not form else f"{elements[0] if elements else 'none'} first"
        raise DataError(f"{path}: expected a PLY header with format and vertices first, got {got}")
    return form, count, properties, number


def _vertices(
    path: Path, stream: BinaryIO, form: str, count: int, properties: list[tuple[str, str]]
) -> np.ndarray:
    """The binary vertices after a header, a field for each property; DataError where the file has fewer."""
    kind = np.dtype([(name, _ORDERS[form] + code) for name, code in properties])
    there = (path.stat().st_size - stream.tell()) // kind.itemsize
    if there < count:
        raise DataError(f"{path}: expected {count} vertices, got {there}")
    return np.fromfile(stream, kind, count)


def _text(
    path: Path, stream: BinaryIO, count: int, columns: list[int], above: int
) -> Float[np.ndarray, "n 3"]:
    try:
        points = np.loadtxt(
            islice(filter(bytes.strip, stream), count), np.float64, usecols=columns, ndmin=2, comments=None
        )
    except ValueError as error:
        raise DataError(
            f"{path}: expected {count} lines of numbers below line {above}, got {error}"
        ) from None
    if len(points) != count:
        raise DataError(f"{path}: expected {count} vertices, got {len(points)}")
    return _near(path, points)


def _near(path: Path, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The points, those with NaN or infinity as they are; DataError for what is too far."""
    if points.size and points.min() >= -FARTHEST_M and points.max() <= FARTHEST_M:
        return points
    known = np.isfinite(points).all(1)
    for row in np.flatnonzero(known & ~(np.abs(points) <= FARTHEST_M).all(1)):
        raise DataError(f"{path}: expected points up to {FARTHEST_M:g} m away, got {points[row]}")
    return points

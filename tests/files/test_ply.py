"""Points of PLY files, ascii and binary, with what scanners and mesh tools put beside them."""

import numpy as np
import pytest

from jaxpose.errors import DataError
from jaxpose.files.ply import read_coloured_points, read_points, write_ply

POINTS = np.array([[1.5, -2.25, 3.125], [0.1, 0.2, 0.3], [1e6, -1e-3, 7.0]])


def header(encoding, kind, count=3):
    return (
        f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex {count}\nproperty uchar red\n"
        f"property {kind} x\nproperty {kind} y\nproperty int32 label\nproperty {kind} z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


@pytest.mark.parametrize("encoding, order", [("binary_little_endian", "<"), ("binary_big_endian", ">")])
@pytest.mark.parametrize("kind, code", [("float", "f4"), ("float32", "f4"), ("double", "f8")])
def test_binary(tmp_path, encoding, order, kind, code):
    rows = np.zeros(
        3, [("r", "u1"), *((a, order + code) for a in "xy"), ("l", order + "i4"), ("z", order + code)]
    )
    rows["x"], rows["y"], rows["z"] = POINTS.T
    rows["r"], rows["l"] = [1, 2, 255], [9, -9, 10**6]
    faces = b"\x03" + np.array([0, 1, 2], order + "i4").tobytes()
    (tmp_path / "a.ply").write_bytes(header(encoding, kind) + rows.tobytes() + faces)
    points = read_points(tmp_path / "a.ply")
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, POINTS.astype(code))


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_text(tmp_path, end):
    lines = [f"7 {x!r} {y!r} 5 {z!r}" for x, y, z in POINTS.tolist()] + ["3 0 1 2", ""]
    text = header("ascii", "float").decode().replace("\n", end) + end.join(lines)
    (tmp_path / "a.ply").write_bytes(text.encode())
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply"), POINTS)


TEXT = header("ascii", "float")


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", r": expected a PLY header with end_header, got 0 lines"),
        (b"solid cube\n", r":1: expected a PLY file, which begins with ply, got b'solid cube"),
        (TEXT[: TEXT.index(b"end_header")], r": expected a PLY header with end_header, got 11 lines"),
        (TEXT.replace(b"ascii", b"zip"), r":2: expected a line of a PLY header, got b'format zip 1.0"),
        (TEXT.replace(b"float x", b"list uchar int x"), r":6: expected a line of a PLY header"),
        (TEXT.replace(b" z\n", b" w\n"), r": expected vertices with x y z, got no z"),
        (TEXT.replace(b"vertex 3", b"vertex 0"), r": expected vertices with x y z, got none"),
        (TEXT.replace(b"format ascii 1.0\n", b""), r": expected a PLY header with format .*, got no format"),
        (
            TEXT.replace(b"element vertex 3", b"element camera 1\nproperty float f\nelement vertex 3"),
            r": expected a PLY header with .*, got camera first",
        ),
        (TEXT + b"7 1 2 3 4\n", r": expected 3 vertices, got at most 1"),
        (TEXT + b"7 1 2 3 4\n\n\n" + b"\n" * 20, r": expected 3 vertices, got 1"),
        (
            header("ascii", "float", 2**32) + b"7 1 2 3 4\n" * 3,
            r": expected 4294967296 vertices, got at most",
        ),
        (
            TEXT + b"7 1 2 3 4\n7 1 two 3 4\n7 1 2 3 4\n",
            r": expected 3 lines of numbers below line 12, got .*two",
        ),
        (header("binary_little_endian", "float") + bytes(20), r": expected 3 vertices, got 1"),
        (header("binary_little_endian", "float", 10**13), r": expected 10000000000000 vertices, got 0"),
        (TEXT.replace(b"float y\n", b"float x\n"), r": expected vertices with x y z, got no y"),
        (
            header("binary_little_endian", "float").replace(b"uchar red\n", b"float x\n"),
            r": expected a PLY file, got field 'x' occurs more than once",
        ),
        (TEXT + b"7 1 2e9 3 4\n" * 3, r": expected points up to 1e\+09 m away, got"),
    ],
)
def test_damaged_files_are_named(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(DataError, match=f"a.ply{message}") as error:
        read_points(tmp_path / "a.ply")
    assert "\n" not in str(error.value)


def test_lines_without_anything_are_passed_over(tmp_path):
    (tmp_path / "a.ply").write_bytes(TEXT + b"\n7 1 2 3 4\n \n7 5 6 7 8\n\r\n7 9 8 7 6\n3 0 1 2\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply"), [[1, 2, 4], [5, 6, 8], [9, 8, 6]])


@pytest.mark.parametrize("count", [b"4", b"9999999999999"])
def test_coloured_points_that_are_not_all_there(tmp_path, count):
    write_ply(tmp_path / "a.ply", POINTS, np.zeros((3, 3), np.uint8))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"vertex 3", b"vertex " + count))
    with pytest.raises(DataError, match=f"a.ply: expected {count.decode()} vertices, got 3"):
        read_coloured_points(tmp_path / "a.ply")


@pytest.mark.parametrize("axis", "xyz")
def test_coloured_points_without_an_axis_are_named(tmp_path, axis):
    write_ply(tmp_path / "a.ply", POINTS, np.zeros((3, 3), np.uint8))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"float " + axis.encode(), b"float w"))
    with pytest.raises(DataError, match=f"a.ply: expected vertices with x y z, got no {axis}"):
        read_coloured_points(tmp_path / "a.ply")


def test_a_point_without_a_place_stays_nan(tmp_path):
    (tmp_path / "a.ply").write_bytes(TEXT + b"7 1 nan 3 4\n7 1 2 3 4\n7 1 inf 3 4\n")
    points = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.isfinite(points).all(axis=1), [False, True, False])

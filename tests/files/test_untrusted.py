"""Readers of bytes that others wrote: what is whole is read, what is not costs one line and little memory."""

import io
import re
import warnings
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from jaxpose.errors import DataError
from jaxpose.files import schema, untrusted


def npy(array: np.ndarray) -> bytes:
    """The bytes of an array as numpy writes them."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def header(shape: str, kind: str = "<f8") -> bytes:
    """Numpy's header of any array, with no numbers behind it."""
    words = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(words).to_bytes(2, "little") + words


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_archives_of_numpy_are_read(tmp_path, write):
    arrays = {
        "matrix": np.arange(12.0).reshape(3, 4),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
        "big": np.arange(3, dtype=">f4"),
        "scalar": np.asarray(7),
        "text": np.asarray("bspline"),
        "flags": np.array([True, False]),
        "none": np.zeros((0, 4)),
    }
    write(tmp_path / "a.npz", **arrays)
    found = untrusted.read_npz(tmp_path / "a.npz", "arrays")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype and found[name].flags.writeable


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header("1000000000000,"), "got float64 of shape (1000000000000,) in 0 bytes"),
        (header("10,") + bytes(79), "got float64 of shape (10,) in 79 bytes"),
        (header("10,") + bytes(81), "got float64 of shape (10,) in 81 bytes"),
        (header("-1,") + bytes(8), "got an array described as"),
        (header("0, 9999999999999999"), "got an array of shape"),
        (header("", "|O") + bytes(8), "got entries of type |O"),
        (header("", "|V8") + bytes(8), "got entries of type |V8"),
        (header("(" * 500), "got an array described as"),
        (b"\x93NUMPY\x01\x00\xff\xff", "got a header of 65535 bytes"),
        (b"\x93NUMPY\x09\x00\x10\x00", "got no (9, 0)"),
        (b"", "got EOF: reading magic string"),
    ],
)
def test_an_array_is_as_long_as_it_says(tmp_path, content, words):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(DataError, match=rf"a.npy: expected numbers, .*{re.escape(words)}"):
        untrusted.read_npy(tmp_path / "a.npy", "numbers")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", content)
    with pytest.raises(DataError, match=rf"a.npz: expected numbers with an array 'x', .*{re.escape(words)}"):
        untrusted.read_npz(tmp_path / "a.npz", "numbers")


def test_objects_are_never_unpickled(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(DataError, match=r"got entries of type \|O"):
        untrusted.read_npy(tmp_path / "a.npy", "numbers")


def test_an_archive_of_far_more_than_it_holds_is_refused(tmp_path, monkeypatch):
    """Two bounds, of which both have to be passed: an archive may be large, and zeros compress well."""
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(100_000))
    assert len(untrusted.read_npz(tmp_path / "a.npz", "numbers")["x"]) == 100_000
    monkeypatch.setattr(untrusted, "_UNPACKED", 1000)
    with pytest.raises(DataError, match=r"a.npz: expected numbers, got 800128 bytes packed into \d+"):
        untrusted.read_npz(tmp_path / "a.npz", "numbers")
    np.savez(tmp_path / "a.npz", x=np.zeros(100_000))
    assert len(untrusted.read_npz(tmp_path / "a.npz", "numbers")["x"]) == 100_000


def test_damaged_archives(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(100.0))
    whole, file = (tmp_path / "a.npz").read_bytes(), tmp_path / "a.npz"
    flipped = bytearray(whole)
    flipped[200] ^= 1  # within the numbers
    for content, words in (
        (whole[:-40], "not a zip file"),
        (bytes(flipped), "Bad CRC-32"),
        (b"", "not a zip file"),
    ):
        file.write_bytes(content)
        with pytest.raises(DataError, match=rf"a.npz: expected numbers.*, got .*{words}"):
            untrusted.read_npz(file, "numbers")
    for name in ("x.npy", "readme.txt"):
        with zipfile.ZipFile(file, "w") as archive, warnings.catch_warnings(action="ignore"):
            archive.writestr("x.npy", npy(np.zeros(3)))
            archive.writestr(name, npy(np.zeros(3)))
        with pytest.raises(DataError, match=f"'{name}', which is no array or is there twice"):
            untrusted.read_npz(file, "numbers")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("x.npy", npy(np.zeros(3)))
    with pytest.raises(DataError, match="compressed in a way that numpy does not"):
        untrusted.read_npz(file, "numbers")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "a.yaml: expected a sheet, got no mapping but None"),
        ("a: [1, 2", "a.yaml:1: expected a sheet, got expected"),
        ("a: &x [1]\nb: *x\n", "a.yaml: expected a sheet, got an alias"),
        ("[" * 9000, "a.yaml: expected a sheet, got nesting without end"),
        ("a: 1\n" * 30_000, "a.yaml: expected a sheet, got 150000 bytes, more than 100000"),
        ("a: 1\n\tb: 2\n", "a.yaml:2: expected a sheet, got found character"),
    ],
)
def test_yaml_that_is_none(tmp_path, text, words):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(DataError, match=re.escape(words)):
        untrusted.read_yaml(tmp_path / "a.yaml", "a sheet")


def test_yaml_makes_no_objects(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "%YAML:1.0\na: !!python/object/apply:os.getcwd []\nb: !!opencv-matrix\n  data: [1, 2e-3]\n"
    )
    assert untrusted.read_yaml(file, "a sheet") == {"a": [], "b": {"data": [1.0, 0.002]}}


def test_an_image_has_no_more_pixels_than_its_file_can_hold(tmp_path):
    file = tmp_path / "a.png"
    Image.new("RGB", (300, 200), (10, 200, 30)).save(file)
    with untrusted.opened_image(file) as image:
        assert image.size == (300, 200)
    content = bytearray(file.read_bytes())
    content[16:24] = (9000).to_bytes(4, "big") * 2  # width and height, with a checksum of their own
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    file.write_bytes(content)
    with pytest.raises(DataError, match="a.png: expected an image, got 9000x9000 pixels in"):
        with untrusted.opened_image(file):
            pass
    for content in (b"", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"):
        file.write_bytes(content)
        with pytest.raises(DataError, match="a.png: expected an image, got bytes of no kind that is known"):
            with untrusted.opened_image(file):
                pass


def test_hdf5_allots_no_rows_that_it_does_not_hold(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as content:
        content["events/t"] = np.arange(10)
        content.create_dataset("events/x", (10**12,), "u2", chunks=(1000,))
        content["events/y"] = h5py.ExternalLink("b.h5", "y")
        content["events/p"] = np.zeros((2, 5))
    with untrusted.opened_hdf5(tmp_path / "a.h5", "events") as content:
        np.testing.assert_array_equal(untrusted.hdf5_column(content, "events/t")[:], np.arange(10))
        assert [untrusted.hdf5_column(content, f"events/{name}") for name in "ypz"] == [None] * 3
        assert untrusted.hdf5_whole_number(content, "none", 3) == 3
        with pytest.raises(ValueError, match="events/x that is no whole number"):
            untrusted.hdf5_whole_number(content, "events/x", 3)
    with pytest.raises(
        DataError, match="a.h5: expected events, got 1000000000000 numbers of events/x in 0 b"
    ):
        with untrusted.opened_hdf5(tmp_path / "a.h5", "events") as content:
            untrusted.hdf5_column(content, "events/x")


def test_errors_of_the_system_pass(tmp_path):
    with pytest.raises(FileNotFoundError):
        untrusted.read_npz(tmp_path / "none.npz", "numbers")
    with pytest.raises(DataError, match="a: expected numbers, got MemoryError"):
        with untrusted.reading("a", "numbers"):
            raise MemoryError


# --- schema ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "options", "words"),
    [
        (None, {}, "expected a finite number, got None"),
        ("3", {}, "expected a finite number, got '3'"),
        (True, {}, "expected a finite number, got True"),
        ([1.0], {}, "expected a finite number, got [1.0]"),
        (float("nan"), {}, "expected a finite number, got nan"),
        (10**400, {}, "expected a finite number, got 1000000"),
        (0, {"above": 0}, "expected a finite number above 0, got 0"),
        (-1, {"least": 0}, "expected a finite number of at least 0, got -1"),
        (9, {"least": 0, "most": 5}, "expected a finite number from 0 to 5, got 9"),
        (1.5, {"whole": True}, "expected a whole number, got 1.5"),
        (2**60, {"whole": True}, "expected a whole number, got 1.15292e+18"),
        ([[1, 2], [3]], {"shape": (2, 2)}, "expected 2x2 finite numbers, got [[1, 2], [3]]"),
        ([1, True], {"shape": (None,)}, "expected n finite numbers, got [1, True]"),
        (np.zeros(3, complex), {"shape": (3,)}, "expected 3 finite numbers, got complex128"),
        (np.zeros((3, 2)), {"shape": (3, 3)}, "expected 3x3 finite numbers, got shape (3, 2)"),
    ],
)
def test_numbers_out_of_range_are_named(value, options, words):
    with pytest.raises(DataError, match=re.escape(f"a.json: key: {words}")):
        schema.numbers("a.json", {"key": value}, "key", **options)


def test_numbers_in_range_are_given_back():
    content = {"a": [[1, 2.5], [3, 4]], "b": np.array([3], ">i2"), "c": 4.0}
    np.testing.assert_array_equal(schema.numbers("f", content, "a", (2, None)), [[1, 2.5], [3, 4]])
    found = schema.numbers("f", content, "b", (None,), whole=True, least=3, most=3)
    assert found.dtype == np.int64 and found.tolist() == [3]
    assert schema.numbers("f", content, "c", whole=True).item() == 4
    with pytest.raises(DataError, match="f: d: expected a finite number, got no such entry"):
        schema.numbers("f", content, "d")


def test_poses_are_rigid_and_not_too_far():
    T = np.tile(np.eye(4), (3, 1, 1))
    schema.rigid_transforms("f", "poses", T)
    for index, value, words in (
        ((1, 0, 0), 1.01, "rigid transforms, got .* in row 1"),
        ((2, 2, 2), -1.0, "rigid transforms, got .* in row 2"),
        ((1, 3, 0), 0.1, "rigid transforms, got .* in row 1"),
        ((1, 0, 0), 1e200, "rigid transforms, got .* in row 1"),
        ((1, 0, 3), 2e9, "positions up to 1e[+]09 m, got .* in row 1"),
    ):
        wrong = T.copy()
        wrong[index] = value
        with pytest.raises(DataError, match=f"f: poses: expected {words}"):
            schema.rigid_transforms("f", "poses", wrong)
    with pytest.raises(DataError, match="f: t: expected a time after 2.0, got 2.0"):
        schema.increasing("f", "t", np.array([1.0, 2.0, 2.0]))


@pytest.mark.parametrize("name", ["", "..", "a/../../b", "/etc/passwd", "..\\b", "a\0b"])
def test_names_stay_in_their_folder(name):
    with pytest.raises(DataError, match="f: expected a file name that stays in its folder, got"):
        schema.name_inside("f", name)
    assert schema.name_inside("f", "images/a..b.png") == "images/a..b.png"
    assert schema.name_inside("f", f"images/{'a' * 251}.png")
    with pytest.raises(DataError, match="f: expected file names of up to 255 bytes, got 260"):
        schema.name_inside("f", f"images/{'ä' * 128}.png")


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12.0).reshape(3, 4),
        np.asfortranarray(np.arange(12, dtype=">i4").reshape(3, 4)),
        np.array(4.5, np.float32),
        np.array([True, False]),
        np.array(["a", "bc"]),
        np.zeros((0, 3)),
        np.arange(200_000),  # longer than what is read at a time
    ],
    ids=lambda array: f"{array.dtype} {array.shape}",
)
def test_arrays_are_what_numpy_reads(tmp_path, array):
    np.savez_compressed(tmp_path / "a.npz", a=array)
    np.save(tmp_path / "a.npy", array)
    for found in (
        untrusted.read_npz(tmp_path / "a.npz", "arrays")["a"],
        untrusted.read_npy(tmp_path / "a.npy", "an array"),
    ):
        assert (found.dtype, found.shape, found.flags.writeable) == (array.dtype, array.shape, True)
        np.testing.assert_array_equal(found, array)

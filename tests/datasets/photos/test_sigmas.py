"""Tables of how sure poses are: as users write them, and refused by their line."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxpose.datasets.photos.sigmas import read_sigmas, write_sigmas
from jaxpose.errors import DataError

FILES = ("train/a b.png", "train/c.png", "train/d.png")


@pytest.mark.parametrize(
    "text",
    [
        "image,position,rotation_deg\ntrain/a b.png,0.1,2\nc.png, 0.2, 3\n*,0.5,180\n",
        "*, 0.5, 180\n# from the drone's log\ntrain\\a b,0.1,2\n\n./train/c,2e-1,3\n",
        "name position rotation\ntrain/a b.png 0.1 2\ntrain/c.png 0.2 3\n* 0.5 180",
        "train/a b.png,0.1,2\nc.png,0.2,3\nd.png,0.5,180\n",
    ],
)
def test_a_line_an_image_and_one_for_all_others(tmp_path, text):
    (tmp_path / "sigmas.csv").write_text(text)
    found, notes = read_sigmas(tmp_path / "sigmas.csv", FILES)
    assert_allclose(found, [[0.1, np.radians(2)], [0.2, np.radians(3)], [0.5, np.pi]])
    assert notes == ()


def test_what_is_written_is_read_again(tmp_path):
    sigmas = np.array([[0.125, 0.25], [np.nan, np.nan], [3.0, 0.001]])
    write_sigmas(tmp_path / "sigmas.csv", FILES, sigmas)
    assert (tmp_path / "sigmas.csv").read_text().splitlines()[1] == "train/a b.png,0.125,14.3239"
    found, notes = read_sigmas(tmp_path / "sigmas.csv", FILES[::2])
    assert_allclose(found, sigmas[::2], rtol=1e-5)
    with pytest.raises(
        DataError, match=r"sigmas.csv: expected a line of every image, .* none of train/c.png"
    ):
        read_sigmas(tmp_path / "sigmas.csv", FILES)


def test_lines_of_other_images_are_named(tmp_path):
    (tmp_path / "s.csv").write_text("*,1,1\nheld_out/x.png,1,1\n")
    _, notes = read_sigmas(tmp_path / "s.csv", FILES)
    assert notes == ("s.csv: lines of no image that is trained on: held_out/x",)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("*,1\n", r"s.csv:1: expected an image, the sigma of its position .* got '\*,1'"),
        ("a,1,2\nb,1,x\n", r"s.csv:2: expected an image, .* got 'b,1,x'"),
        ("*,0,1\n", r"s.csv:1: expected sigmas above 0, .* got 0 and 1"),
        ("*,1,nan\n", r"s.csv:1: expected sigmas above 0, .* got 1 and nan"),
        ("*,1,200\n", r"s.csv:1: expected .* at most 1e\+\d+ and 180 degrees, got 1 and 200"),
        ("*,1,1\n*,1,2\n", r"s.csv:2: expected one line of each image, got another of \*"),
        ("a b.png,1,1\na b.jpg,1,1\n*,1,1\n", r"s.csv:2: expected one line of each image"),
        ("image,position,rotation\n", r"s.csv: expected a line of every image, or one of \*"),
        ("", r"s.csv: expected a line of every image, or one of \*"),
    ],
)
def test_bad_lines_are_named(tmp_path, text, expected):
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(DataError, match=expected):
        read_sigmas(tmp_path / "s.csv", FILES)


def test_a_name_of_two_images(tmp_path):
    (tmp_path / "s.csv").write_text("0.png,1,1\n")
    with pytest.raises(DataError, match="expected names of one image each, got 0, which is of two"):
        read_sigmas(tmp_path / "s.csv", ("left/0.png", "right/0.png"))

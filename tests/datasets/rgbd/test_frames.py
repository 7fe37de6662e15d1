"""Partners are found by listing, whatever system wrote the names."""

import pytest

from jaxpose.datasets.rgbd.frames import Listing, listed, numbered, visible
from jaxpose.errors import DataError


@pytest.fixture
def folder(tmp_path):
    for name in ("rgb/1.PNG", "rgb/._1.PNG", "rgb/two.jpg", "Depth/000017.png", "Depth/.DS_Store"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "rgb/linked.png").symlink_to(tmp_path / "rgb/1.PNG")
    return tmp_path


@pytest.mark.parametrize(
    "name, file",
    [
        ("rgb/1.PNG", "rgb/1.PNG"),
        ("./rgb/1.png", "rgb/1.PNG"),
        ("rgb\\1.png", "rgb/1.PNG"),
        (".\\RGB\\TWO.JPG", "rgb/two.jpg"),
        ("rgb/two", "rgb/two.jpg"),
        ("depth/000017.png", "Depth/000017.png"),
        ("rgb/linked.png", "rgb/linked.png"),
        ("rgb/3.png", None),
        ("nowhere/1.png", None),
        ("rgb", None),
        ("", None),
    ],
)
def test_a_name_of_another_system_is_found(folder, name, file):
    found = Listing(folder).find(name)
    assert found == (None if file is None else folder / file)


def test_hidden_files_are_no_images(folder):
    assert [file.name for file in visible(folder / "rgb")] == ["1.PNG", "linked.png", "two.jpg"]
    assert numbered(folder / "rgb") == {1: folder / "rgb/1.PNG"}
    assert numbered(folder / "Depth") == {17: folder / "Depth/000017.png"}
    assert numbered(folder / "nowhere") == {}


def test_a_list_in_part_is_used_and_counted(folder):
    rows, files, notes = listed(folder / "rgb.txt", folder, ["rgb/0.png", "rgb/1.png", "rgb/two.jpg"])
    assert rows == [1, 2] and [file.name for file in files] == ["1.PNG", "two.jpg"]
    assert notes == ("1 of 3 files that rgb.txt lists are not there: rgb/0.png",)
    with pytest.raises(
        DataError, match="rgb.txt: expected the files that it lists, got none of 1: rgb/0.png"
    ):
        listed(folder / "rgb.txt", folder, ["rgb/0.png"])

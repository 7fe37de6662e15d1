"""Text of other systems and programs: marks, quotes, archives."""

import bz2
import gzip
import zipfile

import numpy as np
import pytest

from jaxpose.errors import DataError
from jaxpose.files.trajectories import read_trajectory

ROWS = [f"{1305031100 + k / 30:.6f} {k / 10} 0.5 0.25 0 0 0 1" for k in range(30)]


@pytest.mark.parametrize(
    "content",
    [
        "\n".join(ROWS).encode("utf-16"),  # of Windows' shell, with its mark
        b"\xef\xbb\xbf" + "\r\n".join(ROWS).encode() + b"\r\n",
        "\r".join(ROWS).encode(),
        "\n".join(row.replace(" ", "\t") + "  " for row in ROWS).encode(),
        ('"t","tx","ty","tz","qx","qy","qz","qw"\n' + "\n".join(
            ",".join(f'"{word}"' for word in row.split()) for row in ROWS
        )).encode(),
        ("sec,nanosec,tx,ty,tz,qx,qy,qz,qw\n" + "\n".join(
            row.replace(".", ",", 1).replace(" ", "000,", 1).replace(" ", ",") for row in ROWS
        )).encode(),
    ],
)  # fmt: skip
def test_poses_are_read_as_they_were_written(tmp_path, content):
    (tmp_path / "plain.txt").write_text("\n".join(ROWS))
    (tmp_path / "other.csv").write_bytes(content)
    plain, other = (read_trajectory(tmp_path / name).trajectory for name in ("plain.txt", "other.csv"))
    assert plain.t0_ns == other.t0_ns
    np.testing.assert_array_equal(plain.t, other.t)
    np.testing.assert_array_equal(plain.T, other.T)


@pytest.mark.parametrize("kind", ["gzip", "bzip2", "zip"])
def test_archives_are_named(tmp_path, kind):
    file = tmp_path / "poses.txt"
    if kind == "zip":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("poses.txt", "\n".join(ROWS))
    else:
        pack = gzip if kind == "gzip" else bz2
        file.write_bytes(pack.compress("\n".join(ROWS).encode()))
    with pytest.raises(DataError, match=f"poses.txt: expected text, got a {kind} archive to be"):
        read_trajectory(file)

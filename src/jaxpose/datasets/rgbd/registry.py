"""Any recording: which of the layouts a folder has, by its files, and its loader."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from jaxpose.datasets.images import found
from jaxpose.datasets.rgbd import euroc, icl_nuim, plain, replica, scannet, sevenscenes, tum
from jaxpose.datasets.types import Recording
from jaxpose.errors import DataError

Format = Literal["sevenscenes", "tum", "replica", "scannet", "euroc", "icl_nuim", "plain"]


class _Layout(NamedTuple):
    """What a layout looks like in words, whether a folder has it, and its loader."""

    files: str
    detect: Callable[[Path], bool]
    load: Callable[[Path | str, float], Recording]


# In the order in which they are tried: the plain folder has least of its own, so it is last.
_LAYOUTS: dict[Format, _Layout] = {
    "sevenscenes": _Layout(
        "frame-NNNNNN.color.png and frame-NNNNNN.depth.png",
        sevenscenes.detect,
        lambda path, rate_hz: sevenscenes.load(path, rate_hz=rate_hz),
    ),
    "tum": _Layout("rgb.txt and depth.txt", tum.detect, lambda path, rate_hz: tum.load(path)),
    "replica": _Layout(
        "results/ and traj.txt", replica.detect, lambda path, rate_hz: replica.load(path, rate_hz=rate_hz)
    ),
    "scannet": _Layout(
        "color/, depth/ and pose/", scannet.detect, lambda path, rate_hz: scannet.load(path, rate_hz=rate_hz)
    ),
    "euroc": _Layout("mav0/cam0 and mav0/imu0", euroc.detect, lambda path, rate_hz: euroc.load(path)),
    "icl_nuim": _Layout(
        "associations.txt, depth/ and rgb/",
        icl_nuim.detect,
        lambda path, rate_hz: icl_nuim.load(path, rate_hz=rate_hz),
    ),
    "plain": _Layout(
        "color/, depth/ and intrinsics",
        plain.detect,
        lambda path, rate_hz: plain.load(path, rate_hz=rate_hz),
    ),
}


def find_format(path: Path | str) -> Format:
    """The layout of a folder, by its files.

    Args:
        path: The folder.

    Returns:
        The name of the layout.

    Raises:
        DataError: Saying what was expected and what is there.
    """
    path = Path(path)
    if path.is_dir():
        for name in get_args(Format):
            if _LAYOUTS[name].detect(path):
                return name
    expected = ", or ".join(f"{layout.files} ({name})" for name, layout in _LAYOUTS.items())
    raise DataError(f"{path}: expected a folder of {expected}, got {found(path)}")


def has_timestamps(path: Path | str, format: Format) -> bool:
    """Whether the frames of a recording have timestamps, or a rate has to be assumed.

    Args:
        path: its folder.
        format: its layout.

    Returns:
        True where the files state when each frame was taken.
    """
    if format != "plain":
        return format in ("tum", "euroc")
    folder = Path(path)
    if (folder / "times.txt").is_file() or not (folder / "poses.txt").is_file():
        return (folder / "times.txt").is_file()
    lines = (line for line in (folder / "poses.txt").read_text("utf-8").splitlines() if line.strip())
    return next((len(line.split()) == 8 for line in lines if not line.startswith("#")), False)


def load_recording(path: Path | str, format: Format | None = None, *, rate_hz: float = 30.0) -> Recording:
    """Read an RGB-D recording in any of the layouts.

    Args:
        path: The folder.
        format: The layout; by default the one that `find_format` finds.
        rate_hz: Frames a second where a layout has no timestamps.

    Returns:
        The recording; images are read when asked for.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    return _LAYOUTS[format or find_format(path)].load(path, rate_hz)

"""Any recording: which of the formats a path has, by its content, and its loader."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Literal, NamedTuple, get_args

from jaxpose.datasets.images import INTRINSICS, found, some
from jaxpose.datasets.rgbd import (
    arkitscenes,
    azure_kinect,
    euroc,
    icl_nuim,
    nerfstudio,
    plain,
    plain_files,
    polycam,
    record3d,
    replica,
    ros,
    scannet,
    sevenscenes,
    stray_scanner,
    sun3d,
    tum,
)
from jaxpose.datasets.types import Recording
from jaxpose.datasets.video import SUFFIXES
from jaxpose.errors import DataError

Format = Literal[
    "ros",
    "azure_kinect",
    "record3d",
    "stray_scanner",
    "arkitscenes",
    "polycam",
    "nerfstudio",
    "sevenscenes",
    "tum",
    "replica",
    "scannet",
    "euroc",
    "icl_nuim",
    "sun3d",
    "plain",
]
_MOST_FOLDERS = 200  # looked into for recordings, where a path is none itself


class Layout(NamedTuple):
    """A format: what it is called, what files it has, and its loader."""

    title: str
    files: tuple[str, ...]  # patterns of what it has to have, alternatives with |
    module: ModuleType  # with `detect` and `load`
    settings: tuple[str, ...]  # that `load` takes: without rate_hz the frames have timestamps
    tested: str  # what its test reads


_RATE = ("rate_hz",)
# In the order in which they are tried: the plain folder has least of its own, so it is last.
LAYOUTS: dict[Format, Layout] = {
    "ros": Layout(
        "ROS 1 and ROS 2 bags (extra `ros`)",
        ("*.bag|*.mcap|*.db3|metadata.yaml",),
        ros,
        ("topics",),
        "bags that rosbags writes",
    ),
    "azure_kinect": Layout(
        "Azure Kinect (extra `video`)",
        ("*.mkv",),
        azure_kinect,
        (),
        "a made file in k4arecorder's layout",
    ),
    "record3d": Layout(
        "Record3D: r3d, EXR + JPG, RGBD video (extra `phone`)",
        ("*.r3d|metadata|metadata.json", "*.r3d|rgbd/*.jpg|rgb/*.jpg", "*.r3d|rgbd/*.depth|depth/*.exr"),
        record3d,
        (),
        "files in the app's layouts, by lzfse, OpenEXR and PyAV",
    ),
    "stray_scanner": Layout(
        "Stray Scanner (extra `video`)",
        ("rgb.mp4", "depth/*.png", "odometry.csv", "camera_matrix.csv"),
        stray_scanner,
        (),
        "a folder in the app's layout, by PyAV",
    ),
    "arkitscenes": Layout(
        "ARKitScenes",
        tuple(f"lowres_{name}|*_frames/lowres_{name}" for name in ("wide", "depth", "wide_intrinsics")),
        arkitscenes,
        (),
        "a made folder",
    ),
    "polycam": Layout(
        "Polycam, raw data",
        tuple(f"keyframes/{name}" for name in ("images", "depth", "cameras")),
        polycam,
        _RATE,
        "a made folder",
    ),
    "nerfstudio": Layout(
        "nerfstudio with depth", ("transforms.json",), nerfstudio, _RATE, "a made folder"
    ),
    "sevenscenes": Layout(
        "7-Scenes, BundleFusion",
        ("frame-*.color.png|frame-*.color.jpg", "frame-*.depth.png"),
        sevenscenes,
        _RATE,
        "made folders, RedKitchen",
    ),
    "tum": Layout(
        "TUM RGB-D, Bonn, ETH3D SLAM", ("rgb.txt", "depth.txt"), tum, (), "made folders, fr1/rpy"
    ),
    "replica": Layout(
        "Replica (NICE-SLAM's)", ("results/frame*", "results/depth*"), replica, _RATE, "a made folder"
    ),
    "scannet": Layout(
        "ScanNet",
        ("color|frames/color", "depth|frames/depth", "pose|frames/pose"),
        scannet,
        _RATE,
        "a made folder",
    ),
    "euroc": Layout(
        "EuRoC with depth or a scan",
        ("mav0/cam0|cam0", "mav0/imu0|imu0", "mav0/depth0|depth0|mav0/pointcloud0|data.ply"),
        euroc,
        (),
        "a made folder, V1_01",
    ),
    "icl_nuim": Layout(
        "ICL-NUIM", ("associations.txt", "rgb/*", "depth/*"), icl_nuim, _RATE, "a made folder, kt3"
    ),
    "sun3d": Layout(
        "SUN3D, Redwood's scans", ("image/*-*.jpg|rgb/*-*.jpg", "depth/*-*.png"), sun3d, (), "a made folder"
    ),
    "plain": Layout(
        "a plain folder; Open3D, RealSense and Redwood captures",
        ("color|rgb|image|images", "depth", "|".join((INTRINSICS, *plain_files.JSON))),
        plain,
        _RATE,
        "made folders",
    ),
}  # fmt: skip


def find_format(path: Path | str) -> Format:
    """The format of a recording, by its content.

    Args:
        path: Its folder or file.

    Returns:
        The name of the format.

    Raises:
        DataError: Naming the formats, and what is there, as `nearest` says.
    """
    if (name := detect(path)) is not None:
        return name
    titles = ", ".join(layout.title for layout in LAYOUTS.values())
    raise DataError(f"{path}: expected a recording ({titles}), got {nearest(path)}")


def detect(path: Path | str) -> Format | None:
    """The format of a recording, by its content.

    Args:
        path: A folder or file.

    Returns:
        The name of the format; None for what is no recording.
    """
    path = Path(path)
    if path.is_dir() or path.is_file():
        for name in get_args(Format):
            if LAYOUTS[name].module.detect(path):
                return name
    return None


def nearest(path: Path | str) -> str:
    """What is at a path that is no recording, for a message of one line.

    Args:
        path: A folder or file, or nothing.

    Returns:
        What is there; the recordings in it, or else the nearest format and what it lacks.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return "a video without depth, of which `nerf` takes photographs"
    if not path.is_dir():
        return found(path)
    if inner := _recordings_in(path):
        return f"a folder of recordings, name one: {some(inner)}"
    ranked = []
    for layout_name, layout in LAYOUTS.items():
        there = [_match(path, part) for part in layout.files]
        ranked.append((sum(there) / len(there), sum(there), layout_name, there))
    share, _, name, there = max(ranked, key=lambda row: row[:2])
    if not share:
        return found(path)
    layout = LAYOUTS[name]
    lacking = [words(part) for part, is_there in zip(layout.files, there, strict=True) if not is_there]
    without = f", without {' and '.join(lacking)}" if lacking else ""
    return f"{found(path)}: the nearest is {layout.title} ({name}){without}"


def has_timestamps(path: Path | str, format: Format) -> bool:
    """Whether the frames of a recording have timestamps, or a rate has to be assumed.

    Args:
        path: its folder.
        format: its format.

    Returns:
        True where the files state when each frame was taken.
    """
    layout = LAYOUTS[format]
    if hasattr(layout.module, "has_timestamps"):
        return layout.module.has_timestamps(Path(path))
    return "rate_hz" not in layout.settings


def load_recording(
    path: Path | str, format: Format | None = None, *, rate_hz: float = 30.0, topics: Sequence[str] = ()
) -> Recording:
    """Read an RGB-D recording in any of the formats.

    Args:
        path: The folder or file.
        format: The format; by default the one that `find_format` finds.
        rate_hz: Frames a second where a format has no timestamps.
        topics: Of a ROS bag, those to use before others of their kind.

    Returns:
        The recording; images are read when asked for.

    Raises:
        DataError: Naming the file for anything that cannot be used.
        ValueError: For a rate that is not positive.
    """
    format = format or find_format(path)
    layout = LAYOUTS[format]
    if topics and "topics" not in layout.settings:
        raise DataError(f"{path}: expected a ROS bag to choose topics of, got {layout.title}")
    given = {"rate_hz": rate_hz, "topics": topics}
    return layout.module.load(path, **{name: given[name] for name in layout.settings})


def words(part: str) -> str:
    """A pattern of `Layout.files` in words."""
    return part.replace("|", " or ")


def _match(path: Path, part: str) -> bool:
    return any(next(iter(path.glob(pattern)), None) is not None for pattern in part.split("|"))


def _recordings_in(path: Path) -> list[str]:
    """Names and formats of the recordings in a folder."""
    inner = [folder for folder in sorted(path.iterdir()) if not folder.name.startswith(".")]
    formats = [(folder.name, detect(folder)) for folder in inner[:_MOST_FOLDERS]]
    return [f"{name} ({form})" for name, form in formats if form is not None]

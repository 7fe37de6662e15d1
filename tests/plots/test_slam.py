"""Pictures: whole PNG files of the size asked for, for ordinary and for degenerate runs."""

import numpy as np
import pytest
from PIL import Image

from jaxpose.plots import slam as slam_plots

N = 30


def read(path):
    """The picture's pixels; fails unless it is a PNG with something on it."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        pixels = np.asarray(image.convert("RGB"))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20
    return pixels


def circle(radius=1.0):
    """Cameras on a horizontal circle in a z-up world, upright."""
    angle = np.linspace(0, 5, N)
    T_world_cam = np.tile(np.eye(4), (N, 1, 1))
    T_world_cam[:, :3, :3] = np.array(
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    )  # y of the camera is -z of the world
    T_world_cam[:, :3, 3] = np.stack(
        [2 * radius * np.cos(angle), radius * np.sin(angle), 0 * angle + 1.2], -1
    )
    return T_world_cam


def lost_frames(*which):
    lost = np.zeros(N, bool)
    lost[list(which)] = True
    return lost


@pytest.mark.parametrize("case", ["gaps and lost", "no ground truth", "at rest"])
def test_trajectory(tmp_path, case):
    ground_truth = circle()
    estimate = ground_truth.copy()
    if case == "at rest":
        estimate[:] = ground_truth[:] = ground_truth[0]
    else:
        estimate[:, :3, 3] += 0.02 * np.random.default_rng(0).normal(size=(N, 3))
    if case == "gaps and lost":
        ground_truth[[0, 7, 8]] = np.nan
    path = tmp_path / "trajectory.png"
    lost = lost_frames(3, 4) if case == "gaps and lost" else lost_frames()
    slam_plots.trajectory(
        path, estimate, None if case == "no ground truth" else ground_truth, lost, "a title"
    )
    assert read(path).shape == (round(5.2 * slam_plots.DPI), 11 * slam_plots.DPI, 3)
    assert [file.name for file in tmp_path.iterdir()] == ["trajectory.png"]  # no temporary file stays


def test_trajectory_is_seen_along_the_vertical_axis_of_the_world():
    assert slam_plots._view_axes(circle()) == (0, 1, 2, 1)
    kinect = np.tile(np.eye(4), (N, 1, 1))  # a world in the axes of its first camera: up is -y
    kinect[:, 2, 3] = np.linspace(0, 3, N)
    kinect[:, 0, 3] = np.linspace(0, 1, N)
    assert slam_plots._view_axes(kinect) == (2, 0, 1, -1)


@pytest.mark.parametrize("lost", [(), (0, 5, 29)])
def test_errors(tmp_path, lost):
    t = np.linspace(0, 6, N)
    translation = 0.01 + 0.01 * np.sin(t)
    translation[4] = np.nan  # a frame without ground truth
    slam_plots.errors(
        tmp_path / "errors.png", t, translation, 10 * translation, lost_frames(*lost), "a title"
    )
    picture = read(tmp_path / "errors.png")
    assert picture.shape == (5 * slam_plots.DPI, 10 * slam_plots.DPI, 3)
    red = (picture[..., 0].astype(int) - picture[..., 1] > 50).sum()
    assert (red > 1000) == bool(lost)


@pytest.mark.parametrize("count", [1, 3])
def test_renders(tmp_path, count):
    generator = np.random.default_rng(1)
    depth = generator.uniform(1, 3, (12, 16))
    depth[:3] = 0
    view = slam_plots.View(
        "t = 0 s",
        generator.integers(0, 255, (48, 64, 3), np.uint8),
        generator.uniform(0, 1, (12, 16, 3)),
        depth,
        depth + 0.02,
    )
    nothing = view._replace(depth=0 * depth, rendered_depth=0 * depth)
    slam_plots.renders(tmp_path / "renders.png", [view, nothing, view][:count], "a title")
    height, width, _ = read(tmp_path / "renders.png").shape
    assert width == 11 * slam_plots.DPI
    assert height > 120 * count


def test_inertial(tmp_path):
    t = np.linspace(0, 3, 600)
    read_values = np.stack([np.sin(t), np.cos(t), 0 * t], -1)
    slam_plots.inertial(
        tmp_path / "inertial.png", t, (read_values, 0.9 * read_values), (read_values, 40 * read_values), "a"
    )
    assert read(tmp_path / "inertial.png").shape == (6 * slam_plots.DPI, 11 * slam_plots.DPI, 3)


def test_comparison(tmp_path):
    t = np.linspace(0, 3, N)
    errors = {"none": np.exp(t), "tight": np.full(N, 0.01), "combined": np.full(N, 0.008)}
    slam_plots.comparison(tmp_path / "comparison.png", t, errors, "a title")
    assert read(tmp_path / "comparison.png").shape == (round(4.2 * slam_plots.DPI), 11 * slam_plots.DPI, 3)

"""Pictures of a run: whole PNG files, for ordinary and for degenerate runs, that show what was handed in."""

import numpy as np
import pytest
from matplotlib.colors import same_color
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from jaxpose.plots import slam as slam_plots
from jaxpose.plots import style

N = 30


def size(path):
    """Height and width of the picture, which is a PNG and alone in its folder."""
    with Image.open(path) as image:
        image.load()
        assert image.format == "PNG"
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no temporary file stays
    return image.height, image.width


def circle(radius=1.0):
    """Cameras on a horizontal circle in a z-up world, upright."""
    angle = np.linspace(0, 5, N)
    T_world_cam = np.tile(np.eye(4), (N, 1, 1))
    # y of the camera is -z of the world
    T_world_cam[:, :3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    T_world_cam[:, :3, 3] = np.stack(
        [2 * radius * np.cos(angle), radius * np.sin(angle), 0 * angle + 1.2], -1
    )
    return T_world_cam


def lost_frames(*which):
    lost = np.zeros(N, bool)
    lost[list(which)] = True
    return lost


def line(axes, label):
    (found,) = [each for each in axes.lines if each.get_label() == label]
    return found


@pytest.mark.parametrize("case", ["gaps and lost", "no ground truth", "at rest"])
def test_trajectory(tmp_path, figures, case):
    ground_truth = circle()
    estimate = ground_truth.copy()
    if case == "at rest":
        estimate[:] = ground_truth[:] = ground_truth[0]
    else:
        estimate[:, :3, 3] += 0.02 * np.random.default_rng(0).normal(size=(N, 3))
    if case == "gaps and lost":
        ground_truth[[0, 7, 8]] = np.nan
    lost = lost_frames(3, 4) if case == "gaps and lost" else lost_frames()
    path = tmp_path / "trajectory.png"
    slam_plots.trajectory(
        path, estimate, None if case == "no ground truth" else ground_truth, lost, "a title"
    )
    assert size(path) == (round(5.2 * style.DPI), 11 * style.DPI)
    (figure,) = figures
    above, side = figure.axes[:2]
    assert len(figure.axes) == (2 if case == "no ground truth" else 3)  # the third is the scale of distances
    for axes, vertical in ((above, 1), (side, 2)):  # x across, y or z along
        thick = [each for each in axes.lines if same_color(each.get_color(), style.GROUND_TRUTH)]
        if case == "no ground truth":
            (path_line,) = [each for each in axes.lines if same_color(each.get_color(), style.ESTIMATE)]
            assert_allclose(path_line.get_xydata(), estimate[:, [0, vertical], 3])
            assert not thick and not axes.collections
        else:
            kept = np.isfinite(ground_truth[:, 0, 0])
            assert_allclose(thick[0].get_xydata(), ground_truth[kept][:, [0, vertical], 3])
            (shaded,) = axes.collections
            starts = np.array([segment[0] for segment in shaded.get_segments()])
            assert_allclose(starts, estimate[:-1, [0, vertical], 3])
            off = 100 * np.linalg.norm((estimate - ground_truth)[:, :3, 3], axis=1)
            assert_allclose(np.ma.filled(shaded.get_array(), np.nan), (off[:-1] + off[1:]) / 2)
        (crosses,) = [each for each in axes.lines if each.get_marker() == "x"]
        assert_allclose(crosses.get_xydata(), estimate[lost][:, [0, vertical], 3])
    labels = {text.get_text() for text in above.get_legend().get_texts()}
    assert ("lost" in labels) == lost.any()


@pytest.mark.parametrize("times", [1, 100])
def test_ellipses_hold_most_of_the_places_that_poses_may_have(tmp_path, figures, times):
    """x of the camera is the world's, y is down, z is the world's y."""
    covariance = np.tile(np.diag(np.square([0.01, 0.02, 0.03, 1, 1, 1]) / times**2), (N, 1, 1))
    estimate = circle()
    slam_plots.trajectory(tmp_path / "trajectory.png", estimate, None, lost_frames(), "a title", covariance)
    (figure,) = figures
    for axes, sigmas, vertical in zip(figure.axes, ([0.01, 0.03], [0.01, 0.02]), (1, 2), strict=True):
        (rings,) = axes.collections
        ring = np.array(rings.get_segments())
        middle = (ring.max(axis=1) + ring.min(axis=1)) / 2
        assert_allclose(middle[[0, -1]], estimate[[0, -1]][:, [0, vertical], 3], atol=1e-3)
        random = np.random.default_rng(0).normal(size=(20_000, 2)) * sigmas
        half = (ring[0].max(axis=0) - ring[0].min(axis=0)) / 2
        assert np.mean(np.sum((random / half) ** 2, axis=1) < 1) == pytest.approx(0.9, abs=0.01)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert ("90% ellipse" if times == 1 else "90% ellipse, 100 times as large") in labels


def test_trajectory_is_seen_along_the_vertical_axis_of_the_world():
    assert style.view_axes(circle()) == (0, 1, 2, 1)
    kinect = np.tile(np.eye(4), (N, 1, 1))  # a world in the axes of its first camera: up is -y
    kinect[:, 2, 3] = np.linspace(0, 3, N)
    kinect[:, 0, 3] = np.linspace(0, 1, N)
    assert style.view_axes(kinect) == (2, 0, 1, -1)


@pytest.mark.parametrize("lost", [(), (0, 5, 29)])
def test_errors(tmp_path, figures, lost):
    t = np.linspace(0, 6, N)
    translation = 0.01 + 0.01 * np.sin(t)
    translation[4] = np.nan  # a frame without ground truth
    slam_plots.errors(
        tmp_path / "errors.png", t, translation, 10 * translation, lost_frames(*lost), "a title"
    )
    assert size(tmp_path / "errors.png") == (5 * style.DPI, 10 * style.DPI)
    (figure,) = figures
    for axes, values, unit in zip(
        figure.axes, (100 * translation, 10 * translation), ("cm", "deg"), strict=True
    ):
        assert_allclose(axes.lines[0].get_xydata(), np.stack([t, values], -1))
        rmse = np.sqrt(np.mean(np.delete(values, 4) ** 2))
        assert_allclose(line(axes, f"RMSE {rmse:.2f} {unit}").get_ydata(), rmse)
        stripes = [each for each in axes.lines if same_color(each.get_color(), style.LOST)]
        assert [each.get_xdata()[0] for each in stripes] == [t[k] for k in lost]


def test_errors_are_seen_beside_what_was_stated(tmp_path, figures):
    t, off = np.linspace(0, 6, N), np.full(N, 0.01)
    covariance = np.linspace(1, 2, N)[:, None, None] * np.diag(np.square([0.01] * 3 + [0.2] * 3))
    slam_plots.errors(tmp_path / "errors.png", t, off, 100 * off, lost_frames(), "a title", covariance)
    (figure,) = figures
    for axes, sigma, most in zip(figure.axes, (100 * 0.01, np.degrees(0.2)), (2.6, 3.2), strict=True):
        (band,) = axes.collections
        assert band.get_label() == "one sigma, as stated"
        top = band.get_paths()[0].vertices
        assert top[:, 1].max() == pytest.approx(sigma * np.sqrt(3 * 2), rel=1e-6)
        assert axes.get_ylim()[1] < most  # errors stay visible


@pytest.mark.parametrize("count", [1, 3])
def test_renders(tmp_path, figures, count):
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
    views = [view, nothing, view][:count]
    slam_plots.renders(tmp_path / "renders.png", views, "a title")
    height, width = size(tmp_path / "renders.png")
    assert width == 11 * style.DPI and height > 120 * count
    (figure,) = figures
    cells = [axes for axes in figure.axes if axes.images][: 5 * count]
    for k, each in enumerate(views):
        row = cells[5 * k : 5 * k + 5]
        rgb, rendered, measured, drawn, error = (
            np.ma.filled(axes.images[0].get_array(), np.nan) for axes in row
        )
        assert_array_equal(rgb, each.rgb)
        assert_array_equal(rendered, each.rendered_rgb)
        assert_array_equal(measured, np.where(each.depth > 0, each.depth, np.nan))
        assert_array_equal(drawn, np.where(each.rendered_depth > 0, each.rendered_depth, np.nan))
        assert_allclose(error, np.where(each.depth > 0, 2.0, np.nan))
        median = "unknown" if each is nothing else "2.0 cm"
        assert [text.get_text() for text in row[4].texts] == [f"median |error| {median}"]


def test_inertial(tmp_path, figures):
    t = np.linspace(0, 3, 600)
    read = np.stack([np.sin(t), np.cos(t), 0 * t], -1)
    slam_plots.inertial(tmp_path / "inertial.png", t, (read, 0.9 * read), (read, 40 * read), "a")
    assert size(tmp_path / "inertial.png") == (6 * style.DPI, 11 * style.DPI)
    (figure,) = figures
    for column, factor in ((0, 0.9), (1, 40)):
        for k in range(3):
            axes = figure.axes[2 * k + column]
            assert_allclose(line(axes, "IMU").get_ydata(), read[:, k])
            assert_allclose(line(axes, "derivative of the field").get_ydata(), factor * read[:, k])
            assert axes.get_ylim()[1] < 2  # a wild field does not hide what was read
        rms = np.sqrt(np.mean(((1 - factor) * read) ** 2))
        assert f"RMS difference {rms:.3g} " in figure.axes[column].get_title()


def test_comparison(tmp_path, figures):
    t = np.linspace(0, 3, N)
    errors = {"none": np.exp(t), "tight": np.full(N, 0.01), "combined": np.full(N, 0.008)}
    slam_plots.comparison(tmp_path / "comparison.png", t, errors, "a title")
    assert size(tmp_path / "comparison.png") == (round(4.2 * style.DPI), 11 * style.DPI)
    (figure,) = figures
    curves, bars = figure.axes
    for mode, values in errors.items():
        assert_allclose(line(curves, mode).get_ydata(), 100 * values)
    drawn = dict(zip([text.get_text() for text in bars.get_yticklabels()], bars.patches, strict=True))
    rmse = {mode: 100 * np.sqrt(np.mean(values**2)) for mode, values in errors.items()}
    assert {mode: bar.get_width() for mode, bar in drawn.items()} == pytest.approx(rmse)
    assert curves.get_yscale() == "log"  # one mode lost the camera: the others stay readable


def test_freedom(tmp_path, figures):
    before, after = np.full(N, 5), np.repeat([1, 2, 3], N // 3)
    slam_plots.freedom(tmp_path / "freedom.png", np.linspace(0, 3, N), before, after, "a title")
    assert size(tmp_path / "freedom.png") == (round(3.6 * style.DPI), 11 * style.DPI)
    (figure,) = figures
    curves, bars = figure.axes
    assert [text.get_text() for text in curves.get_legend().get_texts()] == [
        "frame to frame, mean 5.00", "intrinsic frame, mean 2.00",
    ]  # fmt: skip
    heights = [bar.get_height() for bar in bars.patches]
    assert_allclose(heights[:7], [0, 0, 0, 0, 0, 1, 0])
    assert_allclose(heights[7:], [0, 1 / 3, 1 / 3, 1 / 3, 0, 0, 0])

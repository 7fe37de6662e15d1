"""Pictures of a radiance field and its poses: whole PNG files that show what was handed in."""

import matplotlib
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose.plots import nerf as nerf_plots
from jaxpose.plots import style


def read(path):
    with Image.open(path) as image:
        assert image.format == "PNG"
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no temporary file stays
    return pixels


def close_to(pixels, color, tolerance=12):
    wanted = 255 * np.array(matplotlib.colors.to_rgb(color))
    return int((np.abs(pixels - wanted).max(-1) < tolerance).sum())


def circle(n=60):
    angle = np.linspace(0, 6, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZX", np.stack([angle, np.full(n, -np.pi / 2)], -1)).as_matrix()
    T[:, :3, 3] = 400 * np.stack([np.cos(angle), np.sin(angle), 0.2 * np.sin(3 * angle)], -1)
    return T


def moved(T, by):
    T = T.copy()
    T[:, :3, 3] += by * np.random.default_rng(0).normal(size=(len(T), 3))
    return T


def frusta(axes):
    """The drawn edges of ground truth and of the other poses; the first collection joins their centres."""
    return [np.array(collection._segments3d) for collection in axes.collections][1:]


@pytest.mark.parametrize("case", ["path", "jumps", "in one place", "gaps", "y down", "two"])
def test_cameras(tmp_path, figures, case):
    ground_truth = circle(2 if case == "two" else 60)
    if case == "jumps":
        ground_truth = ground_truth[np.random.default_rng(1).permutation(60)]
    if case == "y down":
        ground_truth = np.diag([1.0, -1, -1, 1]) @ ground_truth
    start, estimate = moved(ground_truth, 80.0), moved(ground_truth, 5.0)
    if case == "in one place":
        start[:, :3, 3] = ground_truth[:, :3, 3].mean(0)
    if case == "gaps":
        start[3] = np.nan
    nerf_plots.cameras(tmp_path / "cameras.png", ground_truth, start, estimate, "a title")
    pixels = read(tmp_path / "cameras.png")
    half = pixels.shape[1] // 2
    body = slice(0, int(0.9 * len(pixels)))  # without the legend
    assert close_to(pixels[body, :half], style.LOST) > 100 > close_to(pixels[body, half:], style.LOST)
    assert close_to(pixels[body, half:], style.ESTIMATE) > 100
    (figure,) = figures
    left, right = figure.axes
    assert (len(left.lines) > 0) == (case != "jumps" and case != "two")
    for axes in (left, right):
        for (low, high), k in zip((axes.get_xlim(), axes.get_ylim(), axes.get_zlim()), range(3), strict=True):
            points = np.concatenate([s.reshape(-1, 3) for s in frusta(axes)])[:, k]
            assert min(low, high) <= points.min() and points.max() <= max(low, high)
        assert (axes.get_zlim()[0] > axes.get_zlim()[1]) == (case == "y down")


@pytest.mark.parametrize("flip", [np.eye(4), np.diag([1.0, -1, -1, 1]), np.eye(4)[[1, 2, 0, 3]]])
def test_the_scene_is_not_mirrored(tmp_path, figures, flip):
    nerf_plots.cameras(tmp_path / "c.png", *[flip @ circle()] * 3, "a title")
    (figure,) = figures
    axes = figure.axes[0]
    names = [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()]
    handedness = np.linalg.det(np.eye(3)[["xyz".index(name) for name in names]])
    downward = -1 if axes.get_zlim()[0] > axes.get_zlim()[1] else 1
    assert handedness * downward == pytest.approx(1)


def test_a_frustum_opens_where_the_camera_looks():
    T = np.eye(4)[None]
    T[0, :3, 3] = [1, 2, 3]
    edges = nerf_plots._frusta(T, 2.0)
    assert edges.shape == (8, 2, 3)
    np.testing.assert_allclose(edges[:4, 0], np.tile([1.0, 2, 3], (4, 1)))
    np.testing.assert_allclose(edges[:4, 1].mean(0), [1, 2, 5])


def view(generator, depth, size=(24, 32)):
    rgb = generator.integers(0, 255, (*size, 3), np.uint8)
    return nerf_plots.HeldOut("r_7", rgb, np.clip(rgb / 255 + 0.1, 0, 1), np.full(size, depth))


@pytest.mark.parametrize("count", [1, 2, 6])
def test_held_out(tmp_path, figures, count):
    generator = np.random.default_rng(0)
    views = [view(generator, depth) for depth in (4.0, 0.0, np.nan, 1e8, 3.0, 5.0)]
    nerf_plots.held_out(tmp_path / "held_out.png", views[:count], "a title")
    assert read(tmp_path / "held_out.png").shape[1] == 11 * style.DPI
    (figure,) = figures
    shown = [axes for axes in figure.axes if axes.images]
    assert len(shown) == 4 * min(count, 4)
    photograph, rendered, depth, difference = (axes.images[0].get_array() for axes in shown[:4])
    np.testing.assert_array_equal(photograph, views[0].rgb)
    np.testing.assert_allclose(rendered, views[0].rendered_rgb)
    np.testing.assert_allclose(depth, 4.0)
    np.testing.assert_allclose(difference, np.abs(views[0].rendered_rgb - views[0].rgb / 255).mean(-1))
    mse = np.mean((views[0].rendered_rgb - views[0].rgb / 255) ** 2)
    assert shown[3].texts[0].get_text() == f"PSNR {-10 * np.log10(mse):.2f} dB"


def test_a_sky_leaves_colours_to_what_is_near(tmp_path, figures):
    """A fifth of the rays end nowhere."""
    depth = np.full((24, 32), 2.0)
    depth[:, :16], depth[:5] = 1.0, 1800.0
    seen = view(np.random.default_rng(0), 1.0)._replace(rendered_depth=depth)
    nerf_plots.held_out(tmp_path / "held_out.png", [seen], "a title")
    (figure,) = figures
    image = [axes for axes in figure.axes if axes.images][2].images[0]
    low, high = image.get_clim()
    assert low == 1 and 2 < high < 10


def test_a_sheet_without_any_depth(tmp_path, figures):
    nerf_plots.held_out(tmp_path / "held_out.png", [view(np.random.default_rng(0), 0.0)], "a title")
    assert read(tmp_path / "held_out.png").shape[2] == 3
    (figure,) = figures
    depth = [axes for axes in figure.axes if axes.images][2].images[0].get_array()
    assert not np.isfinite(np.ma.filled(depth, np.nan)).any()  # shown as none, not as a depth of 0


@pytest.mark.parametrize("names", [("posenet",), ("posenet", "table", "bspline")])
def test_curves(tmp_path, figures, names):
    steps = np.arange(0, 1000, 10)
    decay = np.exp(-steps / 300)
    seldom = np.where(steps % 100 == 0, decay, np.nan)
    run = nerf_plots.History(steps, decay, 20 - 10 * decay, seldom, np.full(100, np.nan))
    nerf_plots.curves(
        tmp_path / "curves.png", dict.fromkeys(names, run), "a title", translation_unit="% of the diameter"
    )
    assert read(tmp_path / "curves.png").shape == (6 * style.DPI, 11 * style.DPI, 3)
    (figure,) = figures
    loss, quality, rotation, translation = figure.axes
    np.testing.assert_allclose(loss.lines[0].get_ydata(), decay)
    np.testing.assert_allclose(quality.lines[-1].get_ydata(), 20 - 10 * decay)
    np.testing.assert_array_equal(rotation.lines[0].get_xdata(), np.arange(0, 1000, 100))  # joined over gaps
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "linear", "log", "linear"]
    assert translation.get_ylabel() == "translation error [% of the diameter]"
    assert len(figure.legends) == (len(names) > 1)

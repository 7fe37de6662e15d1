"""What depth cameras of several kinds make of exact depth: noise, steps, bias, mixed pixels and holes.

Sizes in pixels are those of a sensor with 640 columns; they shrink with images of fewer. Constants without a
source beside them are chosen so that the errors have the size that such cameras are known for.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import convolve1d, maximum_filter, uniform_filter

from jaxpose.geometry.camera import Camera

Sensor = Literal["axial", "structured_light", "stereo", "time_of_flight", "stipple"]
# Nearest and farthest depth that is reported [m].
RANGES: dict[Sensor, tuple[float, float]] = {
    "axial": (0.0, np.inf),
    "structured_light": (0.5, 5.0),  # Khoshelham and Oude Elberink 2012
    "stereo": (0.3, 6.0),
    "time_of_flight": (0.5, 4.5),  # Kinect v2's
    "stipple": (0.4, 5.0),
}
STEP = 0.001  # depth is stored in millimetres
COLUMNS = 640  # of the sensor whose pixels the constants below count

BASELINE = 0.075  # from the infrared camera to its projector, along -x [m] (Konolige and Mihelich 2010)
SPECKLE_STEP = 1 / 8  # [px] of disparity (Konolige and Mihelich 2010)
# Khoshelham and Oude Elberink (2012) find 1/2 step in all; 1 / sqrt(12) of it is the rounding.
SPECKLE_SIGMA = SPECKLE_STEP * (1 / 4 - 1 / 12) ** 0.5
SPECKLE_WINDOW = 9  # [px] (Konolige and Mihelich 2010)
LATERAL_SIGMA = 0.8  # [px] of an edge's place (Nguyen, Izadi and Lovell 2012)

STEREO_BASELINE = 0.05  # to the second camera, along +x [m]
STEREO_STEP = 1 / 32  # [px] of disparity (Grunnet-Jepsen et al., Intel RealSense D400: subpixel linearity)
STEREO_WINDOW = 7  # [px]
STEREO_SIGMA = 0.08, 0.15  # [px] of disparity where texture is strong and where it is weak
STRONG_TEXTURE, LEAST_TEXTURE = 6.0, 1.5  # rms slope of grey along a row [1/255 per pixel of the image]

UNAMBIGUOUS = 1.5  # [m] half a wavelength of a modulation of 100 MHz
SIGNAL, AMBIENT = 2e5, 1e4  # [electrons] from a white surface at 1 m, and from other light
LEAST_SIGNAL = 1e3  # [electrons]
CORNER_CELL = 8  # [px]
CORNER_SHARE, CORNER_MOST = 0.2, 0.02  # of how much deeper a corner is than what is around it; [m]

STIPPLE_RATIO = 0.6  # resolution of the depth camera against colour's
STIPPLE_BASELINE = 0.05  # from the colour camera to the depth camera, along +x [m]
STIPPLE_SIGMA = 0.003  # [1/m] times the squared depth


class View(NamedTuple):
    """What there is to measure, pixel by pixel."""

    depth: Float[np.ndarray, "h w"]  # [m]
    rgb: UInt8[np.ndarray, "h w 3"]
    cosine: Float[np.ndarray, "h w"]  # of the angle between the ray and the surface normal
    camera: Camera


Measured = tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]  # depth [m], where the surface defeats it


def measured_depth(
    sensor: Sensor,
    depth: Float[np.ndarray, "h w"],
    rgb: UInt8[np.ndarray, "h w 3"],
    cosine: Float[np.ndarray, "h w"],
    camera: Camera,
    rng: np.random.Generator,
    *,
    noise: float = 1.0,
    holes: bool = True,
) -> Float[np.ndarray, "h w"]:
    """Depth as a sensor reports it, in the pixels of the colour camera.

    Args:
        sensor: Which kind; `axial` is the law that the tracker assumes, the others are not.
        depth: Exact z-depth (h, w) [m], positive everywhere.
        rgb: Colour (h, w, 3), from which texture and reflectivity are taken.
        cosine: Of the angle between the ray and the surface normal (h, w).
        camera: Of the images.
        rng: Makes all of the frame's noise.
        noise: Times the sensor's random noise. Steps, bias and what happens at edges stay; `axial` without
            noise is exact.
        holes: Without them the sensor measures what defeats it: shadows, and surfaces that are grazing, dark
            or have no texture. Its range and the stipple stay.

    Returns:
        Depth (h, w) [m], float32, 0 where there is none.
    """
    found, defeated = _MODELS[sensor](View(depth, rgb, cosine, camera), rng, noise)
    near, far = RANGES[sensor]
    missing = (found < near) | (found > far)
    return np.where(missing | defeated if holes else missing, np.float32(0), found)


def axial(view: View, rng: np.random.Generator, noise: float) -> Measured:
    """Kinect's axial noise, independent from pixel to pixel, and the holes of its projector."""
    noise_rng, hole_rng = rng.spawn(2)
    found = view.depth
    if noise:
        sigma = noise * axial_sigma(view.depth)
        found = _stored(view.depth + sigma * noise_rng.standard_normal(view.depth.shape, np.float32))
    return found, projector_holes(view.depth, view.cosine, view.camera, hole_rng)


def axial_sigma(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Standard deviation of Kinect's depth [m] (Nguyen, Izadi and Lovell, 3DIMPVT 2012)."""
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def projector_holes(
    depth: Float[np.ndarray, "h w"],
    cosine: Float[np.ndarray, "h w"],
    camera: Camera,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Where a projector at -x leaves nothing to see: its shadows beside near things, and grazing surfaces.

    Below a cosine of 0.2 pixels begin to fail, below 0.1 all do.
    """
    return _hidden(depth, camera.fx * BASELINE) | _grazing(cosine, rng)


def structured_light(view: View, rng: np.random.Generator, noise: float) -> Measured:
    """A projected pattern, matched in windows (Kinect, Xtion).

    Depth is f b / d of a disparity d in steps (Khoshelham and Oude Elberink, Sensors 2012), so its
    step and noise grow as z^2 / (f b). The windows of neighbours overlap, and so does their noise. Edges are
    ragged.
    """
    noise_rng, hole_rng = rng.spawn(2)
    reach = _reach(view.camera, BASELINE)
    disparity = _ragged(reach / view.depth, noise * LATERAL_SIGMA * view.camera.width / COLUMNS, noise_rng)
    window = _pixels(view.camera, SPECKLE_WINDOW)
    disparity += noise * SPECKLE_SIGMA * _windowed(noise_rng, view.depth.shape, window)
    found = _depth(disparity, reach, SPECKLE_STEP)
    return found, projector_holes(view.depth, view.cosine, view.camera, hole_rng)


def stereo(view: View, rng: np.random.Generator, noise: float) -> Measured:
    """Two cameras, matched in windows without a projector (RealSense in sunlight, ZED).

    The noise of disparity falls with the slope of grey along the rows (Matthies, Kanade and Szeliski, IJCV
    1989); where there is none nothing is found. A window that holds an edge is matched by the nearer surface,
    which so grows by up to half a window (Kanade and Okutomi, PAMI 1994). What the second camera does
    not see has no depth.
    """
    camera, reach = view.camera, _reach(view.camera, STEREO_BASELINE)
    window = _pixels(camera, STEREO_WINDOW)
    slope = np.gradient(_channel_sum(view.rgb) / np.float32(3), axis=1)
    texture = np.sqrt(np.maximum(uniform_filter(slope * slope, window, mode="nearest"), 1e-6))
    disparity = reach / view.depth
    full, half = (maximum_filter(disparity, size, mode="nearest") for size in (window, (window + 1) // 2))
    fattened = np.where(_windowed(rng, disparity.shape, window) > 0, full, half)
    edge = fattened - disparity > 1
    sigma = np.clip(STEREO_SIGMA[0] * STRONG_TEXTURE / texture, *STEREO_SIGMA)
    disparity = np.where(edge, fattened, disparity)
    disparity += np.float32(noise) * sigma * _windowed(rng, disparity.shape, window)
    hidden = _hidden(view.depth[:, ::-1], camera.fx * STEREO_BASELINE)[:, ::-1] & ~edge
    return _depth(disparity, reach, STEREO_STEP), hidden | (texture < LEAST_TEXTURE)


def time_of_flight(view: View, rng: np.random.Generator, noise: float) -> Measured:
    """The phase of modulated light (Kinect v2, Azure Kinect), by its amplitude.

    The noise is L / sqrt(8) * sqrt(B) / (2 A), with amplitude A, offset B and unambiguous range L (Lange
    and Seitz, IEEE JQE 2001); A falls with distance, slant and darkness. A pixel at an edge mixes both
    surfaces by their amplitudes, so that it flies between them. Concave corners, where light comes back by
    way of the other wall, are measured too far (Gudmundsson, Aanaes and Larsen, ISSCS 2007).
    """
    amplitude = SIGNAL * _REFLECTIVITY[_channel_sum(view.rgb)] * view.cosine / view.depth**2
    blurred = _blurred(amplitude)
    found = _blurred(amplitude * view.depth) / blurred + corner_bias(view.depth, view.camera)
    sigma = np.float32(noise * UNAMBIGUOUS / 8**0.5 / 2) * np.sqrt(blurred + AMBIENT) / blurred
    found += sigma * rng.standard_normal(found.shape, np.float32)
    return _stored(found), blurred < LEAST_SIGNAL


def corner_bias(depth: Float[np.ndarray, "h w"], camera: Camera) -> Float[np.ndarray, "h w"]:
    """What indirect light adds to depth [m]: none on planes and convex edges, most in a concave corner.

    A plane's inverse depth is linear in the pixel; a corner's is below the mean of points to both sides.
    Depths that differ by more than 10% lie on surfaces apart, and do not count.
    """
    cell = min(_pixels(camera, CORNER_CELL), *depth.shape)
    h, w = (n // cell for n in depth.shape)
    blocks = (1 / depth[: h * cell, : w * cell]).reshape(h, cell, w, cell).mean((1, 3))
    padded = np.pad(blocks, 4)
    deeper = np.zeros_like(blocks)
    for reach in (2, 4):
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            before, after = (
                padded[4 + k * down :, 4 + k * right :][:h, :w] / blocks - 1 for k in (-reach, reach)
            )
            same = np.maximum(np.abs(before), np.abs(after)) < 0.1
            deeper += np.where(same, (before + after) / 2, 0) / 8
    bias = np.clip(CORNER_SHARE * deeper / blocks, 0, CORNER_MOST).astype(np.float32)
    down, right = (_interpolation(n, m, cell) for n, m in zip(depth.shape, (h, w), strict=True))
    return down @ bias @ right.T


def stipple(view: View, rng: np.random.Generator, noise: float) -> Measured:
    """Depth of a coarser camera beside the colour camera, carried over to colour's pixels point by point.

    Most pixels get none, in a regular pattern. Behind an edge the depth camera sees what the colour camera
    does not (taken to go on as the farther surface beside it); that shows through between the points of the
    nearer surface. On the other side of an edge the depth camera sees nothing.
    """
    noise_rng, hole_rng = rng.spawn(2)
    height, width = view.depth.shape
    shift = view.camera.fx * STIPPLE_BASELINE
    row, column = (
        (np.arange(max(round(n * STIPPLE_RATIO), 1)) + 0.5) / STIPPLE_RATIO - 0.5 for n in (height, width)
    )
    row = np.clip(np.rint(row).astype(int), 0, height - 1)
    depth = 1 / _from_beside(1 / view.depth[row], shift, column)
    depth += noise * STIPPLE_SIGMA * depth**2 * noise_rng.standard_normal(depth.shape, np.float32)
    depth = np.maximum(depth, STEP)
    landing = np.rint(column + shift / depth).astype(int)
    inside = landing < width
    found = np.full(height * width, np.inf, np.float32)
    np.minimum.at(found, (row[:, None] * width + landing)[inside], depth[inside].astype(np.float32))
    found = np.where(np.isfinite(found), found, 0).reshape(height, width)
    return _stored(found), _grazing(view.cosine, hole_rng)


def _from_beside(
    inverse: Float[np.ndarray, "r w"], shift: float, column: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "r c"]:
    """Inverse depth by a camera at +x, whose pixels look the way that `column` of this one do."""
    rows, width = inverse.shape
    landing = np.rint((np.arange(width) - shift * inverse + 0.5) * STIPPLE_RATIO - 0.5).astype(int)
    row = np.broadcast_to(np.arange(rows)[:, None], landing.shape)
    inside = (landing >= 0) & (landing < len(column))
    seen = np.zeros(rows * len(column), inverse.dtype)
    np.maximum.at(seen, (row * len(column) + landing)[inside], inverse[inside])  # the nearest
    seen = seen.reshape(rows, -1)
    # what only this camera sees: the farther of its neighbours
    number = np.arange(len(column))
    before = np.maximum.accumulate(np.where(seen > 0, number, 0), axis=1)
    after = np.minimum.accumulate(np.where(seen > 0, number, len(column) - 1)[:, ::-1], axis=1)[:, ::-1]
    before, after = (np.take_along_axis(seen, index, axis=1) for index in (before, after))
    seen = np.where(np.minimum(before, after) > 0, np.minimum(before, after), np.maximum(before, after))
    seen = np.maximum(seen, 1e-3)
    # at the pixel's very ray, where it meets the surface between two columns
    at = np.clip(column + shift * seen, 0, width - 1.001)
    left = at.astype(int)
    near, far = (np.take_along_axis(inverse, index, axis=1) for index in (left, left + 1))
    same = np.maximum(np.abs(near - seen), np.abs(far - seen)) < 0.03 * seen
    return np.where(same, near + (at - left) * (far - near), seen)


def _stored(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return (np.round(depth / STEP) * STEP).astype(np.float32)


def _depth(disparity: Float[np.ndarray, "h w"], reach: float, step: float) -> Float[np.ndarray, "h w"]:
    """Depth [m] of disparities [px] rounded to a step."""
    return _stored(reach / np.maximum(np.round(disparity / step) * step, step))


def _reach(camera: Camera, baseline: float) -> float:
    """Disparity times depth [px m], in the sensor's own pixels."""
    return camera.fx * COLUMNS / camera.width * baseline


def _pixels(camera: Camera, count: int) -> int:
    """What so many pixels of the sensor are in this image."""
    return max(round(count * camera.width / COLUMNS), 1)


def _channel_sum(rgb: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    red, green, blue = (rgb[..., k].astype(np.int16) for k in range(3))
    return red + green + blue


# Of a sum of channels: sRGB's power law, and the least of a black surface.
_REFLECTIVITY = np.maximum((np.arange(3 * 255 + 1) / (3 * 255)) ** 2.2, 1e-3).astype(np.float32)


def _hidden(depth: Float[np.ndarray, "h w"], reach: float) -> Bool[np.ndarray, "h w"]:
    """What does not see a second eye at -x, whose disparity is `reach` / depth.

    What the camera sees at a pixel the other sees shifted by the disparity, and of all that lands on the same
    spot it sees the nearest only.
    """
    landing = np.arange(depth.shape[1]) + reach / depth
    before = np.maximum.accumulate(landing, axis=1)[:, :-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, 1:] = landing[:, 1:] < before - 1.0
    return hidden


def _grazing(cosine: Float[np.ndarray, "h w"], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    return cosine < rng.uniform(0.1, 0.2, cosine.shape)


def _windowed(rng: np.random.Generator, shape: tuple[int, int], window: int) -> Float[np.ndarray, "h w"]:
    """Normal noise of unit variance, as the mean over windows gives it: neighbours share most of theirs."""
    white = rng.standard_normal(shape, np.float32)
    return uniform_filter(white, window, mode="wrap") * np.float32(window)


def _ragged(
    disparity: Float[np.ndarray, "h w"], sigma: float, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Disparity that beside jumps of more than a pixel is that of a random neighbour."""
    edge = np.zeros(disparity.shape, bool)
    for axis in (0, 1):
        jump = np.moveaxis(np.abs(np.diff(disparity, axis=axis)) > 1, axis, 0)
        along = np.moveaxis(edge, axis, 0)
        along[1:] |= jump
        along[:-1] |= jump
    place = np.stack(np.nonzero(edge))
    other = place + np.rint(sigma * rng.standard_normal(place.shape)).astype(int)
    row, column = (np.clip(x, 0, n - 1) for x, n in zip(other, disparity.shape, strict=True))
    ragged = disparity.copy()
    ragged[edge] = disparity[row, column]
    return ragged


def _blurred(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """A pixel's mean over its footprint, which reaches into its neighbours."""
    kernel = np.asarray([0.25, 0.5, 0.25], np.float32)
    return convolve1d(convolve1d(image, kernel, 0, mode="nearest"), kernel, 1, mode="nearest")


def _interpolation(pixels: int, cells: int, cell: int) -> Float[np.ndarray, "n m"]:
    """Weights of cells in pixels: linear between the centres of cells."""
    at = np.clip((np.arange(pixels, dtype=np.float32) + 0.5) / cell - 0.5, 0, cells - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(cells, dtype=np.float32)), 0)


_MODELS: dict[Sensor, Callable[[View, np.random.Generator, float], Measured]] = {
    "axial": axial,
    "structured_light": structured_light,
    "stereo": stereo,
    "time_of_flight": time_of_flight,
    "stipple": stipple,
}

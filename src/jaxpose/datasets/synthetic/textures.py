"""Painted surfaces: patterns with sharp edges over noise of many wavelengths, so that no period repeats.

A painter is called as `painter(rng, x, y)` with the texel centres [m] of a face, across and down, and returns
its colours (h, w, 3) in display (gamma) values, about 0 to 1.
"""

from collections.abc import Callable

import numpy as np

Painter = Callable[[np.random.Generator, np.ndarray, np.ndarray], np.ndarray]
Colour = tuple[float, float, float]


def enlarge(lattice: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Smooth interpolation of a lattice (a, b, ...) at fractional rows (h,) and columns (w,): (h, w, ...)."""
    for axis, at in ((1, column), (0, row)):
        below = np.clip(np.floor(at).astype(int), 0, max(lattice.shape[axis] - 2, 0))
        above = np.minimum(below + 1, lattice.shape[axis] - 1)
        fraction = np.clip(at - below, 0, 1).astype(np.float32)
        blend = (fraction**2 * (3 - 2 * fraction)).reshape((-1,) + (1,) * (lattice.ndim - 1 - axis))
        low = lattice.take(below, axis)
        lattice = low + (lattice.take(above, axis) - low) * blend
    return lattice


def noise(rng, x, y, wavelength: float | tuple[float, float] = 0.64, octaves: int = 6) -> np.ndarray:
    """Value noise (h, w) of about unit range, its first octave of a wavelength (across, down) [m]."""
    across, down = np.broadcast_to(np.asarray(wavelength, float), 2)
    total = np.zeros((len(y), len(x)), np.float32)
    for octave in range(octaves):
        column, row = x / across * 2**octave, y / down * 2**octave
        lattice = rng.uniform(-1, 1, (int(row[-1]) + 2, int(column[-1]) + 2)).astype(np.float32)
        total += enlarge(lattice, row, column) * 0.65**octave
    return total


def _tinted(colour, brightness: np.ndarray) -> np.ndarray:
    return np.asarray(colour, np.float32) * brightness[..., None]


def _cover(image: np.ndarray, mask: np.ndarray, colour) -> None:
    image[mask] = colour


def _bright(rng) -> np.ndarray:
    """A saturated colour."""
    return rng.permutation([rng.uniform(0.7, 0.9), rng.uniform(0.25, 0.75), rng.uniform(0.12, 0.35)])


def _rectangle(x, y, corner, size) -> np.ndarray:
    across, down = ((at >= a) & (at < a + n) for at, a, n in zip((x, y), corner, size, strict=True))
    return across[None] & down[:, None]


def _disc(x, y, centre, radius) -> np.ndarray:
    return (x[None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 < radius**2


def _writing(image, rng, x, y, corner, size, line=0.03, ink=(0.12, 0.11, 0.12)) -> None:
    """Lines of words, as bars of random lengths."""
    for top in np.arange(corner[1], corner[1] + size[1] - line / 2, line):
        at, end = corner[0], corner[0] + size[0] * rng.uniform(0.5, 1)
        while at < end:
            word = min(rng.uniform(0.6, 3) * line, end - at)
            _cover(image, _rectangle(x, y, (at, top), (word, 0.55 * line)), ink)
            at += word + 0.5 * line


def plain(rng, x, y, *, colour: Colour, contrast: float = 0.08) -> np.ndarray:
    """One colour with stains of all sizes."""
    return _tinted(colour, 1 + contrast * noise(rng, x, y))


def plaster(rng, x, y, *, colour: Colour) -> np.ndarray:
    """Sponged plaster in two coats, with a painted frieze at hand height."""
    coats = noise(rng, x, y, 0.35) > 0.1 + 0.3 * noise(rng, x, y, 1.5, 1)
    image = _tinted(colour, np.where(coats, 1.0, 0.9) * (1 + 0.08 * noise(rng, x, y, 0.2)))
    rise = 0.03 * np.abs((x / 0.17) % 2 - 1) * np.repeat(rng.uniform(0.4, 2, len(x) // 34 + 1), 34)[: len(x)]
    frieze = np.abs(y[:, None] - 0.58 * y[-1] + rise[None])
    for reach, ink in ((0.06, 0.55), (0.045, 1.1), (0.02, 0.65)):
        image[frieze < reach] = np.multiply(colour, (ink, ink, 1.05 * ink))
    return image


def _courses(rng, x, y, length: float, height: float, gap: float, tint: float, *, ragged: bool):
    """Bricks or planks in courses: brightness of each (h, w), and the gaps between."""
    course = (y / height).astype(int)
    start = (
        rng.uniform(-length, 0, course[-1] + 1) if ragged else -length / 2 * (np.arange(course[-1] + 1) % 2)
    )
    along = (x[None] - start[course][:, None]) / length
    count = along.astype(int)
    shade = 1 + tint * rng.uniform(-1, 1, (course[-1] + 1, count.max() + 1))[course[:, None], count]
    gaps = ((along - count) * length < gap) | ((y % height) < gap)[:, None]
    return shade.astype(np.float32), gaps


def bricks(rng, x, y, *, colour: Colour = (0.66, 0.36, 0.27)) -> np.ndarray:
    """A brick wall in running bond, every brick burnt differently."""
    shade, gaps = _courses(rng, x, y, 0.25, 0.085, 0.012, 0.3, ragged=False)
    image = _tinted(colour, shade * (1 + 0.12 * noise(rng, x, y, 0.3)))
    mortar = _tinted((0.72, 0.69, 0.64), 1 + 0.1 * noise(rng, x, y, 0.1, 4))
    return np.where(gaps[..., None], mortar, image)


def planks(rng, x, y, *, colour: Colour = (0.64, 0.45, 0.28), upright: bool = False) -> np.ndarray:
    """Boards along x (or upright) with grain, each of its own shade and start."""
    if upright:
        return planks(rng, y, x, colour=colour).swapaxes(0, 1)
    shade, gaps = _courses(rng, x, y, 1.1, 0.13, 0.006, 0.22, ragged=True)
    grain = noise(rng, x, y, (0.7, 0.035), 4)
    rings = np.sin(14 * noise(rng, x, y, (1.3, 0.16), 3))
    image = _tinted(colour, shade * (1 + 0.09 * grain + 0.06 * rings))
    _cover(image, gaps, np.multiply(colour, 0.35))
    return image


def wood(rng, x, y, *, colour: Colour) -> np.ndarray:
    """One piece of wood, grain along its longer side."""
    if y[-1] > x[-1]:
        return wood(rng, y, x, colour=colour).swapaxes(0, 1)
    rings = np.sin(18 * noise(rng, x, y, (0.9, 0.13), 3))
    return _tinted(colour, 1 + 0.1 * noise(rng, x, y, (0.5, 0.03), 4) + 0.1 * rings)


def stains(rng, x, y, *, colours: tuple[Colour, ...], wavelength: float = 0.25) -> np.ndarray:
    """Patches with sharp outlines in several colours: level sets of noise."""
    level = noise(rng, x, y, wavelength, 4)
    order = np.digitize(level, np.quantile(level, np.linspace(0, 1, len(colours) + 1)[1:-1]))
    image = np.asarray(colours, np.float32)[order]
    return image * (1 + 0.07 * noise(rng, x, y, 0.1, 4))[..., None]


def wallpaper(rng, x, y, *, colour: Colour = (0.55, 0.66, 0.62)) -> np.ndarray:
    """Stripes of uneven width with strewn rings and dots."""
    edges = np.cumsum(rng.uniform(0.05, 0.22, int(x[-1] / 0.05) + 2))
    stripe = rng.uniform(0.86, 1.1, len(edges) + 1)[np.digitize(x, edges)]
    image = _tinted(colour, stripe[None] * (1 + 0.07 * noise(rng, x, y)))
    for _ in range(int(14 * x[-1] * y[-1])):
        x0, y0, radius = rng.uniform(0, x[-1]), rng.uniform(0, y[-1]), rng.uniform(0.015, 0.07)
        columns = slice(*np.searchsorted(x, [x0 - radius, x0 + radius]))
        rows = slice(*np.searchsorted(y, [y0 - radius, y0 + radius]))
        part, at = image[rows, columns], (x[columns], y[rows])
        ink = _bright(rng) * 0.8 if rng.uniform() < 0.35 else np.multiply(colour, rng.uniform(0.45, 1.45))
        _cover(part, _disc(*at, (x0, y0), radius), ink)
        _cover(part, _disc(*at, (x0, y0), radius * rng.uniform(0, 0.8)), np.multiply(colour, 1.1))
    return image


def panels(rng, x, y, *, colour: Colour = (0.86, 0.85, 0.82), glowing: tuple = ()) -> np.ndarray:
    """Ceiling panels, pitted, with lit squares centred at `glowing` [m] on the chart."""
    shade, gaps = _courses(rng, x, y, 0.6, 0.6, 0.01, 0.05, ragged=False)
    image = _tinted(colour, shade * (1 + 0.05 * noise(rng, x, y, 0.16, 5)))
    _cover(image, noise(rng, x, y, 0.05, 3) < -0.75, np.multiply(colour, 0.75))
    _cover(image, gaps, np.multiply(colour, 0.6))
    for x0, y0 in glowing:
        _cover(image, _rectangle(x, y, (x0 - 0.3, y0 - 0.3), (0.6, 0.6)), (2.5, 2.5, 2.4))
    return image


def tiles(rng, x, y, *, colours: tuple[Colour, Colour], cell: float) -> np.ndarray:
    """A chequerboard of worn tiles."""
    column, row = (x / cell).astype(int), (y / cell).astype(int)
    shade = rng.uniform(0.8, 1.15, (row[-1] + 1, column[-1] + 1))[row[:, None], column]
    image = np.asarray(colours, np.float32)[(row[:, None] + column) % 2] * shade[..., None]
    return (image * (1 + 0.08 * noise(rng, x, y, 0.2, 5))[..., None]).astype(np.float32)


def rug(rng, x, y, *, colour: Colour) -> np.ndarray:
    """A woven rug: bands along its border, lozenges and patches inside."""
    dark, light = np.multiply(colour, 0.45), np.minimum(np.multiply(colour, 0.5) + 0.45, 1)
    inside = np.minimum(np.minimum(x, x[-1] - x)[None], np.minimum(y, y[-1] - y)[:, None])
    image = stains(rng, x, y, colours=(colour, tuple(np.multiply(colour, 0.8)), tuple(light)), wavelength=0.4)
    lozenge = np.abs(x[None] - x[-1] / 2) / x[-1] + np.abs(y[:, None] - y[-1] / 2) / y[-1]
    for edge, ink in ((0.4, dark), (0.34, light), (0.3, _bright(rng)), (0.16, dark), (0.12, light)):
        _cover(image, (lozenge < edge) & (lozenge > edge - 0.04), ink)
    for edge, ink in ((0.16, dark), (0.13, light), (0.09, _bright(rng) * 0.8), (0.05, dark)):
        _cover(image, inside < edge, ink)
    return image * (1 + 0.1 * noise(rng, x, y, 0.08, 4))[..., None]


def fabric(rng, x, y, *, colour: Colour, stripes: bool = False) -> np.ndarray:
    """Cloth: creases and weave, striped or not."""
    image = _tinted(colour, 1 + 0.1 * noise(rng, x, y, 0.4, 6))
    if stripes:
        edges = np.cumsum(rng.uniform(0.015, 0.09, int(x[-1] / 0.015) + 2))
        image[:, np.digitize(x, edges) % 2 == 1] *= rng.uniform(0.4, 0.6)
    return image * (1 + 0.08 * rng.uniform(-1, 1, image.shape[:2]))[..., None].astype(np.float32)


def poster(rng, x, y) -> np.ndarray:
    """A framed print: blocks, discs, a heading and small writing."""
    width, height = x[-1], y[-1]
    image = _tinted(rng.uniform(0.75, 0.97, 3), 1 + 0.05 * noise(rng, x, y))
    for _ in range(7):
        size = rng.uniform(0.12, 0.5, 2) * (width, height)
        corner = rng.uniform(0, 1, 2) * ((width, height) - size)
        _cover(image, _rectangle(x, y, corner, size), _bright(rng))
    for _ in range(6):
        centre, radius = rng.uniform(0.1, 0.9, 2) * (width, height), rng.uniform(0.04, 0.22) * width
        _cover(image, _disc(x, y, centre, radius), _bright(rng))
        _cover(image, _disc(x, y, centre, radius * rng.uniform(0.2, 0.8)), rng.uniform(0, 1, 3))
    _cover(image, _rectangle(x, y, (0, 0.74 * height), (width, height)), (0.93, 0.92, 0.88))
    _writing(image, rng, x, y, (0.08 * width, 0.77 * height), (0.84 * width, 0.06), 0.06)
    _writing(image, rng, x, y, (0.08 * width, 0.88 * height), (0.84 * width, 0.08 * height), 0.022)
    edge = np.minimum(np.minimum(x, width - x)[None], np.minimum(y, height - y)[:, None])
    _cover(image, edge < 0.025, (0.13, 0.1, 0.08))
    return image


def books(rng, x, y) -> np.ndarray:
    """Spines side by side, each with its own colour, bands and title."""
    image = np.zeros((len(y), len(x), 3), np.float32)
    at = 0.0
    while at < x[-1] + 0.01:
        width, top = rng.uniform(0.018, 0.055), rng.uniform(0, 0.15) * y[-1]
        colour = (
            _bright(rng) * rng.uniform(0.5, 1) if rng.uniform() < 0.7 else rng.uniform(0.15, 0.9) * np.ones(3)
        )
        _cover(image, _rectangle(x, y, (at, top), (width - 0.004, y[-1])), colour)
        ink = np.full(3, 0.95) if colour.mean() < 0.5 else np.full(3, 0.1)
        _cover(image, _rectangle(x, y, (at, y[-1] * rng.uniform(0.15, 0.3)), (width - 0.004, 0.012)), ink)
        title = y[-1] * rng.uniform(0.3, 0.5)
        _cover(image, _rectangle(x, y, (at + width / 3, title), (width / 4, y[-1] * 0.35)), ink)
        at += width
    return image * (1 + 0.08 * noise(rng, x, y, 0.1, 4))[..., None]


def carton(rng, x, y) -> np.ndarray:
    """Corrugated cardboard with tape and a label."""
    image = _tinted((0.68, 0.52, 0.35), 1 + 0.07 * noise(rng, x, y, (0.5, 0.03), 5))
    width, height = x[-1], y[-1]
    _cover(image, _rectangle(x, y, (0, 0.42 * height), (1 + width, 0.05)), (0.82, 0.74, 0.55))
    label, size = rng.uniform(0.1, 0.5, 2) * (width, height), np.array([0.4 * width, 0.35 * height])
    _cover(image, _rectangle(x, y, label, size), (0.92, 0.91, 0.88))
    _writing(image, rng, x, y, label + 0.02, size - (0.04, 0.02), 0.025)
    _cover(
        image, _rectangle(x, y, (0.75 * width, 0.75 * height), (0.12 * width, 0.12 * height)), _bright(rng)
    )
    return image


def screen(rng, x, y) -> np.ndarray:
    """A monitor: windows with writing on a dark desktop."""
    image = stains(rng, x, y, colours=((0.08, 0.12, 0.22), (0.12, 0.2, 0.34), (0.2, 0.3, 0.45)))
    for _ in range(4):
        size = rng.uniform(0.25, 0.5, 2) * (x[-1], y[-1])
        corner = rng.uniform(0.05, 0.95, 2) * ((x[-1], y[-1]) - size)
        _cover(image, _rectangle(x, y, corner, size), rng.choice([0.12, 0.95], p=[0.4, 0.6]) * np.ones(3))
        _cover(image, _rectangle(x, y, corner, (size[0], 0.02)), _bright(rng))
        _writing(image, rng, x, y, corner + (0.015, 0.035), size - (0.03, 0.05), 0.018, _bright(rng) * 0.8)
    edge = np.minimum(np.minimum(x, x[-1] - x)[None], np.minimum(y, y[-1] - y)[:, None])
    _cover(image, edge < 0.012, (0.05, 0.05, 0.05))
    return image

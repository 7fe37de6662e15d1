"""Where a feature is to a few hundredths of a pixel: what surrounds it, aligned between photographs.

A blob's centre moves over a round surface as the camera does. The patch that one photograph has there is
found in each other one by its colours, up to an affine map of the plane, a gain and an offset of each colour
(Lucas and Kanade 1981; Shi and Tomasi 1994).
"""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

_HALF, _SPREAD = 3, 1.5  # of a patch: nodes on each side of its middle, and how fast they count less [px]
_BLUR = 0.7  # [px] so that interpolated colours have slopes
_STEPS, _SETTLED = 15, 5e-3  # at most so many, and the move below which there are no more [px]
_FARTHEST = 1.5  # [px] from where the feature was found: beyond it another one is
_STRETCH = 0.6  # at least this, and at most one over it, in any direction
_UNLIKE = 0.5  # of the patch's contrast, that the photographs differ by at most
_AT_ONCE = 2  # photographs
_FAINTEST = 1 / 255  # contrast of a patch that is more than rounding
# The affine map's four numbers, shift, gain and three offsets at the start; squared colours that it takes to
# move the four by one, and what keeps the others' equations solvable.
_START = np.array([1.0, 0, 0, 1, 0, 0, 1, 0, 0, 0])
_STIFF = 1e-4 * np.array([1.0] * 4 + [0.0] * 6)
_LEAST = 1e-6


class Aligned(NamedTuple):
    """Features where their patches are."""

    pixel: Float[np.ndarray, "o 2"]  # moved where `found`, else as they were
    found: Bool[np.ndarray, " o"]


class _Patches(NamedTuple):
    """Colours around features, less their mean."""

    mean: Float[np.ndarray, "o 3"]
    rest: Float[np.ndarray, "o k 3"]
    contrast: Float[np.ndarray, " o"]


def align_patches(
    read: Callable[[int], UInt8[np.ndarray, "h w 3"]],
    view: Int[np.ndarray, " o"],
    point: Int[np.ndarray, " o"],
    pixel: Float[np.ndarray, "o 2"],
    enlarged: int = 1,
    on_view: Callable[[int, int], None] = lambda done, total: None,
) -> Aligned:
    """Move every feature of a point to where the patch of one of them is.

    Args:
        read: Gives a photograph (h, w, 3) by its index, each asked for up to twice, in order.
        view: Which of them a feature is in (o,).
        point: Which point it is of (o,).
        pixel: Where it was found (o, 2) [px].
        enlarged: How much photographs are enlarged for it.
        on_view: Called with how many photographs were begun, and how many there are.

    Returns:
        The features, and which of them agree with their point's patch.
    """
    place = (pixel + 0.5) * enlarged - 0.5
    of = _middle(view, point)
    is_reference = of == np.arange(len(of))
    views = range(int(view.max(initial=-1)) + 1)
    slot = np.cumsum(is_reference) - 1  # patches of references alone are kept
    count = int(is_reference.sum())
    mean, rest = np.zeros((count, 3), np.float32), np.zeros((count, len(_GRID), 3), np.float32)
    for index in views:
        rows = np.flatnonzero((view == index) & is_reference)
        patch = _sample(_smooth(read(index), enlarged), place[rows, None] + _GRID)
        mean[slot[rows]] = np.einsum("k,okc->oc", _WEIGHT, patch)
        rest[slot[rows]] = patch - mean[slot[rows], None]
    contrast = np.sqrt(np.einsum("k,okc->o", _WEIGHT, rest**2) / 3)
    found, moved = is_reference.copy(), pixel.copy()
    found[is_reference] = contrast > _FAINTEST
    others = ~is_reference & found[of]

    def align(image: UInt8[np.ndarray, "h w 3"], rows: Int[np.ndarray, " n"]) -> None:
        patches = _Patches(*(each[slot[of[rows]]] for each in (mean, rest, contrast)))
        shift, good = _aligned(_smooth(image, enlarged), place[rows], patches)
        good &= np.linalg.norm(shift, axis=1) < _FARTHEST * enlarged
        moved[rows[good]] += shift[good] / enlarged
        found[rows] = good

    with ThreadPoolExecutor(_AT_ONCE) as workers:  # numpy lets go of Python's lock
        begun = deque[Future[None]]()
        for index in views:
            rows = np.flatnonzero((view == index) & others)
            if len(rows):
                begun.append(workers.submit(align, read(index), rows))
            if len(begun) > _AT_ONCE:
                begun.popleft().result()
            on_view(index + 1, len(views))
        for each in begun:
            each.result()
    alone = np.bincount(point[found], minlength=int(point.max(initial=-1)) + 1)[point] < 2
    return Aligned(moved, found & ~alone)


def _middle(view: Int[np.ndarray, " o"], point: Int[np.ndarray, " o"]) -> Int[np.ndarray, " o"]:
    """The feature, for each, of the same point in the middle of the photographs that see it."""
    order = np.lexsort((view, point))
    first = np.searchsorted(point[order], point)
    count = np.searchsorted(point[order], point, side="right") - first
    return order[first + count // 2]


def _smooth(image: UInt8[np.ndarray, "h w 3"], enlarged: int) -> Float[np.ndarray, "H W 3"]:
    colours = image.astype(np.float32) / 255
    if enlarged > 1:
        colours = cv2.resize(colours, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
    return cv2.GaussianBlur(colours, (0, 0), _BLUR)


def _sample(image: Float[np.ndarray, "H W c"], xy: Float[np.ndarray, "o k 2"]) -> Float[np.ndarray, "o k c"]:
    """Values between pixels; those of the edge beyond it. OpenCV 4 would round places to 1/32 px."""
    height, width, channels = image.shape
    x, y = np.clip(xy[..., 0], 0, width - 1.001), np.clip(xy[..., 1], 0, height - 1.001)
    column, row = x.astype(int), y.astype(int)
    right, down = ((share.astype(np.float32))[..., None] for share in (x - column, y - row))
    flat, at = image.reshape(-1, channels), row * width + column
    above, above_right, below, below_right = (flat.take(at + k, 0) for k in (0, 1, width, width + 1))
    above += right * (above_right - above)
    below += right * (below_right - below)
    above += down * (below - above)
    return above


def _aligned(
    image: Float[np.ndarray, "H W 3"],
    place: Float[np.ndarray, "o 2"],
    patches: _Patches,
) -> tuple[Float[np.ndarray, "o 2"], Bool[np.ndarray, " o"]]:
    """How far patches are from where they are looked for, and whether they are there: Gauss and Newton's."""
    slopes = [cv2.Sobel(image, cv2.CV_32F, *axis, ksize=3) / 8 for axis in ((1, 0), (0, 1))]
    seen = np.concatenate([image, *slopes], axis=-1)
    found = np.tile(_START, (len(place), 1))
    found[:, 7:] = patches.mean
    start, unlike = found.copy(), np.full(len(place), np.inf)
    rest, moving = np.ascontiguousarray(np.moveaxis(patches.rest, -1, 0)), np.arange(len(place))
    for _ in range(_STEPS):
        step, unlike[moving] = _step(seen, place[moving], rest[:, moving], found[moving], start[moving])
        found[moving] -= step
        found[moving, :4] = np.clip(found[moving, :4], _START[:4] - 0.7, _START[:4] + 0.7)
        found[moving, 4:6] = np.clip(found[moving, 4:6], -4, 4)
        moving = moving[np.abs(step[:, 4:6]).max(axis=1) >= _SETTLED]
        if not len(moving):
            break
    stretches = np.linalg.svd(found[:, :4].reshape(-1, 2, 2), compute_uv=False)
    alike = unlike < _UNLIKE * patches.contrast
    return found[:, 4:6], alike & (stretches[:, 1] > _STRETCH) & (stretches[:, 0] < 1 / _STRETCH)


def _step(
    seen: Float[np.ndarray, "H W 9"],
    place: Float[np.ndarray, "o 2"],
    rest: Float[np.ndarray, "3 o k"],
    found: Float[np.ndarray, "o 10"],
    start: Float[np.ndarray, "o 10"],
) -> tuple[Float[np.ndarray, "o 10"], Float[np.ndarray, " o"]]:
    """What to take off `found`, and how unlike patches are there: an image and its slopes are `seen`."""
    at = np.stack([place[:, k, None] + found[:, of] @ _LINEAR.T for k, of in enumerate(_OF_AXIS)], axis=-1)
    sampled = np.ascontiguousarray(np.moveaxis(_sample(seen, at), -1, 0))  # (9, o, k)
    colour, by_x, by_y = sampled[:3], sampled[3:6], sampled[6:]
    gain, *offset = found[:, 6:].T.astype(np.float32)
    difference = colour - gain[:, None] * rest - np.stack(offset)[..., None]
    # By the map's numbers and the shift it is a slope times x, y or 1, so that sums of products of slopes
    # over the patch, times those of x, y and 1, are all that equations are made of.
    slopes, count = (by_x, by_y), len(place)
    matrix, down = np.zeros((count, 10, 10)), np.empty((count, 10))
    for a, b in ((0, 0), (0, 1), (1, 1)):
        block = (_summed(slopes[a] * slopes[b]) @ _SQUARES)[:, _PAIRS]
        matrix[:, _OF_AXIS[a][:, None], _OF_AXIS[b]] = block
        matrix[:, _OF_AXIS[b][:, None], _OF_AXIS[a]] = block
    for of, slope in zip(_OF_AXIS, slopes, strict=True):
        matrix[:, of, 6] = matrix[:, 6, of] = -(_summed(slope * rest) @ _FIRST)
        matrix[:, of, 7:] = -np.moveaxis(slope @ _FIRST, 0, -1)
        matrix[:, 7:, of] = np.swapaxes(matrix[:, of, 7:], 1, 2)
        down[:, of] = _summed(slope * difference) @ _FIRST
    matrix[:, 6, 6] = _summed(rest**2) @ _WEIGHT
    matrix[:, (7, 8, 9), (7, 8, 9)] = 1  # the rest has no mean, so that the gain leaves offsets alone
    down[:, 6], down[:, 7:] = -(_summed(rest * difference) @ _WEIGHT), -(difference @ _WEIGHT).T
    down += _STIFF * (found - start)
    step = np.linalg.solve(matrix + np.diag(_STIFF + _LEAST), down[..., None])[..., 0]
    return step, np.sqrt(_summed(difference**2) @ _WEIGHT / 3)


def _summed(colours: Float[np.ndarray, "3 o k"]) -> Float[np.ndarray, "o k"]:
    return colours[0] + colours[1] + colours[2]


_ALONG = np.arange(-_HALF, _HALF + 1, dtype=np.float32)
_GRID = np.stack(np.meshgrid(_ALONG, _ALONG), axis=-1).reshape(-1, 2)
_WEIGHT = np.exp(-0.5 * np.sum(_GRID**2, axis=1) / _SPREAD**2)
_WEIGHT /= _WEIGHT.sum()
_LINEAR = np.column_stack([_GRID, np.ones_like(_WEIGHT)])  # x, y and 1,
_OF_AXIS = np.array([[0, 1, 4], [2, 3, 5]])  # and the numbers that go with them along u and along v
_FIRST = _WEIGHT[:, None] * _LINEAR
_SQUARES = np.column_stack([_FIRST * _GRID[:, :1], _FIRST * _GRID[:, 1:], _WEIGHT])  # x and y times these
_PAIRS = np.array([[0, 1, 2], [3, 4, 5], [2, 5, 6]])  # where x x, x y, x; y x, y y, y; x, y and 1 are in it

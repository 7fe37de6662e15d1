"""Warps by Gauss-Newton on a pyramid, from blurred patches to the patches themselves, in float64 numpy.

The image is unknown too. On each level it is a grid of pixels, bilinear between them, that fits the patches
best under the warps at hand: a linear problem, which leaves one of the warps alone (variable projection,
Golub and Pereyra 1973). Its Gauss-Newton step is made by the smallest change of the field's parameters.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array, eye_array

from jaxpose.experiments.planar.alignment import Align, Aligned, psnr
from jaxpose.experiments.planar.task import Photo, Task, apply, corner_errors, corners, pixels, rigid
from jaxpose.experiments.planar.warps import Warps, coordinates

STEPS, LAST_STEPS = 6, 4  # on each level with a blur, on the last
_WIDEST = 2 / 15  # standard deviation of the widest blur, as a share of a patch's side
_NEAR_PX = 6.5  # of a blur, from which the next is half as wide
_NARROWEST_PX = 2.0  # of a blur; the last level has none
_RIDGE = 1e-3  # in points, that pulls every pixel of the grid to the mean: it decides where no patch lies
_DAMPING = 1e-6  # of the mean eigenvalue of the normal equations in the field's parameters
_SWEEPS, _STEP_SWEEPS, _PICTURE_SWEEPS = 20, 5, 60  # of conjugate gradients: image, warps' step, last image
_TINY = 1e-300  # in place of a zero that divides zero
_REACH = 2.0  # pixels of the level's grid that a step may move a point by


def blurs(crop: int) -> list[float]:
    """Standard deviations [px] of the levels' blurs, for patches of `crop` pixels a side."""
    found = [_WIDEST * crop]
    # In small steps while patches may be far off, in halves after that.
    while found[-1] / 2 >= _NARROWEST_PX:
        found.append(found[-1] / (math.sqrt(2) if found[-1] > _NEAR_PX else 2))
    return [*found, 0.0]


def count(crop: int) -> int:
    """Steps on all levels together."""
    return STEPS * (len(blurs(crop)) - 1) + LAST_STEPS


def by_gauss_newton(photo: Photo, warps: Warps) -> Align:
    """An alignment by Gauss-Newton on the parameters of rigid warps, from the widest blur to none.

    Args:
        photo: the photograph of the patches.
        warps: motions of the plane, the first the identity.

    Returns:
        The alignment; the numbers told after a step are its count, the loss before it, and the error after.
    """
    located, jacobian, moved = _compiled(warps)

    def stepped(level, params, q):
        normal, gradient, loss = _normal_equations(photo, level, q)
        rows, kernel = jacobian(params)
        kernel = np.asarray(kernel, np.float64)
        product = normal @ kernel
        damping = _DAMPING * np.trace(product) / len(product) + _TINY
        dual = np.linalg.solve(product + damping * np.eye(len(product)), gradient)
        change = (kernel @ dual).reshape(len(q) - 1, -1)
        at_corners = _derivatives(q, corners(photo))[1:] * photo.unit
        farthest = np.abs(np.einsum("nkpc,nk->npc", at_corners, change)).max()
        dual *= min(1.0, _REACH * level.spacing / max(farthest, 1e-9))
        return moved(params, rows, jnp.asarray(dual, jnp.float32)), loss

    def align(task: Task, key, on_step=None, /) -> Aligned:
        params, losses, curve = warps.init(key), [], []

        def measured():
            q = np.asarray(located(params), np.float64)
            curve.append(float(corner_errors(photo, rigid(*q.T), task.H_image_patch)[1:].mean()))
            return q

        q = measured()
        for level in _levels(photo, task):
            for _ in range(STEPS if level.spacing > 1 else LAST_STEPS):
                params, loss = stepped(level, params, q)
                losses.append(loss)
                q = measured()
                if on_step is not None:
                    on_step(len(losses), loss, curve[-1])
        H = rigid(*q.T)
        picture, quality = _picture(photo, task, apply(H, pixels(photo)) * photo.unit)
        return Aligned(picture, H, np.array(losses), np.array(curve), quality)

    return align


class _Level(NamedTuple):
    """Points of the patches, and their brightness after the blur."""

    xy: Float[np.ndarray, "p 2"]
    brightness: Float[np.ndarray, "n p"]
    spacing: float  # of the image's grid [px]


def _levels(photo: Photo, task: Task) -> Iterator[_Level]:
    colours = task.rgb - task.rgb.mean(axis=(0, 1))
    # What varies most among the colours; any one channel may be flat.
    flat = colours.reshape(-1, 3)
    _, axes = np.linalg.eigh(flat.T @ flat)
    patches = (colours @ axes[:, -1]).reshape(-1, photo.crop, photo.crop)
    xy = pixels(photo).reshape(photo.crop, photo.crop, 2)
    for blur in blurs(photo.crop):
        every = max(1, math.ceil(blur / 2))
        kept = (slice(every // 2, None, every),) * 2
        level = np.stack([gaussian_filter(patch, blur)[kept] if blur else patch for patch in patches])
        yield _Level(xy[kept].reshape(-1, 2), level.reshape(len(level), -1), max(1.0, blur))


def _normal_equations(
    photo: Photo, level: _Level, q: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, " d"], float]:
    """Of the warps but the first, the image eliminated; and the mean squared error of the best image."""
    place = (apply(rigid(*q.T), level.xy) * photo.unit).reshape(-1, 2)
    A, slopes = _bilinear(place, _Grid.around(place, level.spacing))
    solve = _solver(A)
    image = solve(A.T @ level.brightness.ravel(), _SWEEPS)
    error = level.brightness.ravel() - A @ image
    along = slopes(image).reshape(*level.brightness.shape, 2)
    size, (patches, freedoms) = len(level.xy), q.shape
    normal = np.zeros((patches - 1, freedoms, patches - 1, freedoms))
    gradient, seen = [], []  # by patch, as the others' points do not move with its warp
    derivatives = _derivatives(q, level.xy) * photo.unit
    for k in range(1, patches):
        rows = slice(k * size, (k + 1) * size)
        J = np.stack([(along[k] * by).sum(axis=-1) for by in derivatives[k]], axis=-1)
        normal[k - 1, :, k - 1] = J.T @ J
        gradient.append(J.T @ error[rows])
        seen.append(A[rows].T @ J)
    seen = np.concatenate(seen, axis=1)
    normal = normal.reshape(seen.shape[1], -1) - seen.T @ solve(seen, _STEP_SWEEPS)
    return (normal + normal.T) / 2, np.concatenate(gradient), float(np.mean(error**2))


def _derivatives(q: Float[np.ndarray, "n 3"], xy: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "n 3 p 2"]:
    """Of where points come to lie, by x, y and angle of their patch."""
    x, y = np.moveaxis(apply(rigid(*q.T), xy) - q[:, None, :2], -1, 0)
    one, zero = np.ones_like(x), np.zeros_like(x)
    by = [(one, zero), (zero, one), (-y, x)]
    return np.stack([np.stack(pair, axis=-1) for pair in by], axis=1)


def _compiled(warps: Warps) -> tuple[Callable, Callable, Callable]:
    """x, y and angle of the warps; their derivatives by the parameters, and these times themselves; steps."""

    def located(params):
        return coordinates(warps.warps(params))

    def jacobian(params):
        free = lambda p: located(p)[1:].ravel()
        rows = jax.tree.map(lambda x: x.reshape(x.shape[0], -1), jax.jacrev(free)(params))
        products = [jnp.matmul(x, x.T, precision="highest") for x in jax.tree.leaves(rows)]
        return rows, sum(products[1:], products[0])

    def moved(params, rows, dual: Float[Array, " d"]) -> Any:
        change = lambda x, row: x + jnp.matmul(dual, row, precision="highest").reshape(x.shape)
        return jax.tree.map(change, params, rows)

    return jax.jit(located), jax.jit(jacobian), jax.jit(moved)


class _Grid(NamedTuple):
    """Pixels of an image: where the first is, how far apart they are [px], and how many."""

    first: Float[np.ndarray, "2"]
    spacing: float
    size: tuple[int, int]  # columns, rows

    @classmethod
    def around(cls, place: Float[np.ndarray, "p 2"], spacing: float) -> "_Grid":
        """The least that holds all points; on an unmoved patch's pixels if its side is even."""
        low = np.floor((place.min(axis=0) - 0.5) / spacing)
        high = np.ceil((place.max(axis=0) - 0.5) / spacing)
        columns, rows = (high - low).astype(int) + 1
        return cls(low * spacing + 0.5, spacing, (int(columns), int(rows)))


def _bilinear(place: Float[np.ndarray, "p 2"], grid: _Grid) -> tuple[csr_array, Callable]:
    """What takes the pixels of a grid to the values at points, and what to their derivatives by x and y."""
    columns, rows = grid.size
    at = (place - grid.first) / grid.spacing
    cell = np.clip(np.floor(at).astype(np.int32), 0, [columns - 2, rows - 2])
    x, y = (at - cell).T
    index = (cell[:, 1] * columns + cell[:, 0])[:, None] + np.array([0, 1, columns, columns + 1], np.int32)
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)
    starts = np.arange(0, index.size + 1, 4)
    A = csr_array((weights.ravel(), index.ravel(), starts), shape=(len(place), columns * rows))

    def slopes(image):
        a, b, c, d = image[index].T
        return np.stack([(1 - y) * (b - a) + y * (d - c), (1 - x) * (c - a) + x * (d - b)], -1) / grid.spacing

    return A, slopes


def _solver(A: csr_array) -> Callable:
    """Solutions of the normal equations of `A`, by sweeps of conjugate gradients on all columns at once."""
    normal = (A.T @ A + _RIDGE * eye_array(A.T.shape[0])).tocsr()
    scale = 1 / normal.diagonal()

    def solve(b, sweeps):
        preconditioner = scale.reshape(-1, *(1,) * (b.ndim - 1))
        x, left = np.zeros_like(b), b
        direction = ahead = preconditioner * left
        size = (left * ahead).sum(axis=0)
        for _ in range(sweeps):
            onward = normal @ direction
            length = size / np.maximum((direction * onward).sum(axis=0), _TINY)
            x, left = x + length * direction, left - length * onward
            ahead = preconditioner * left
            size, before = (left * ahead).sum(axis=0), size
            direction = ahead + size / np.maximum(before, _TINY) * direction
        return x

    return solve


def _picture(
    photo: Photo, task: Task, place: Float[np.ndarray, "n p 2"]
) -> tuple[Float[np.ndarray, "h w 3"], float]:
    """The image that fits the patches best, on the pixels of the photograph, and its PSNR on the patches."""
    wanted = photo.pixels * photo.unit
    place, rgb = place.reshape(-1, 2), task.rgb.reshape(-1, 3)
    grid, mean = _Grid.around(np.concatenate([place, wanted]), 1.0), rgb.mean(axis=0)
    A, _ = _bilinear(place, grid)
    image = _solver(A)(A.T @ (rgb - mean), _PICTURE_SWEEPS)
    picture = (_bilinear(wanted, grid)[0] @ image + mean).reshape(photo.rgb.shape)
    return picture, psnr(A @ image + mean - rgb)

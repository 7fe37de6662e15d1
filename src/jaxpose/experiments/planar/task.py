"""What the planar experiment aligns: an image, patches of it under known warps, and how far two warps differ.

Coordinates are BARF's: the image's centre is the origin, x to the right, y down, and half its longer side the
unit. A warp is a 3x3 homogeneous matrix `H_image_patch` from the frame of a patch, in which it is the centre
crop, to the image. numpy, float64.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from jaxpose.errors import DataError
from jaxpose.files.untrusted import opened_image

PATCHES = {"paper": 7, "homography": 5}
_KNOTS = 10  # random points of a path, per dimension
_ROOM = 0.5  # share of the room between centre crop and border that a path's positions are drawn from
_TURN_DEG = 20.0
_NOISE = 0.1  # standard deviation of every entry of a homography's generator
_OFFSETS = 0.2 * np.array([(0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)])  # BARF's, of its first two entries
_DRAWS = 10000
_LEAST_SIDE, _MOST_SIDE = 32, 640  # [px]
PROTOCOL = {
    "paper": f"SE(2) path, a cubic spline through {_KNOTS} random points per dimension read at 7 equal "
    f"steps; the first point is the centre crop, the others uniform: positions within {_ROOM:g} of the room "
    f"that the unturned crop has on each side, rotation within +-{_TURN_DEG:g} degrees; redrawn until all 7 "
    "patches lie inside the image",
    "homography": f"BARF's: sl(3) generators from N(0, {_NOISE:g}^2), with +-0.2 on the first two entries of "
    "patches 1 to 4; redrawn until all 5 patches lie inside the image",
}


class Photo(NamedTuple):
    """An image and the size of its centre crop, half the shorter side."""

    rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    crop: int  # [px]

    @property
    def unit(self) -> float:
        """Pixels of one unit of length."""
        return max(self.rgb.shape[:2]) / 2

    @property
    def pixels(self) -> Float[np.ndarray, "hw 2"]:
        """Centres of all pixels, row by row."""
        height, width = self.rgb.shape[:2]
        x, y = np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / self.unit


class Task(NamedTuple):
    """Patches to align, and the ground truth; patch 0 is the centre crop itself."""

    H_image_patch: Float[np.ndarray, "n 3 3"]
    rgb: Float[np.ndarray, "n p 3"]  # colours at the points of `pixels`, in [0, 1]


def read_photo(path: Path) -> Photo:
    """Any image as RGB; a longer side of more than 640 px is reduced to that.

    DataError for a file that is no image or is smaller than 32 px.
    """
    with opened_image(path) as file:
        picture = file.convert("RGB")
    width, height = picture.size
    if min(width, height) < _LEAST_SIDE:
        raise DataError(
            f"{path}: expected an image of at least {_LEAST_SIDE} px a side, got {width}x{height}"
        )
    picture.thumbnail((_MOST_SIDE, _MOST_SIDE), Image.Resampling.BOX)
    if min(picture.size) < _LEAST_SIDE:
        raise DataError(f"{path}: expected sides less than 20 to 1, got {width}x{height}")
    return Photo(np.asarray(picture, np.float64) / 255, min(picture.size) // 2)


def draw(setup: str, photo: Photo, seed: int, motion: int) -> Task:
    """Motion number `motion` of a seed, in the named set-up (`PROTOCOL`): its warps and its patches."""
    generator = np.random.default_rng([seed, motion])
    for _ in range(_DRAWS):
        warps = _path(generator, photo) if setup == "paper" else homography(_generators(generator))
        if _inside(photo, warps):
            return Task(warps, cut(photo, warps))
    raise DataError(f"expected a motion within the image, got none in {_DRAWS} draws")  # a very long image


def pixels(photo: Photo) -> Float[np.ndarray, "p 2"]:
    """Centres of the crop's pixels, in its own frame, row by row."""
    line = (np.arange(photo.crop) + 0.5 - photo.crop / 2) / photo.unit
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def corners(photo: Photo) -> Float[np.ndarray, "4 2"]:
    """The crop's corners, in its own frame, going round."""
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * photo.crop / 2 / photo.unit


def apply(
    H_image_patch: Float[np.ndarray, "n 3 3"], xy: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, "n p 2"]:
    """Where points of the patches are in the image."""
    moved = np.einsum("nij,pj->npi", H_image_patch, np.column_stack([xy, np.ones(len(xy))]))
    return moved[..., :2] / moved[..., 2:]


def cut(photo: Photo, H_image_patch: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n p 3"]:
    """The colours that patches see at their `pixels`, bilinear."""
    height, width = photo.rgb.shape[:2]
    place = apply(H_image_patch, pixels(photo)) * photo.unit + [width / 2 - 0.5, height / 2 - 0.5]
    channels = [
        map_coordinates(c, place[..., ::-1].T, order=1, mode="nearest").T
        for c in np.moveaxis(photo.rgb, 2, 0)
    ]
    return np.stack(channels, axis=-1)


def corner_errors(
    photo: Photo, estimate: Float[np.ndarray, "n 3 3"], ground_truth: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, " n"]:
    """Mean distance [px] of each patch's four corners from where they should be in the image."""
    offset = apply(estimate, corners(photo)) - apply(ground_truth, corners(photo))
    return np.linalg.norm(offset, axis=-1).mean(axis=1) * photo.unit


def rigid(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], angle: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Warps that turn by `angle` [rad] (x towards y) and then move."""
    zero, one = np.zeros_like(x), np.ones_like(x)
    entries = [np.cos(angle), -np.sin(angle), x, np.sin(angle), np.cos(angle), y, zero, zero, one]
    return np.stack(entries, axis=-1).reshape(-1, 3, 3)


def homography(h: Float[np.ndarray, "n 8"]) -> Float[np.ndarray, "n 3 3"]:
    """The matrix exponential of BARF's basis of sl(3): h1 and h2 move, h3 to h6 are linear."""
    h1, h2, h3, h4, h5, h6, h7, h8 = h.T
    return scipy.linalg.expm(np.stack([h5, h3, h1, h4, -h5 - h6, h2, h7, h8, h6], axis=-1).reshape(-1, 3, 3))


def covered(photo: Photo, H_image_patch: Float[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, "h w"]:
    """Which pixels of the image at least one patch has seen."""
    height, width = photo.rgb.shape[:2]
    within = np.abs(apply(np.linalg.inv(H_image_patch), photo.pixels)) <= photo.crop / 2 / photo.unit
    return within.all(axis=-1).any(axis=0).reshape(height, width)


def _path(generator: np.random.Generator, photo: Photo) -> Float[np.ndarray, "n 3 3"]:
    height, width = photo.rgb.shape[:2]
    room = _ROOM * (np.array([width, height]) - photo.crop) / 2 / photo.unit
    points = generator.uniform(-1, 1, (_KNOTS, 3)) * [*room, np.radians(_TURN_DEG)]
    points[0] = 0
    path = CubicSpline(np.linspace(0, 1, _KNOTS), points)
    return rigid(*path(np.linspace(0, 1, PATCHES["paper"])).T)


def _generators(generator: np.random.Generator) -> Float[np.ndarray, "n 8"]:
    h = generator.normal(0, _NOISE, (PATCHES["homography"], 8))
    h[:, :2] += _OFFSETS
    h[0] = 0
    return h


def _inside(photo: Photo, warps: Float[np.ndarray, "n 3 3"]) -> bool:
    height, width = photo.rgb.shape[:2]
    return bool((np.abs(apply(warps, corners(photo))) * photo.unit <= [width / 2, height / 2]).all())

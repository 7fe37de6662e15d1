"""How brightly each photograph shows what others show too: exposure and white balance, colour by colour.

Logarithms of the colours of shared points are those of the points plus those of the photographs: least
squares in both, points eliminated, wrong and shiny ones given up (Cauchy's loss).
"""

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, UInt8

from jaxpose.geometry.camera import Camera, project_numpy
from jaxpose.structure.relative import SIGMA_OF_MEDIAN
from jaxpose.structure.tracks import Tracks

_BLUR = 1.5  # [px] of the colours at a point
_DARKEST, _BRIGHTEST = 8, 247  # counts between which a colour is neither noise nor cut off
_FEWEST = 12  # points of a photograph whose exposure is believed
_CUT_OFF = 254  # counts from which a colour may be any brighter one
_OUTLIER = 2.0  # sigmas
_ROUNDS = 20
_HELD = 1e-6  # of the usual weight, that holds photographs which nothing is known of


def relative_exposures(
    rgb: UInt8[np.ndarray, "n h w 3"], camera: Camera, tracks: Tracks
) -> Float[np.ndarray, "n 3"]:
    """How many times brighter each photograph is than all are on average.

    Args:
        rgb: Photographs (n, h, w, 3).
        camera: Of all of them.
        tracks: What they share, of `find_tracks`; those whose patches agree count.

    Returns:
        (n, 3), one for each colour; the geometric mean over photographs is 1, and so are those of photographs
        that share too little.
    """
    pixel = project_numpy(camera, np.concatenate([tracks.xy_cam, np.ones((len(tracks.view), 1))], axis=1))
    colour = np.zeros((len(pixel), 3), np.float32)
    for index, image in enumerate(rgb):
        rows = np.flatnonzero(tracks.view == index)
        if len(rows):
            smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR)
            x, y = pixel[rows, :1].astype(np.float32), pixel[rows, 1:].astype(np.float32)
            colour[rows] = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    counts = (colour.min(axis=1) > _DARKEST) & (colour.max(axis=1) < _BRIGHTEST) & tracks.aligned
    counts &= np.bincount(tracks.view[counts], minlength=tracks.views)[tracks.view] >= _FEWEST
    view, point, logs = tracks.view[counts], tracks.point[counts], np.log(colour[counts].astype(np.float64))
    if not len(view):
        return np.ones((len(rgb), 3))
    return np.exp(np.stack([_of_views(view, point, column, tracks) for column in logs.T], axis=1))


def _of_views(
    view: np.ndarray, point: np.ndarray, logs: Float[np.ndarray, " o"], tracks: Tracks
) -> Float[np.ndarray, " n"]:
    """The photographs' parts of the logarithms, whose mean is zero."""
    n, m = tracks.views, tracks.points
    weight, found = np.ones(len(logs)), np.zeros(n)
    for _ in range(_ROUNDS):
        of_point = np.bincount(point, weight, m)
        inverse = np.divide(1, of_point, out=np.zeros(m), where=of_point > 0)
        both = sp.csr_matrix((weight, (view, point)), (n, m))
        of_view = np.bincount(view, weight, n)
        normal = np.diag(of_view) - (both.multiply(inverse) @ both.T).toarray()
        normal += of_view.max() * (_HELD * np.eye(n) + 1 / n)  # the mean is zero
        down = np.bincount(view, weight * logs, n) - both @ (inverse * np.bincount(point, weight * logs, m))
        found = np.linalg.solve(normal, down)
        found -= found.mean()
        places = inverse * np.bincount(point, weight * (logs - found[view]), m)
        left = logs - found[view] - places[point]
        sigma = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(left))), 1e-6)
        weight = 1 / (1 + (left / (_OUTLIER * sigma)) ** 2)
    return found


def evenly_exposed(
    rgb: UInt8[np.ndarray, "n h w 3"], exposure: Float[np.ndarray, "n 3"]
) -> tuple[UInt8[np.ndarray, "n h w 3"], Bool[np.ndarray, "n h w"]]:
    """Photographs as if all had been exposed alike.

    Args:
        rgb: Photographs (n, h, w, 3).
        exposure: How much brighter each is, of `relative_exposures`.

    Returns:
        The photographs, and which of their pixels are known: not those that a longer exposure has cut off.
    """
    level = exposure[:, None, None]
    even = np.clip(np.round(rgb / level), 0, 255).astype(np.uint8)
    return even, ~np.any((rgb >= _CUT_OFF) & (even < _CUT_OFF), axis=-1)


def matching_exposure(
    image: Float[np.ndarray, "*p 3"], photograph: UInt8[np.ndarray, "*p 3"]
) -> Float[np.ndarray, "3"]:
    """How many times brighter a photograph is than an image of the same: least squares over its pixels.

    Args:
        image: Colours (..., 3) in [0, 1], all of the image or some of it.
        photograph: Of the same pixels (..., 3); those that are cut off do not count.

    Returns:
        (3,), one for each colour; 1 where nothing tells.
    """
    known = np.all(photograph < _CUT_OFF, axis=-1)
    seen, wanted = image[known], photograph[known] / 255
    squares = np.sum(seen**2, axis=0)
    return np.divide(np.sum(seen * wanted, axis=0), squares, out=np.ones(3), where=squares > 1e-6)

"""Lenses of photographs: the camera models of COLMAP, nerfstudio and instant-ngp.

`Camera` is a pinhole with OpenCV's distortion. Photographs through other lenses, or through several, are
brought to one pinhole camera (`pinhole_for`, `pixels.read_views`), for which a lens need only project.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxpose.errors import DataError
from jaxpose.files.colmap import ColmapCamera
from jaxpose.geometry.camera import Camera
from jaxpose.geometry.camera import resized as resized_camera

Kind = Literal["opencv", "radial4", "fisheye", "fov", "thin_prism_fisheye"]

# Of COLMAP's models: whether one focal length stands for both, the kind, and where its parameters go.
_COLMAP: dict[str, tuple[bool, Kind, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (True, "opencv", ()),
    "PINHOLE": (False, "opencv", ()),
    "SIMPLE_RADIAL": (True, "opencv", ("k1",)),
    "RADIAL": (True, "opencv", ("k1", "k2")),
    "OPENCV": (False, "opencv", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (False, "opencv", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (False, "fisheye", ("k1", "k2", "k3", "k4")),
    "SIMPLE_FISHEYE": (True, "fisheye", ()),
    "FISHEYE": (False, "fisheye", ()),
    "SIMPLE_RADIAL_FISHEYE": (True, "fisheye", ("k1",)),
    "RADIAL_FISHEYE": (True, "fisheye", ("k1", "k2")),
    "FOV": (False, "fov", ("omega",)),
    "THIN_PRISM_FISHEYE": (
        False, "thin_prism_fisheye", ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    ),
}  # fmt: skip
ORDER: dict[Kind, tuple[str, ...]] = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "radial4": ("k1", "k2", "p1", "p2", "k3", "k4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "fov": ("omega",),
    "thin_prism_fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
}
WIDEST_DEG = 60.0  # off the axis, that a pinhole camera is made for
_DIRECTIONS, _HALVINGS, _PROFILE = 64, 40, 2000


class Lens(NamedTuple):
    """A camera of any of the kinds; the centre of the first pixel is (0, 0).

    Attributes:
        kind: "opencv": its rational model; "radial4": nerfstudio's, with a fourth radial term; "fisheye":
            OpenCV's; "fov", "thin_prism_fisheye": COLMAP's.
        fx: Focal length along the rows [px].
        fy: Focal length along the columns [px].
        cx: Column of the principal point [px].
        cy: Row of the principal point [px].
        width: Columns of the image.
        height: Rows of the image.
        coefficients: In the order of the kind; none: all are 0.
    """

    kind: Kind
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    coefficients: tuple[float, ...] = ()


def lens(kind: Kind, pinhole: Sequence[float], size: tuple[int, int], coefficients: dict[str, float]) -> Lens:
    """A lens by the names of its coefficients; `pinhole` is fx, fy, cx, cy, `size` width and height."""
    values = tuple(float(coefficients.get(name, 0.0)) for name in ORDER[kind])
    plain = kind in ("opencv", "radial4") and not any(values)
    fx, fy, cx, cy = map(float, pinhole)
    return Lens("opencv" if plain else kind, fx, fy, cx, cy, *size, () if plain else values)


def from_colmap(camera: ColmapCamera, where: str) -> Lens:
    """The lens of a camera of COLMAP's; DataError, beginning with `where`, for a model that none covers."""
    if camera.model not in _COLMAP:
        raise DataError(
            f"{where}: expected a camera model of {', '.join(_COLMAP)}, got {camera.model}: undistort with "
            "colmap image_undistorter --image_path IMAGES --input_path MODEL --output_path OUT"
        )
    one_focal, kind, names = _COLMAP[camera.model]
    focal, rest = camera.parameters[: 1 if one_focal else 2], camera.parameters[1 if one_focal else 2 :]
    fx, fy, cx, cy = focal[0], focal[-1], rest[0] - 0.5, rest[1] - 0.5
    if not (fx > 0 and fy > 0):
        raise DataError(f"{where}: expected a focal length above 0 px, got {fx:g} and {fy:g}")
    named = dict(zip(names, rest[2:], strict=True))
    return lens(kind, (fx, fy, cx, cy), (camera.width, camera.height), named)


def from_camera(camera: Camera) -> Lens:
    """The same as a `Lens`."""
    named = dict(zip(ORDER["opencv"], camera.distortion, strict=False))
    return lens("opencv", camera[:4], (camera.width, camera.height), named)


def as_camera(seen: Lens) -> Camera | None:
    """The same as a `Camera`; None where it has no such model."""
    if seen.kind != "opencv" or any(seen.coefficients[5:]):
        return None
    return Camera(*seen[1:7], distortion=seen.coefficients[:5])


def resized(seen: Lens, width: int, height: int) -> Lens:
    """The lens of the image resized, the image's outer edge being kept."""
    return Lens(seen.kind, *resized_camera(Camera(*seen[1:7]), width, height)[:6], seen.coefficients)


def project(
    seen: Lens, xy: Float[np.ndarray, "*n 2"]
) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
    """Pixels of the rays (x, y, 1), and which of them are in the image."""
    radius = np.linalg.norm(xy, axis=-1)
    along = np.linspace(0, max(float(radius.max(initial=0)), 1e-6), _PROFILE)
    profile = _distort(seen, np.stack([along, np.zeros_like(along)], -1))[:, 0]
    # Beyond the first radius at which the image of a ray no longer moves outward, polynomials fold back.
    folded = np.flatnonzero(np.diff(profile) <= 0)
    limit = along[folded[0]] if len(folded) else math.inf
    pixel = _distort(seen, xy) * [seen.fx, seen.fy] + [seen.cx, seen.cy]
    inside = (pixel >= -0.5).all(-1) & (pixel <= [seen.width - 0.5, seen.height - 0.5]).all(-1)
    return pixel, inside & (radius <= limit)


def pinhole_for(lenses: Sequence[Lens]) -> tuple[Camera, bool]:
    """The pinhole camera that shows all that the lenses see up to 60 degrees, and whether one sees more.

    Its focal lengths are the medians of theirs, which keeps the resolution in the middle.
    """
    angle = np.linspace(0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    corners, beyond = [], False
    for seen in set(lenses):
        low, high = np.zeros(len(around)), np.full(len(around), math.tan(math.radians(WIDEST_DEG)))
        # Every image is seen from its principal point outward: halve the distance to its border.
        wide = project(seen, around * high[:, None])[1]
        beyond |= bool(wide.any())
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            inside = project(seen, around * middle[:, None])[1]
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        corners.append(around * np.where(wide, high, low)[:, None])
    least, most = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
    focal = np.median([[seen.fx, seen.fy] for seen in lenses], axis=0)
    width, height = (max(int(round(size)), 1) for size in (most - least) * focal)
    cx, cy = -0.5 - least * focal
    return Camera(float(focal[0]), float(focal[1]), float(cx), float(cy), width, height), beyond


def _distort(seen: Lens, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Where rays (x, y, 1) meet the plane of the image [focal lengths]."""
    if seen.kind == "fov":
        (omega,) = seen.coefficients
        radius = np.linalg.norm(xy, axis=-1, keepdims=True)
        straight = abs(omega) < 1e-8
        bent = radius if straight else np.arctan(2 * radius * math.tan(omega / 2)) / omega
        return xy * _ratio(bent, radius, 1.0 if straight else 2 * math.tan(omega / 2) / omega)
    if seen.kind in ("fisheye", "thin_prism_fisheye"):
        radius = np.linalg.norm(xy, axis=-1, keepdims=True)
        xy = xy * _ratio(np.arctan(radius), radius, 1.0)
    if not seen.coefficients:
        return xy
    r2 = (xy * xy).sum(-1, keepdims=True)
    c = dict(zip(ORDER[seen.kind], seen.coefficients, strict=True))
    if seen.kind == "fisheye":
        return xy * (1 + r2 * (c["k1"] + r2 * (c["k2"] + r2 * (c["k3"] + r2 * c["k4"]))))
    if seen.kind == "opencv":
        over = 1 + r2 * (c["k4"] + r2 * (c["k5"] + r2 * c["k6"]))
        radial = (1 + r2 * (c["k1"] + r2 * (c["k2"] + r2 * c["k3"]))) / over
    else:
        radial = 1 + r2 * (c["k1"] + r2 * (c["k2"] + r2 * (c["k3"] + r2 * c["k4"])))
    p1, p2 = c["p1"], c["p2"]
    twice_xy = 2 * xy[..., :1] * xy[..., 1:]
    tangential = np.concatenate(
        [p1 * twice_xy + p2 * (r2 + 2 * xy[..., :1] ** 2), p2 * twice_xy + p1 * (r2 + 2 * xy[..., 1:] ** 2)],
        axis=-1,
    )
    prism = np.array([c.get("sx1", 0.0), c.get("sy1", 0.0)]) * r2
    return xy * radial + tangential + prism


def _ratio(bent: np.ndarray, radius: np.ndarray, at_centre: float) -> np.ndarray:
    """bent / radius, with its limit at the centre."""
    return np.where(radius > 1e-9, bent / np.where(radius > 1e-9, radius, 1), at_centre)

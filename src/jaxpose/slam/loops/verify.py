"""Whether two keyframes show the same place, and where one camera was in the other's axes.

Features give the relative pose, then the depth of one image is registered to that of the other, beside what
the features said. A pair counts only where depth and colour of both images agree.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float

from jaxpose.datasets.types import Frame
from jaxpose.geometry.camera import Camera, project
from jaxpose.imu import AnyArray
from jaxpose.slam.config import TrackConfig
from jaxpose.slam.map.integrate import MapSample, seen_by
from jaxpose.slam.observation import back_project, depth_sigma, locate, sample_pixels, to_device
from jaxpose.slam.tracking.features import FeaturePose
from jaxpose.slam.tracking.predict import FIRST_FEATURE_SCALE
from jaxpose.slam.tracking.register import image_information, register

_PIXELS = 3000
_REACH = 0.3  # [m] from a plane that a point is pulled to
_AGREE = 3.0  # sigmas of both depths


class Comparison(NamedTuple):
    """Two images from a relative pose: how far their depths and their colours agree."""

    T_a_b: Float[AnyArray, "4 4"]
    information: Float[AnyArray, "6 6"]  # of the depths alone, over right increments [m, rad]
    overlap: Float[AnyArray, ""]  # share of b's depth that a has depth at
    agreement: Float[AnyArray, ""]  # share of that which is on a's surface
    conflict: Float[AnyArray, ""]  # share of that which is before it, where a has seen free space
    colour: Float[AnyArray, ""]  # correlation of grey values there


class Verified(NamedTuple):
    """The pose of camera b in axes of camera a, by features and depth, and what speaks for it."""

    T_a_b: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]  # over right increments [m, rad]
    features: FeaturePose
    compared: Comparison


def verify(a: Frame, b: Frame, seen: FeaturePose, camera: Camera) -> Verified:
    """Register the depth of b to that of a, from the pose that features have found."""
    covariance = FIRST_FEATURE_SCALE * seen.covariance
    as_float = lambda x: jnp.asarray(x, jnp.float32)
    compared = jax.device_get(
        _compare(camera)(to_device(a), to_device(b), as_float(seen.T_world_cam), as_float(covariance))
    )
    information = np.asarray(compared.information, np.float64) + np.linalg.inv(covariance)
    return Verified(np.asarray(compared.T_a_b, np.float64), information, seen, compared)


@lru_cache(maxsize=2)
def _compare(camera: Camera) -> Callable[..., Comparison]:
    config = TrackConfig(pixels=_PIXELS)

    @jax.jit
    def compare(image_a, image_b, T_a_b, covariance):
        at = seen_by(image_a, camera)
        rgb_a = image_a.rgb.astype(jnp.float32) / 255
        pixels = sample_pixels(jax.random.key(0), image_b, camera, _PIXELS, edge=4)

        def sample(point):
            seen = at(locate(camera, point))
            distance, (column, row) = seen.distance(point), project(camera, point)
            near = (seen.weight > 0) & (jnp.abs(distance) < _REACH)
            colour = [map_coordinates(rgb_a[..., k], [row, column], 1, mode="nearest") for k in range(3)]
            return MapSample(distance, jnp.stack(colour), near.astype(distance.dtype))

        found = register(sample, T_a_b, T_a_b, covariance, pixels, config)
        points = back_project(pixels, found.T_world_cam)
        seen = at(locate(camera, points))
        there = (pixels.depth > 0) & (seen.weight > 0)
        distance = seen.distance(points)
        sigma = jnp.hypot(depth_sigma(pixels.depth), depth_sigma(points[:, 2]))
        agree = there & (jnp.abs(distance) < _AGREE * sigma)
        before = there & (distance > _AGREE * sigma)
        share = lambda x, of: jnp.mean(x) / jnp.maximum(jnp.mean(of), 1 / of.size)
        return Comparison(
            found.T_world_cam,
            image_information(found),
            share(there, pixels.depth > 0),
            share(agree, there),
            share(before, there),
            _correlation(seen.rgb.mean(axis=-1), pixels.rgb.mean(axis=-1), agree),
        )

    return compare


def _correlation(a: Float[Array, " n"], b: Float[Array, " n"], counts: Array) -> Float[Array, ""]:
    weight = counts.astype(a.dtype)
    weight /= jnp.maximum(jnp.sum(weight), 1)
    a, b = (x - jnp.sum(weight * x) for x in (a, b))
    spread = jnp.sqrt(jnp.sum(weight * a**2) * jnp.sum(weight * b**2))
    return jnp.sum(weight * a * b) / jnp.maximum(spread, 1e-6)

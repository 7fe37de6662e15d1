"""An object and the photographs of a camera that circles it, made on the fly: poses and timestamps are exact.

It stands in for the orbit around lego of Ma et al. 2024: the same path, another object.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.datasets.types import Photographs
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera, unproject

DIAMETER = 8.0  # of the circle [scene units]; the object lies within 1.7 of its centre
FIELD_OF_VIEW_DEG = 40.0
SECONDS = 10.0  # one turn
NEAR, FAR = 2.0, 6.5  # z-depths between which the object lies from every pose
_SIZE, _RADIUS = 1.1, 1.7
_HELD_OUT = 10  # views
_SAMPLES = 2  # per pixel and axis
_STEPS = 30  # of sphere tracing
_INSTANTS = 9  # of an exposure


def orbit(
    views: int = 100, width: int = 128, seed: int = 0, *, line_delay_s: float = 0.0, exposure_s: float = 0.0
) -> tuple[Photographs, Photographs]:
    """Photographs, white behind, along one turn of a circle that also moves in z.

    Args:
        views: To train on; ten more are held out, halfway in time between neighbours.
        width: Of the square images [px].
        seed: Turns and tints the texture; the path is always the same.
        line_delay_s: From one row to the next [s], of the photographs to train on. A photograph's time is
            that of its middle row.
        exposure_s: Of each row of them [s], about the row's time.

    Returns:
        Photographs to train on, and those held out.

    Raises:
        ValueError: For fewer than 2 views or 8 pixels.
    """
    if views < 2 or width < 8:
        raise ValueError(f"orbit: expected at least 2 views of 8 pixels, got {views} of {width}")
    step = SECONDS / views
    train = step * np.arange(views)
    held_out = step * (np.unique(np.linspace(0, views - 2, min(_HELD_OUT, views - 1)).round()) + 0.5)
    lens, texture = camera(width), paint(seed)
    to_bytes = lambda rgb: jnp.round(255 * rgb).astype(jnp.uint8)
    photograph = jax.jit(lambda T: to_bytes(image(lens, T, texture)))
    exposed = jax.jit(lambda T: to_bytes(exposed_rows(lens, T, texture)))
    phases = np.array([0.0]) if exposure_s == 0 else (np.arange(_INSTANTS) + 0.5) / _INSTANTS - 0.5
    row = np.arange(width) - (width - 1) / 2
    after = line_delay_s * row[:, None] + exposure_s * phases  # [s] the photograph's time

    def shots(t, part):
        T_world_cam = orbit_poses(t)
        if part == "train" and (line_delay_s or exposure_s):
            T_of_rows = (orbit_poses((moment + after).ravel()).reshape(*after.shape, 4, 4) for moment in t)
            rgb = [np.asarray(exposed(jnp.asarray(T, jnp.float32))) for T in T_of_rows]
        else:
            rgb = [np.asarray(photograph(jnp.asarray(T, jnp.float32))) for T in T_world_cam]
        files = tuple(f"{part}/{index:03d}.png" for index in range(len(t)))
        notes = (f"synthetic orbit, {len(t)} views of {width} x {width} px, exact poses and timestamps",)
        return Photographs(
            f"orbit {part}", lens, t, np.stack(rgb), T_world_cam, NEAR, FAR, "depth", files, notes
        )

    return shots(train, "train"), shots(held_out, "held_out")


def camera(width: int) -> Camera:
    """The camera of all views.

    Args:
        width: Of the square images [px].

    Returns:
        A pinhole.
    """
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2))
    return Camera(focal, focal, (width - 1) / 2, (width - 1) / 2, width, width)


def paint(seed: int) -> Float[Array, "6"]:
    """What turns and tints the object's texture.

    Args:
        seed: Makes it.

    Returns:
        (6,), for `image`.
    """
    return jnp.asarray(np.random.default_rng(seed).uniform(0, 2 * math.pi, 6), jnp.float32)


def orbit_poses(t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """Camera-to-world poses on the circle, up and down in z, looking at the object's centre.

    Args:
        t: Times (n,) [s].

    Returns:
        (n, 4, 4).
    """
    angle = 2 * math.pi * t / SECONDS
    centre = np.stack(
        [
            DIAMETER / 2 * np.cos(angle),
            DIAMETER / 2 * np.sin(angle),
            1.2 + 0.9 * np.sin(2 * angle) + 0.3 * np.cos(3 * angle),
        ],
        axis=-1,
    )
    forward = -centre / np.linalg.norm(centre, axis=-1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return rigid.make(np.stack([right, np.cross(forward, right), forward], axis=-1), centre)


def image(
    camera: Camera, T_world_cam: Float[Array, "4 4"], paint: Float[Array, "6"], background: float = 1.0
) -> Float[Array, "h w 3"]:
    """The object from a pose; every pixel is the mean over a grid of rays in it.

    Args:
        camera: Of the image.
        T_world_cam: (4, 4).
        paint: Of `paint`.
        background: Grey behind the object, in [0, 1].

    Returns:
        Colours (h, w, 3) in [0, 1].
    """
    offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    x = (np.arange(camera.width)[:, None] + offsets).ravel()
    y = (np.arange(camera.height)[:, None] + offsets).ravel()
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    direction = unproject(camera, jnp.asarray(pixels, jnp.float32))
    direction = jnp.matmul(direction, T_world_cam[:3, :3].T, precision="highest")
    direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
    rgb = jax.vmap(partial(_trace, paint, background, T_world_cam[:3, 3]))(direction)
    return rgb.reshape(camera.height, _SAMPLES, camera.width, _SAMPLES, 3).mean((1, 3))


def exposed_rows(
    camera: Camera, T_world_cam: Float[Array, "h k 4 4"], paint: Float[Array, "6"]
) -> Float[Array, "h w 3"]:
    """The object, each row the mean over poses of its own.

    Args:
        camera: Of the image.
        T_world_cam: (h, k, 4, 4).
        paint: Of `paint`.

    Returns:
        Colours (h, w, 3) in [0, 1].
    """

    def row(item):
        number, poses = item
        strip = camera._replace(cy=camera.cy - number, height=1)
        return jnp.mean(jax.vmap(lambda T: image(strip, T, paint))(poses), axis=0)[0]

    return jax.lax.map(row, (jnp.arange(camera.height, dtype=T_world_cam.dtype), T_world_cam))


def _trace(
    paint: Float[Array, "6"], background: float, origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Colour of what a ray of unit length meets."""
    start = -jnp.vdot(origin, direction) - _RADIUS  # enters the ball around the object

    def march(_, depth):
        return depth + distance(origin + depth * direction)

    depth = jax.lax.fori_loop(0, _STEPS, march, start)
    point = origin + depth * direction
    normal = jax.grad(distance)(point)
    light = jnp.asarray([0.4, -0.5, 0.77])
    shade = 0.45 + 0.55 * jnp.maximum(jnp.vdot(normal, light) / (jnp.linalg.norm(normal) + 1e-6), 0)
    hit = (distance(point) < 0.02) & (depth < start + 2 * _RADIUS)
    return jnp.where(hit, shade * _albedo(paint, point), background)


def distance(point: Float[Array, "3"]) -> Float[Array, ""]:
    """Signed distance (a lower bound of it) to the object: cup on a slab, ring, post and three balls.

    Args:
        point: (3,) in the world.

    Returns:
        Negative inside.
    """
    point = point / _SIZE
    x, y, z = point
    slab = _box(point - jnp.asarray([0, 0, -0.75]), jnp.asarray([0.95, 0.7, 0.12])) - 0.04
    cup = _ball(point, [-0.2, 0.0, -0.05], 0.62)
    cup = jnp.maximum(cup, -_ball(point, [-0.2, 0.0, 0.12], 0.52))  # hollow
    ring = _length(_length(x - 0.45, z - 0.15) - 0.42, y) - 0.11
    post = jnp.maximum(_length(x - 0.62, y - 0.38) - 0.14, jnp.abs(z - 0.05) - 0.85)
    balls = jnp.minimum(_ball(point, [-0.2, 0.05, 0.1], 0.24), _ball(point, [-0.75, -0.45, -0.43], 0.2))
    balls = jnp.minimum(balls, _ball(point, [0.35, -0.45, -0.38], 0.25))
    return _SIZE * jnp.minimum(jnp.minimum(jnp.minimum(slab, cup), jnp.minimum(ring, post)), balls)


def _ball(point: Float[Array, "3"], centre: list[float], radius: float) -> Float[Array, ""]:
    return _length(*(point - jnp.asarray(centre))) - radius


def _box(point: Float[Array, "3"], half: Float[Array, "3"]) -> Float[Array, ""]:
    outside = jnp.abs(point) - half
    # Not `jnp.max`: its gradient looks for the entry equal to the maximum, which a fused computation, rounded
    # another way, may fail to find; the result is NaN.
    largest = jnp.maximum(jnp.maximum(outside[0], outside[1]), outside[2])
    return _length(*jnp.maximum(outside, 0)) + jnp.minimum(largest, 0)


def _length(*sides: Float[Array, ""]) -> Float[Array, ""]:
    """Length of a vector, differentiable at zero."""
    return jnp.sqrt(sum(side * side for side in sides) + 1e-12)


def _albedo(paint: Float[Array, "6"], point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Slow tints under irregular patches and stripes a few pixels wide; nothing in it repeats."""
    tint = 0.55 + 0.3 * jnp.sin(jnp.asarray([2.1, 2.7, 3.3]) * jnp.roll(point, 1) + paint[:3])
    bent = 9 * point + 2.5 * jnp.sin(2.3 * jnp.roll(point, 1) + paint[3:]) + paint[3:]
    patches = jnp.tanh(5 * jnp.prod(jnp.sin(bent)))
    stripes = jnp.sin(21 * (point[2] + 0.5 * point[0]) + 3 * jnp.sin(2 * point[1]) + paint[0])
    hue = jnp.sin(3.7 * jnp.roll(point, 2) + 2 * paint[:3])
    return jnp.clip(tint + 0.25 * patches * (0.5 + 0.5 * hue) + 0.08 * stripes, 0, 1)

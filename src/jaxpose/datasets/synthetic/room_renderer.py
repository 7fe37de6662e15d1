"""A recording of a furnished room made on the fly.

Colour, depth, ground truth and IMU along one analytic path.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxpose.datasets.synthetic import floor, hand_held
from jaxpose.datasets.synthetic.atlas import Atlas, bake, gather, look_up
from jaxpose.datasets.synthetic.depth_sensors import RANGES, Sensor, measured_depth
from jaxpose.datasets.synthetic.furniture import LIGHTS, Extent, furnish
from jaxpose.datasets.synthetic.shapes import Shapes, cast, locate, within_cone
from jaxpose.datasets.synthetic.trajectory import Motion, by_hand, recorded
from jaxpose.datasets.types import Frame, Recording
from jaxpose.geometry.camera import Camera, unproject
from jaxpose.imu import ADIS16448, GRAVITY_WORLD, ImuNoise

_MOST_SAMPLES = 1e8  # of a sensor over the walk


@dataclass(frozen=True)
class RoomConfig:
    """Settings of `room`; every random choice follows from `seed`."""

    # One room, or a floor of four rooms and a corridor: once around it is 36 m, 72 s at speed 1.
    scene: Literal["room", "floor"] = "room"
    duration_s: float = 12.0  # [s] of the walk
    rate_hz: float = 5.0  # [Hz] of the frames
    imu_rate_hz: float = 200.0  # [Hz] of the IMU
    width: int = 320  # [px] of the images
    height: int = 240  # [px] of the images
    seed: int = 0  # of the room, the walk and the noise of its sensors
    speed: float = 1.0  # 1 walks at about 0.5 m/s and turns by 20 to 50 deg/s
    # What measures depth. axial: the noise that tracking assumes; the others differ from it: disparities in
    # steps, two cameras, the phase of light, or points of a coarser camera that are carried over to colour.
    sensor: Sensor = "axial"
    depth_noise: float = 1.0  # times the sensor's random noise; 0 with axial is exact depth
    holes: bool = True  # no depth on what defeats the sensor: shadows, grazing, dark or plain surfaces
    line_delay_us: float = 0.0  # [us] from row to row of a rolling shutter; a frame's time is its first row's
    imu_noise: ImuNoise = ADIS16448
    gravity_world: tuple[float, float, float] = GRAVITY_WORLD  # [m/s^2] z is up
    # A EuRoC sequence whose recorded motion and IMU take the place of the walk and of `imu_*`.
    along: Path | None = None

    def __post_init__(self):
        for name in ("duration_s", "rate_hz", "imu_rate_hz", "width", "height", "speed"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"RoomConfig.{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("seed", "depth_noise", "line_delay_us"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"RoomConfig.{name}: expected zero or more, got {getattr(self, name)}")
        if self.line_delay_us > 1000:
            raise ValueError(f"RoomConfig.line_delay_us: expected at most 1000 us, got {self.line_delay_us}")
        if self.scene not in ("room", "floor"):
            raise ValueError(f"RoomConfig.scene: expected one of room, floor, got {self.scene}")
        if self.sensor not in RANGES:
            raise ValueError(f"RoomConfig.sensor: expected one of {', '.join(RANGES)}, got {self.sensor}")
        for rate in ("rate_hz", "imu_rate_hz"):
            if not self.duration_s * getattr(self, rate) <= _MOST_SAMPLES:
                got = f"{self.duration_s:g} s at {getattr(self, rate):g} Hz"
                raise ValueError(f"RoomConfig.{rate}: expected up to {_MOST_SAMPLES:g} samples, got {got}")
        if self.duration_s * self.rate_hz < 1:
            raise ValueError(f"RoomConfig: expected two frames, got {self.duration_s} s at {self.rate_hz} Hz")


def room(config: RoomConfig = RoomConfig()) -> Recording:
    """A walk through a furnished room, 5 x 4 x 2.6 m; frames are rendered when they are read.

    The world is z-up with its origin on the floor; the body is the IMU, its axes forwards, left, up. With
    `config.along` it is a recorded motion with its readings (`trajectory.recorded`), the room as large as
    needed.

    Args:
        config: Every random choice follows from its seed.

    Returns:
        The recording, with ground truth and IMU.
    """
    drive = _drive(config)
    shapes, atlas = scenery(config.seed, drive.room, config.scene)
    focal = 585 / 640 * config.width  # Kinect's angle of view
    centre = (config.width - 1) / 2, (config.height - 1) / 2
    camera = Camera(focal, focal, *centre, config.width, config.height)
    T_world_cam = drive.T_world_body @ drive.T_body_cam
    half_rows = np.arange(2 * config.height + 1) / 2 - 0.5  # their edges and centres

    @lru_cache(maxsize=128)
    def read(i: int) -> Frame:
        at = T_world_cam[i]
        if config.line_delay_us > 0:
            at = (
                drive.pose(drive.t[i] + np.maximum(half_rows, 0) * config.line_delay_us / 1e6)
                @ drive.T_body_cam
            )
        rgb, depth, cosine = jax.device_get(render(camera, shapes, atlas, np.float32(at)))
        depth = measured_depth(
            config.sensor, depth, rgb, cosine, camera, np.random.default_rng([config.seed, i]),
            noise=config.depth_noise, holes=config.holes,
        )  # fmt: skip
        depth.setflags(write=False)  # the next reader gets the same array
        return Frame(rgb, depth)

    return Recording(
        drive.name, camera, drive.t, read, T_world_cam, drive.imu, drive.T_body_cam,
        np.asarray(config.gravity_world, float), drive.notes,
    )  # fmt: skip


@lru_cache(maxsize=2)
def scenery(seed: int, size: Extent, scene: str = "room") -> tuple[Shapes, Atlas]:
    """What stands in a room of this size, or on the floor, with paint and light: seconds of work."""
    palette, brush, _ = np.random.default_rng(seed).spawn(3)
    pieces = floor.furnish(palette) if scene == "floor" else furnish(palette, size)
    ordered, shapes = gather(pieces)
    return shapes, bake(ordered, shapes, brush, floor.LIGHTS if scene == "floor" else LIGHTS)


def _drive(config: RoomConfig) -> Motion:
    if config.along is not None:
        return recorded(config.along, config.duration_s, config.rate_hz)
    t = np.arange(int(np.floor(config.duration_s * config.rate_hz + 1e-9)) + 1) / config.rate_hz
    *_, path = np.random.default_rng(config.seed).spawn(3)
    walk = hand_held.draw(path, config.speed)
    course = floor.tour if config.scene == "floor" else hand_held.pose
    noise, gravity = config.imu_noise, config.gravity_world
    return by_hand(walk, t, config.imu_rate_hz, noise, gravity, course, seed=config.seed)


@partial(jax.jit, static_argnums=0)
def render(
    camera: Camera,
    shapes: Shapes,
    atlas: Atlas,
    T_world_cam: Float[Array, "4 4"] | Float[Array, "k 4 4"],
) -> tuple[UInt8[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Colour, depth [m] at pixel centres, and the cosine of incidence there.

    Colour mixes the centre of a pixel (one half) with its four corners, which neighbours share. The pose is
    the image's, or one for every edge and centre of its rows.
    """
    h, w = camera.height, camera.width
    coordinates = lambda n, first: jnp.arange(n, dtype=jnp.float32) + jnp.float32(first)
    centres = jnp.stack(jnp.meshgrid(coordinates(w, 0), coordinates(h, 0)), -1).reshape(-1, 2)
    corners = jnp.stack(jnp.meshgrid(coordinates(w + 1, -0.5), coordinates(h + 1, -0.5)), -1).reshape(-1, 2)
    pixels = jnp.concatenate([centres, corners])
    x, y, z = unproject(camera, pixels).T
    T = T_world_cam.reshape(-1, 4, 4)
    of_ray = T[jnp.minimum(2 * pixels[:, 1] + 1, len(T) - 1).astype(int)] if len(T) > 1 else T
    right, down, forwards, eye = jnp.moveaxis(of_ray[:, :3], 0, -1).swapaxes(0, 1)
    ray = tuple(right[k] * x + down[k] * y + forwards[k] * z for k in range(3))
    origin = tuple(jnp.broadcast_to(eye, (3, eye.shape[1])))

    widest = 1 / jnp.sqrt(jnp.max(x * x + y * y) + 1)
    some = T[jnp.array([0, len(T) // 2, len(T) - 1])]
    seen = jax.vmap(lambda T: within_cone(shapes, T[:3, 3], T[:3, 2], widest))(some).any(axis=0)
    hit = locate(shapes, origin, ray, *cast(shapes, origin, ray, seen=seen))
    # the spacing of samples on the surface; stretched by slant, though not by as much as along the slant
    footprint = 0.7 / camera.fx * hit.distance / jnp.sqrt(jnp.maximum(hit.cosine, 0.05))
    colour = look_up(atlas, hit, footprint)
    middle, corner = colour[:, : h * w].reshape(3, h, w), colour[:, h * w :].reshape(3, h + 1, w + 1)
    around = corner[:, :-1, :-1] + corner[:, 1:, :-1] + corner[:, :-1, 1:] + corner[:, 1:, 1:]
    middle = jnp.moveaxis(middle / 2 + around / 8, 0, -1)
    rgb = jnp.round(middle).astype(jnp.uint8)
    return rgb, hit.distance[: h * w].reshape(h, w), hit.cosine[: h * w].reshape(h, w)

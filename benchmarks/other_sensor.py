"""A recording of a sensor that is not the synthetic room's own, along a hand-held motion that was recorded.

The synthetic room is rendered at 640 x 480 along the poses of a TUM file (such as the ground truth of
freiburg1_xyz) and written as a plain folder for `python -m jaxpose.experiments.rgbd_slam --data DIR`. Colour
is blurred by the motion, exposed differently as time goes on, stored as JPEG and shifted by some pixels
against depth; depth comes from disparities in steps, with noise that is the same over neighbouring pixels,
and ends.

    python benchmarks/other_sensor.py --help
"""

import json
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import tyro
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

from jaxpose.datasets.synthetic.depth_sensors import BASELINE, projector_holes
from jaxpose.datasets.synthetic.furniture import SIZE
from jaxpose.datasets.synthetic.room_renderer import render, scenery
from jaxpose.files import trajectories
from jaxpose.geometry.camera import Camera
from jaxpose.geometry.rigid import rotation_angle
from jaxpose.imu.simulation import Interpolant, interpolant

FOCAL = 585.0  # [px]
DISPARITY = 580 * BASELINE  # [px m]


@dataclass(frozen=True)
class Config:
    """The motion, and what the sensor makes of it."""

    trajectory: Path  # TUM: t x y z qx qy qz qw
    out: Path
    start_s: float = 0.0
    duration_s: float = 25.0
    rate_hz: float = 5.0
    seed: int = 1  # of the room and the noise
    exposure_s: float = 0.015  # of colour, over which it is blurred
    brighter: float = 0.2  # natural logarithm of the gain, at most, over a period of 7.3 s
    shift: tuple[int, int] = (2, 1)  # [px] of colour against depth
    disparity_noise: float = 0.12  # [px]
    disparity_step: float = 0.125  # [px]
    farthest: float = 4.5  # [m]


def moved_to_the_room(trajectory: trajectories.Trajectory) -> Interpolant:
    """The path over time since the first timestamp, its middle above that of the floor."""
    T = trajectory.T.copy()
    T[:, :2, 3] -= (T[:, :2, 3].min(axis=0) + T[:, :2, 3].max(axis=0)) / 2
    return interpolant(trajectory.t - trajectory.t[0], T)


def measured(depth: np.ndarray, rng: np.random.Generator, config: Config) -> np.ndarray:
    """Depth [m] as it is found from disparities, 0 beyond the farthest."""
    noise = gaussian_filter(rng.standard_normal(depth.shape), 1.5)
    disparity = DISPARITY / depth + config.disparity_noise * noise / noise.std()
    found = DISPARITY / (np.round(disparity / config.disparity_step) * config.disparity_step)
    return np.where(found > config.farthest, 0, found)


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    path = moved_to_the_room(trajectories.read_tum(config.trajectory, first_of_repeated=True))
    camera = Camera(FOCAL, FOCAL, 318.6, 241.3, 640, 480)
    shapes, atlas = scenery(config.seed, SIZE)
    seen = lambda T: [np.asarray(x) for x in render(camera, shapes, atlas, np.float32(T))]
    for kind in ("color", "depth"):
        (config.out / kind).mkdir(parents=True, exist_ok=True)
    last = min(config.duration_s, path.last - config.start_s - 2 * config.exposure_s)
    timestamps = (
        config.start_s + config.exposure_s + np.arange(int(last * config.rate_hz) + 1) / config.rate_hz
    )
    poses = path.pose(timestamps)
    for i, t in enumerate(tqdm(timestamps)):
        _, depth, cosine = seen(poses[i])
        while_open = path.pose(t + config.exposure_s * np.linspace(-0.5, 0.5, 5))
        colour = np.mean([seen(T)[0].astype(np.float64) for T in while_open], axis=0)
        colour = np.roll(colour, config.shift, axis=(1, 0))
        colour = colour * np.exp(config.brighter * np.sin(2 * np.pi * t / 7.3))
        noise, holes = np.random.default_rng([config.seed, i]).spawn(2)
        found = np.where(projector_holes(depth, cosine, camera, holes), 0, measured(depth, noise, config))
        iio.imwrite(config.out / f"color/{i:05d}.jpg", np.clip(colour, 0, 255).astype(np.uint8), quality=90)
        iio.imwrite(config.out / f"depth/{i:05d}.png", np.round(1000 * found).astype(np.uint16))
    np.savetxt(config.out / "poses.txt", poses.reshape(-1, 16))
    np.savetxt(config.out / "times.txt", timestamps)
    pinhole = dict(zip(camera._fields[:6], camera[:6], strict=True))
    (config.out / "intrinsics.json").write_text(json.dumps({**pinhole, "depth_scale": 1000}))
    metres = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    degrees = np.degrees(rotation_angle(poses[:-1, :3, :3], poses[1:, :3, :3]))
    print(
        f"wrote {len(timestamps)} frames to {config.out}; from one to the next "
        f"{100 * np.median(metres):.1f} cm and {np.median(degrees):.1f} deg (medians)"
    )


if __name__ == "__main__":
    main()

"""What the depth sensors of the synthetic room make of exact depth: a table, and pictures with `--out`.

python benchmarks/depth_sensors.py --out experiments/figures/depth_sensors.png
"""

import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.synthetic.depth_sensors import RANGES, Sensor, measured_depth
from jaxpose.geometry.camera import Camera

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CAMERA = Camera(585.0, 585.0, 319.5, 239.5, 640, 480)
DISTANCES = (1.0, 2.0, 4.0)  # [m]
REPEATS = 10


@dataclass(frozen=True)
class Config:
    """Which frames of the room, and where the picture goes."""

    frames: tuple[int, ...] = (0, 12, 25, 37, 50)  # of the default walk
    out: Path | None = None  # a PNG of the last frame but two


def wall(sensor: Sensor, distance: float) -> tuple[float, float]:
    """Standard deviation of depth [mm] on textured grey walls near a distance, and milliseconds a frame.

    Walls, as rounding to steps of disparity may hit or miss a single one.
    """
    grey = 110 + 28 * (np.indices((480, 640)).sum(0) // 2 % 2)
    rgb = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    ones, squares, seconds = np.ones((480, 640), np.float32), [], []
    for k, z in enumerate(np.linspace(0.97, 1.03, REPEATS) * distance):
        start = time.process_time()
        found = measured_depth(sensor, np.float32(z) * ones, rgb, ones, CAMERA, np.random.default_rng(k))
        seconds.append(time.process_time() - start)
        squares.append(np.mean((found[found > 0] - z) ** 2))
    return 1000 * float(np.sqrt(np.mean(squares))), 1000 * float(np.median(seconds))


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    seen = {name: room(RoomConfig(width=640, height=480, sensor=name)) for name in RANGES}
    exact = room(RoomConfig(width=640, height=480, depth_noise=0, holes=False))
    print("| sensor | 1 m | 2 m | 4 m | room: no depth | median error | beyond 5 cm | ms |\n|" + "---|" * 8)
    for name, recording in seen.items():
        errors, cost = zip(*(wall(name, z) for z in DISTANCES), strict=True)
        true, found = (np.stack([r.read(i).depth for i in config.frames]) for r in (exact, recording))
        error = 1000 * np.abs(found - true)[found > 0]
        print(
            f"| `{name}` | {' | '.join(f'{e:.1f}' for e in errors)} | {100 * np.mean(found == 0):.1f}% "
            f"| {np.median(error):.1f} | {100 * np.mean(error > 50):.1f}% | {np.median(cost):.0f} |"
        )
    if config.out is not None:
        draw(config.out, exact.read(config.frames[2]), seen, config.frames[2])


def draw(file: Path, exact, seen, frame: int) -> None:
    """Colour, then each sensor's depth above its error."""
    figure, axes = plt.subplots(2, 6, figsize=(15, 4.2), layout="constrained")
    axes[0, 0].imshow(exact.rgb)
    depth = axes[1, 0].imshow(exact.depth, cmap="turbo", vmin=0.5, vmax=4.5)
    axes[0, 0].set_title("colour, exact depth")
    for column, (name, recording) in enumerate(seen.items(), start=1):
        found = recording.read(frame).depth
        missing = found == 0
        axes[0, column].set_title(name)
        axes[0, column].imshow(np.ma.masked_where(missing, found), cmap="turbo", vmin=0.5, vmax=4.5)
        off = np.ma.masked_where(missing, 1000 * (found - exact.depth))
        error = axes[1, column].imshow(off, cmap="RdBu", vmin=-50, vmax=50)
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[], facecolor="black")
    figure.colorbar(depth, ax=axes[0, -1], label="depth [m]")
    figure.colorbar(error, ax=axes[1, -1], label="error [mm]")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80)


if __name__ == "__main__":
    main()

"""How near the meshes of runs are to the true surface of the synthetic room: accuracy, completeness, F-score.

jaxpose slam --imu none --room.scene floor --rate-hz 10 --out RUN
python benchmarks/mesh_score.py --runs RUN --room.scene floor --room.rate-hz 10

Accuracy and precision are of the distance of a mesh's corners to the solids of the room, in closed form.
Completeness and recall are of the distance to the nearest corner (these are a voxel apart) of what the sensor
of the run has measured, where it truly is. Meshes are moved by the alignment of their trajectories.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.synthetic.furniture import SIZE
from jaxpose.datasets.synthetic.room_renderer import scenery
from jaxpose.datasets.synthetic.shapes import Shapes
from jaxpose.evaluation import trajectory_error
from jaxpose.files import trajectories
from jaxpose.files.ply import read_points
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import pixel_grid, unproject_numpy

NEAR = (0.02, 0.05)  # [m]
APART = 0.02  # [m] true points are thinned to


@dataclass(frozen=True)
class Config:
    """Which runs, and the room that they went through."""

    runs: tuple[Path, ...]
    room: RoomConfig = RoomConfig()
    every: int = 5  # frames of which one is rendered for the true surface


def true_surface(config: RoomConfig, every: int) -> Float[np.ndarray, "n 3"]:
    """Points in the world [m] that the sensor has measured, where they truly are."""
    seen, exact = room(config), room(replace(config, sensor="axial", depth_noise=0, holes=False))
    assert exact.T_world_cam is not None
    rays = unproject_numpy(exact.camera, pixel_grid(exact.camera))
    found = {}
    for i in range(0, len(exact.t), every):
        depth, measured = exact.read(i).depth, seen.read(i).depth > 0
        points = rigid.apply(exact.T_world_cam[i], (rays * depth[..., None])[measured & (depth > 0)])
        found |= dict(zip(map(tuple, np.floor(points / APART).astype(int).tolist()), points, strict=True))
    return np.stack(list(found.values()))


def to_solids(points: Float[np.ndarray, "n 3"], shapes: Shapes) -> Float[np.ndarray, " n"]:
    """Distances [m] of points to the nearest surface."""
    nearest = np.full(len(points), np.inf)
    for kind, solids in shapes._asdict().items():
        for centre, half, (cosine, sine) in zip(*(np.asarray(x, np.float64) for x in solids), strict=True):
            x, y, z = (points - centre).T
            off = np.abs(np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1))
            if kind == "cylinders":
                off, half = np.stack([np.hypot(off[:, 0], off[:, 1]), off[:, 2]], axis=-1), half[1:]
            elif kind == "spheres":
                off, half = np.linalg.norm(off, axis=1, keepdims=True), half[:1]
            beyond = off - half
            outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
            nearest = np.minimum(nearest, np.where(outside > 0, outside, -beyond.max(axis=1)))
    return nearest


def scores(
    points: Float[np.ndarray, "n 3"],
    true: Float[np.ndarray, "m 3"],
    shapes: Shapes,
    T_world_cam: Float[np.ndarray, "k 4 4"],
    T_world_true: Float[np.ndarray, "k 4 4"],
) -> str:
    """A row of the table."""
    ate = trajectory_error.ate(T_world_cam, T_world_true)
    points = ate.alignment.apply(points)
    there, back = to_solids(points, shapes), cKDTree(points).query(true)[0]
    row = f"| {100 * ate.rmse:.2f} cm | {100 * there.mean():.2f} cm | {100 * back.mean():.2f} cm "
    for near in NEAR:
        precision, recall = np.mean(there < near), np.mean(back < near)
        row += f"| {2 * precision * recall / (precision + recall):.3f} ({precision:.3f}, {recall:.3f}) "
    return row + "|"


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    true, (shapes, _) = (
        true_surface(config.room, config.every),
        scenery(config.room.seed, SIZE, config.room.scene),
    )
    names = [f"F-score at {100 * near:.0f} cm (precision, recall)" for near in NEAR]
    print(f"| run | ATE | accuracy | completeness | {' | '.join(names)} |\n|" + "---|" * 6)
    for run in config.runs:
        estimate, reference = (trajectories.read_tum(run / f"{x}.txt").T for x in ("trajectory", "reference"))
        points = read_points(run / "mesh.ply")
        print(f"| {run.name} {scores(points, true, shapes, estimate, reference)}", flush=True)


if __name__ == "__main__":
    main()

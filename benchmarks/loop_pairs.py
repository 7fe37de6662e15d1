"""Pairs of frames that show different places, and pairs that show the same: which are taken for loops.

python benchmarks/loop_pairs.py --data DIR DIR ... --rooms 0 1 2 --floors 0

Every frame is compared with those that look most alike among the ones which, by the true poses, see nothing
in common with it: as a run does, by features first, and then as if features had said that both cameras were
at the same pose, so that depth and colour alone have to tell.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

from jaxpose.datasets.rgbd.registry import load_recording
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.types import Frame, Recording
from jaxpose.geometry import rigid
from jaxpose.geometry.camera import Camera
from jaxpose.slam.config import LoopConfig
from jaxpose.slam.keyframes import overlap, thumbnail
from jaxpose.slam.loops.closure import is_same_place
from jaxpose.slam.loops.verify import Verified, verify
from jaxpose.slam.map.backend import seen_points
from jaxpose.slam.tracking.features import FeaturePose, Features, detect, locate_camera

NOTHING, MUCH = 0.02, 0.4  # share of what one camera measures that the other's view holds
LATER_S = 1.0  # [s] between two frames of a pair that shows the same place


@dataclass(frozen=True)
class Config:
    """Where pairs are taken from."""

    data: tuple[Path, ...] = ()  # recordings with true poses
    rooms: tuple[int, ...] = (0, 1, 2)  # seeds of default rooms
    floors: tuple[int, ...] = ()  # seeds of floors; a minute each to make
    frames: int = 60  # of each recording
    pairs: int = 6  # of each kind for each frame


class View(NamedTuple):
    """A frame, and what is known of it."""

    t: float
    frame: Frame
    features: Features
    T_world_cam: np.ndarray  # (4, 4), true
    points: np.ndarray  # (n, 3) that it measures, in the world


def recordings(config: Config) -> Iterator[tuple[str, Recording]]:
    """Their names and themselves."""
    for seed in config.rooms:
        yield f"room {seed}", room(RoomConfig(seed=seed))
    for seed in config.floors:
        yield (
            f"floor {seed}",
            room(RoomConfig(scene="floor", duration_s=72.0, rate_hz=2.0, width=160, height=120, seed=seed)),
        )
    for path in config.data:
        yield path.name, load_recording(path)


def views(recording: Recording, count: int) -> list[View]:
    """Frames spread evenly over those with a true pose."""
    assert recording.T_world_cam is not None
    known = np.flatnonzero(np.isfinite(recording.T_world_cam).all(axis=(1, 2)))
    found = []
    for i in np.unique(known[np.linspace(0, len(known) - 1, count).astype(int)]).tolist():
        frame, T = recording.read(i), recording.T_world_cam[i]
        points = seen_points(frame, recording.camera, T)
        if len(points):
            found.append(View(float(recording.t[i]), frame, detect(frame, recording.camera), T, points))
    return found


def by_features(a: View, b: View, camera: Camera) -> Verified | None:
    """What a run would find; None where features find nothing."""
    seen = locate_camera(b.features, [(a.features, np.eye(4))], camera)
    return None if seen is None else verify(a.frame, b.frame, seen, camera)


def by_depth(a: View, b: View, camera: Camera) -> Verified:
    """As if features had said that both cameras are at the same pose, but for 2 cm and a degree."""
    return verify(a.frame, b.frame, FeaturePose(np.eye(4), 4e-4 * np.eye(6) / 30, 100), camera)


def main() -> None:
    config, policy = tyro.cli(Config, description=__doc__), LoopConfig()
    print("| recording | wrong pairs | by features | believed | believed by depth alone ", end="")
    print("| right pairs | believed | worst error |\n|" + "---|" * 8)
    for name, recording in recordings(config):
        camera, seen = recording.camera, views(recording, config.frames)
        poses, looks = np.stack([v.T_world_cam for v in seen]), np.stack([thumbnail(v.frame) for v in seen])
        shared = np.stack([overlap(v.points, poses, camera, margin=0) for v in seen])
        tried, located, wrong, wrong_by_depth, right, believed, worst = 0, 0, 0, 0, 0, 0, 0.0
        for i, view in enumerate(seen):
            order = np.argsort(np.mean((looks - looks[i]) ** 2, axis=(1, 2, 3)))
            both = np.minimum(shared[i], shared[:, i]), np.maximum(shared[i], shared[:, i])
            for j in order[both[1][order] < NOTHING][: config.pairs]:
                found = by_features(seen[j], view, camera)
                tried, located = tried + 1, located + (found is not None)
                wrong += found is not None and is_same_place(found, policy)
                wrong_by_depth += is_same_place(by_depth(seen[j], view, camera), policy)
            later = np.array([view.t - v.t > LATER_S for v in seen])
            for j in order[(both[0][order] > MUCH) & later[order]][: config.pairs]:
                found, right = by_features(seen[j], view, camera), right + 1
                if found is not None and is_same_place(found, policy):
                    off = rigid.inverse(rigid.inverse(poses[j]) @ poses[i]) @ found.T_a_b
                    believed, worst = believed + 1, max(worst, float(np.linalg.norm(off[:3, 3])))
        print(f"| {name} | {tried} | {located} | {wrong} | {wrong_by_depth} ", end="")
        print(f"| {right} | {believed} | {100 * worst:.1f} cm |", flush=True)


if __name__ == "__main__":
    main()

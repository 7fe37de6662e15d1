"""Two sessions in one map: how far their poses are apart at the times that both have seen, without alignment.

`python benchmarks/second_session.py --first 31 --start 25` in the default room at 5 Hz, with `--data DIR` and
`--rate-hz HZ` on a recording: its first frames, then those from `--start` on in the map of the first, both
counted before thinning.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxpose import slam
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.rgbd_slam import Config
from jaxpose.experiments.slam.source import load
from jaxpose.files.association import associate
from jaxpose.geometry import rigid
from jaxpose.slam import SlamConfig


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--rate-hz", type=float)
    parser.add_argument("--first", type=int, default=31)
    parser.add_argument("--start", type=int, default=25)
    options = parser.parse_args()
    base = Config(data=options.data, rate_hz=options.rate_hz, slam=SlamConfig())
    recordings = [
        load(replace(base, **part)).recording
        for part in ({"frames": options.first}, {"start": options.start})
    ]
    first = slam.run(recordings[0], base.slam)
    begun = slam.begin_in(slam.saved_map(first), recordings[1], base.slam)
    results = [first, slam.run(recordings[1], base.slam, state=begun)]
    for name, recording, result in zip(("first", "second"), recordings, results, strict=True):
        assert recording.T_world_cam is not None
        ate = trajectory_error.ate(result.T_world_cam, recording.T_world_cam).rmse
        print(f"{name}: {len(recording.t)} frames, {result.frames.lost.sum()} lost, ATE {100 * ate:.2f} cm")
    a, b = associate(recordings[0].t, recordings[1].t, 1e-3)
    T_a, T_b = results[0].T_world_cam[a], results[1].T_world_cam[b]
    apart = 100 * np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1)
    turned = np.degrees(rigid.rotation_angle(T_a[:, :3, :3], T_b[:, :3, :3]))
    off = f"{apart.min():.2f} to {apart.max():.2f} cm and up to {turned.max():.2f} degrees"
    print(f"{len(a)} frames of both are {off} apart")


if __name__ == "__main__":
    main()

"""Clock and mounting of an IMU that were told wrongly, as `slam --estimate offset extrinsics` finds them.

`python benchmarks/calibration.py --sensors structured_light stereo --seeds 0 1 2`: the default room, each
seed another room and walk, with a clock 30 ms ahead and a mounting 3 degrees and 3 cm off. With `--along DIR`
it is a recorded flight with its own IMU, whose clock and mounting are known no better than its files say: the
reference is there what is found without the injection.
"""

import argparse
from pathlib import Path

import numpy as np

from jaxpose import slam
from jaxpose.datasets.synthetic import RoomConfig, room
from jaxpose.datasets.synthetic.depth_sensors import RANGES
from jaxpose.datasets.types import Recording
from jaxpose.estimate import Sensors
from jaxpose.evaluation import trajectory_error
from jaxpose.geometry import rigid
from jaxpose.slam import SlamConfig

OFFSET_S, OFF = 0.03, np.array([0.02, -0.02, 0.01, *np.radians([1.5, -2.0, 1.5])])


def found_in(recording: Recording, seed: int) -> tuple[Sensors, float, int]:
    """Sensors, ATE [cm], and how often each frame was tracked."""
    frames = []
    config = SlamConfig(imu="combined", estimate=("offset", "extrinsics"), seed=seed)
    result = slam.run(recording, config, lambda progress: frames.append(progress.index))
    assert result.posterior is not None and recording.T_world_cam is not None
    ate = trajectory_error.ate(result.T_world_cam, recording.T_world_cam).rmse
    return result.posterior.sensors, 100 * ate, len(frames) // len(recording.t)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", nargs="+", default=["structured_light"], choices=tuple(RANGES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--duration-s", type=float, default=12.0)
    parser.add_argument("--along", type=Path)
    options = parser.parse_args()
    print("sensor, seed: offset [ms] (sigma), rotation [deg], lever [cm] (largest sigma), ATE [cm], passes")
    for sensor in options.sensors:
        for seed in options.seeds:
            config = RoomConfig(duration_s=options.duration_s, sensor=sensor, seed=seed, along=options.along)
            truth = room(config)
            assert truth.imu is not None
            clock_s, mounting = 0.0, truth.T_body_cam
            if options.along is not None:
                stated, _, _ = found_in(truth, seed)
                clock_s, mounting = stated.offset_s, stated.T_body_cam
            imu = truth.imu._replace(t=np.asarray(truth.imu.t) + OFFSET_S)
            told = truth._replace(imu=imu, T_body_cam=truth.T_body_cam @ rigid.exp(OFF))
            found, ate, passes = found_in(told, seed)
            off = rigid.log(rigid.inverse(found.T_body_cam) @ mounting)
            sigma, late_ms = found.T_body_cam_sigma, 1e3 * (found.offset_s - OFFSET_S - clock_s)
            print(
                f"{sensor}, {seed}: {late_ms:+.2f} ({1e3 * found.offset_sigma_s:.2f}), "
                f"{np.degrees(np.linalg.norm(off[3:])):.3f} ({np.degrees(sigma[3:].max()):.3f}), "
                f"{100 * np.linalg.norm(off[:3]):.2f} ({100 * sigma[:3].max():.2f}), {ate:.2f}, {passes}",
                flush=True,
            )


if __name__ == "__main__":
    main()

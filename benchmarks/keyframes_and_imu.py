"""Trajectory, scale, clock, mounting and gravity by noisy keyframes and EuRoC's own readings, and the truth.

True poses are thinned to 3 Hz, given white noise of 2 cm and 0.5 degrees per axis, put on a clock 30 ms off,
in a tilted world and a unit of 2.5 m. Printed are errors at 20 Hz without any alignment, and stated sigmas.
With --gtsam (`pip install gtsam`) the same keyframes in metres, mounting and clock known, go to GTSAM too.

    python benchmarks/keyframes_and_imu.py DIR/euroc_V1_02_medium --gtsam
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from timing import machine

from jaxpose.datasets.rgbd import euroc
from jaxpose.estimate import smooth
from jaxpose.geometry import rigid
from jaxpose.imu import Imu, ImuNoise
from jaxpose.imu.simulation import interpolant

KEYFRAME_HZ, POSITION_M, ROTATION_RAD = 3.0, 0.02, np.radians(0.5)
OFFSET_S, SCALE = 0.03, 2.5
TILT = rigid.exp(np.array([0.0, 0.0, 0.0, 0.6, -0.4, 0.9]))
MOUNTED = rigid.exp(np.array([0.05, -0.02, 0.03, *np.radians([2.0, -1.0, 2.0])]))
EDGE_S = 0.2  # of the truth, left out
FLOWN = ImuNoise(
    0.02 / np.sqrt(200), 0.6 / np.sqrt(200), 1.9393e-5, 3e-3
)  # about what rotors make of a sensor


@dataclass(frozen=True)
class Config:
    """What is run."""

    data: Annotated[Path, tyro.conf.Positional]  # folder in the EuRoC layout
    seeds: int = 3
    mounting: bool = False  # turn the camera by 3 degrees and move it by 6 cm, and estimate that too
    gtsam: bool = False  # also keyframes in metres, with GTSAM beside


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    print(machine())
    log = euroc.load_imu(config.data)
    truth = euroc.load_truth(config.data, log.t0_ns)
    imu = Imu(*(np.asarray(x, np.float64) for x in log.imu))
    path = interpolant(truth.t, truth.T_world_body)
    first, last = max(truth.t[0], imu.t[0]) + EDGE_S, min(truth.t[-1], imu.t[-1]) - EDGE_S
    wanted = np.arange(first, last, 1 / KEYFRAME_HZ)
    rows = np.unique([np.argmin(np.abs(truth.t - t)) for t in wanted])
    for seed in range(config.seeds):
        rng = np.random.default_rng(seed)
        off = np.repeat([POSITION_M, ROTATION_RAD], 3) * rng.normal(size=(len(rows), 6))
        noisy = truth.T_world_body[rows] @ rigid.exp(off)
        print(f"{config.data.name}, seed {seed}, {len(rows)} keyframes")
        unknown(config, noisy, truth.t[rows], path, imu, log.noise)
        if config.gtsam:
            beside_gtsam(noisy, truth.t[rows], truth.T_world_body[rows], imu, log.noise)


def unknown(config: Config, noisy, t, path, imu: Imu, sheet: ImuNoise) -> None:
    """Nothing but keyframes and readings is known."""
    mounting = MOUNTED if config.mounting else np.eye(4)
    given = TILT @ noisy @ mounting
    given[:, :3, 3] /= SCALE
    estimate = ("biases", "gravity", "offset", "scale", *(("extrinsics",) if config.mounting else ()))
    sigmas = [POSITION_M / SCALE] * 3 + [ROTATION_RAD] * 3
    known = smooth(t - OFFSET_S, given, sigmas, imu, estimate=estimate, noise=sheet)
    s, at = known.sensors, np.arange(t[0], t[-1], 0.05)
    found, true = known.pose(at - OFFSET_S), TILT @ path.pose(at) @ mounting
    P = known.covariance(at - OFFSET_S)
    down = TILT[:3, :3] @ [0.0, 0.0, -1.0]
    print(
        f"  position {100 * rms(found, true):.2f} cm (stated {100 * spread(P):.2f}), rotation "
        f"{turned(found, true):.3f} deg\n"
        f"  scale {100 * (s.scale / SCALE - 1):+.2f}% ({100 * s.scale_sigma:.2f}), offset "
        f"{1e3 * (s.offset_s - OFFSET_S):+.2f} ms ({1e3 * s.offset_sigma_s:.2f}), gravity "
        f"{np.degrees(rigid.vector_angle(s.gravity_world, down)):.2f} deg"
    )
    if config.mounting:
        away = rigid.log(rigid.inverse(mounting) @ s.T_body_cam)
        print(f"  mounting {100 * away[:3].round(4)} cm, {np.degrees(away[3:]).round(2)} deg off")


def beside_gtsam(noisy, t, true, imu: Imu, sheet: ImuNoise) -> None:
    """The same problem by two solvers, at the keyframes, and ours with noise levels found."""
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    from helpers.gtsam_smoother import by_gtsam

    sigmas = [POSITION_M] * 3 + [ROTATION_RAD] * 3

    def ours(**options):
        known = smooth(t, noisy, sigmas, imu, **options)
        return known.pose(t), known.covariance(t)

    runs = {
        "smooth": lambda: ours(noise=FLOWN, fit_noise=False),
        "GTSAM": lambda: by_gtsam(t, noisy, imu, FLOWN, POSITION_M, ROTATION_RAD),
        "smooth, levels found": lambda: ours(noise=sheet),
    }
    for name, run in runs.items():
        run()
        began = time.perf_counter()
        found, P = run()
        seconds = time.perf_counter() - began
        print(
            f"  {name:<20} position {100 * rms(found, true):.3f} cm (stated {100 * spread(P):.3f}), rotation "
            f"{turned(found, true):.3f} deg, second call {seconds:.2f} s"
        )


def rms(found, true) -> float:
    return float(np.sqrt(np.mean(np.sum((found[:, :3, 3] - true[:, :3, 3]) ** 2, axis=1))))


def turned(found, true) -> float:
    angle = rigid.rotation_angle(found[:, :3, :3], true[:, :3, :3])
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def spread(P) -> float:
    return float(np.sqrt(np.mean(np.trace(P[:, :3, :3], axis1=1, axis2=2))))


if __name__ == "__main__":
    main()

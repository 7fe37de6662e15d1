"""`jaxpose fit --estimate`: a metric trajectory with its covariance, and sensors, from poses and an IMU."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.cli.fit.candidates import noise_floor
from jaxpose.datasets.origin import moved
from jaxpose.datasets.rgbd import euroc
from jaxpose.datasets.rgbd.imu_csv import read_imu, read_mounting
from jaxpose.errors import DataError
from jaxpose.estimate import Posterior, smooth
from jaxpose.experiments.outcome import markdown_table
from jaxpose.experiments.progress import OnUpdate, Update
from jaxpose.fields import save, shifted
from jaxpose.files.kalibr import CameraImu, write_camchain
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry import rigid
from jaxpose.geometry.rigid import Similarity
from jaxpose.imu import Imu, ImuNoise

_WRONG = 2.0  # times its data sheet: then a noise is reported


class Calibration(NamedTuple):
    """What was found, with one sigma of everything."""

    source: str
    poses: int
    span_s: float
    readings: int
    estimated: tuple[str, ...]
    unobserved: tuple[str, ...]  # the motion says nothing of them
    offset_s: tuple[float, float]  # t_imu = t_pose + offset
    scale: tuple[float, float]  # metres per unit of the poses; sigma relative
    T_body_cam: Float[np.ndarray, "4 4"]
    T_body_cam_sigma: Float[np.ndarray, "6"]  # [m, rad]
    gravity_world: Float[np.ndarray, "3"]  # [m/s^2] in the poses' own world
    gravity_sigma_deg: float
    gyro_bias: Float[np.ndarray, "2 3"]  # [rad/s] in the middle, and sigma
    accelerometer_bias: Float[np.ndarray, "2 3"]  # [m/s^2]
    noise: tuple[float, float]  # [rad/s, m/s^2] of a reading, vibration in it
    sheet: tuple[float, float] | None  # the same by the data sheet
    pose_sigma: tuple[float, float]  # [m, deg] of the poses, as large as they turned out
    trajectory_sigma: tuple[float, float]  # [m, deg] of the estimate, median
    notes: tuple[str, ...]


def calibrate(config, source: str, trajectory: Trajectory, on_update: OnUpdate) -> Calibration:
    """Estimate what the config names, and write the files that it asks for.

    Args:
        config: `cli.fit.command.Config`.
        source: what the poses are, in words.
        trajectory: the poses, seconds on the clock of their file.
        on_update: called with what is being done.

    Returns:
        What was found.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    t0 = float(trajectory.t[0])
    t0_ns = trajectory.t0_ns + round(t0 * 1e9)
    imu, sheet, notes = _readings(config.imu, t0_ns)
    origin = trajectory.T[0, :3, 3]  # poses far from the world's origin are worked on near it
    near = moved(trajectory.T, -origin)
    sigmas = np.repeat([config.position_sigma, np.radians(config.rotation_sigma_deg)], 3)
    mounting = None if config.extrinsics is None else read_mounting(config.extrinsics)
    on_update(Update(f"estimating {', '.join(config.estimate)} (compiling)"))
    try:
        known = smooth(
            trajectory.t - t0,
            near,
            sigmas,
            imu,
            estimate=config.estimate,
            noise=sheet,
            T_body_cam=None if mounting is None else mounting.T_body_cam,
            offset_s=0.0 if mounting is None else mounting.offset_s,
        )
    except ValueError as error:
        raise DataError(f"{source}: {error}") from None
    if config.out is not None:
        on_update(Update(f"writing {config.out}"))
        _write(config.out, known, t0_ns / 10**9, origin)
        upright = ", world upright" if "gravity" in config.estimate else ""
        notes.append(f"trajectory with covariance written to {config.out}, metres{upright}")
    if config.kalibr is not None:
        write_camchain(config.kalibr, CameraImu(known.sensors.T_body_cam, known.sensors.offset_s))
        notes.append(f"T_cam_imu and timeshift_cam_imu written to {config.kalibr}")
    return _found(config, source, trajectory, imu, sheet, known, tuple(notes))


def calibration_report(found: Calibration) -> str:
    """The table of what was found, and how.

    Args:
        found: of `calibrate`.

    Returns:
        Its lines.
    """
    numbers = lambda x, digits: " ".join(f"{v:.{digits}f}" for v in x)
    turn = np.degrees(rigid.so3_log(found.T_body_cam[:3, :3]))
    tilt = np.degrees(rigid.vector_angle(found.gravity_world, np.array([0.0, 0.0, -1.0])))
    sigma = found.T_body_cam_sigma
    quantities = {
        "offset": [("time offset [ms]", f"{1e3 * found.offset_s[0]:.3f}", f"{1e3 * found.offset_s[1]:.3f}")],
        "scale": [("scale [m/unit]", f"{found.scale[0]:.5f}", f"{100 * found.scale[1]:.2f}%")],
        "gravity": [("gravity from -z [deg]", f"{tilt:.3f}", f"{found.gravity_sigma_deg:.3f}")],
        "extrinsics": [
            ("camera on IMU [cm]", numbers(100 * found.T_body_cam[:3, 3], 2), numbers(100 * sigma[:3], 2)),
            ("camera turned by [deg]", numbers(turn, 3), numbers(np.degrees(sigma[3:]), 3)),
        ],
        "biases": [
            ("gyroscope bias [rad/s]", *(numbers(x, 5) for x in found.gyro_bias)),
            ("accelerometer bias [m/s^2]", *(numbers(x, 4) for x in found.accelerometer_bias)),
        ],
    }
    rows = [("quantity", "found", "one sigma")]
    for name in found.estimated:
        rows += quantities[name]
    metres, degrees = found.trajectory_sigma
    lines = [
        f"poses      {found.source}: {found.poses} over {found.span_s:.4g} s, {found.readings} readings",
        f"           turned out to have one sigma of {100 * found.pose_sigma[0]:.3g} cm and "
        f"{found.pose_sigma[1]:.3g} deg per axis",
        f"trajectory one sigma of {100 * metres:.3g} cm and {degrees:.3g} deg, median over all times",
        "offset     t_imu = t_pose + offset; biases in the middle; scale's sigma relative",
        f"noise      {found.noise[0]:.3g} rad/s and {found.noise[1]:.3g} m/s^2 a reading, vibration in it",
    ]
    if found.sheet is not None:
        times = [n / s for n, s in zip(found.noise, found.sheet, strict=True)]
        if max(times) > _WRONG or min(times) < 1 / _WRONG:
            lines.append(f"           {times[0]:.3g} and {times[1]:.3g} times what the data sheet says")
    if found.unobserved:
        lines.append(f"unknown    {', '.join(found.unobserved)}: this motion says nothing of it")
    lines += [f"note       {note}" for note in found.notes]
    return "\n".join([markdown_table(rows), "", *(f"  {line}" for line in lines)])


def _readings(path: Path, t0_ns: int) -> tuple[Imu, ImuNoise | None, list[str]]:
    """Readings with seconds since the first pose, their data sheet where there is one, and notes on them."""
    if path.is_dir():
        log = euroc.load_imu(path, t0_ns)
        return log.imu, log.noise, list(log.notes)
    if not path.exists():
        raise DataError(f"{path}: expected readings of an IMU, a file or a folder, got nothing")
    file = read_imu(path)
    return file.since(t0_ns), None, list(file.notes)


def _write(out: Path, known: Posterior, t0: float, origin: Float[np.ndarray, "3"]) -> None:
    field, params = known.field()
    covariance = known.covariances()
    up = np.eye(3)
    if "gravity" in known.estimated:
        down = np.array([0.0, 0.0, -1.0])
        up = Rotation.align_vectors(down, known.sensors.gravity_world)[0].as_matrix()  # the shortest way
    out.parent.mkdir(parents=True, exist_ok=True)
    save(
        out,
        shifted(field, t0),
        params,
        alignment=Similarity(1.0, up, up @ (known.sensors.scale * origin)),
        covariance=covariance._replace(t=covariance.t + t0),
    )


def _found(config, source, trajectory, imu, sheet, known: Posterior, notes) -> Calibration:
    s, middle = known.sensors, len(known.sensors.bias_t) // 2
    first, last = known.span
    P = known.covariance(np.linspace(first, last, 200))
    spread = (
        np.sqrt(np.trace(P[:, :3, :3], axis1=1, axis2=2)),
        np.sqrt(np.trace(P[:, 3:, 3:], axis1=1, axis2=2)),
    )
    stated = None
    if sheet is not None:
        stated = noise_floor(sheet, 1 / float(np.median(np.diff(imu.t))))
    return Calibration(
        source,
        len(trajectory.t),
        float(trajectory.t[-1] - trajectory.t[0]),
        len(imu.t),
        known.estimated,
        known.unobserved,
        (s.offset_s, s.offset_sigma_s),
        (s.scale, s.scale_sigma),
        s.T_body_cam,
        s.T_body_cam_sigma,
        s.gravity_world,
        float(np.degrees(s.gravity_sigma)),
        np.stack([s.gyro_bias[middle], s.gyro_bias_sigma[middle]]),
        np.stack([s.accelerometer_bias[middle], s.accelerometer_bias_sigma[middle]]),
        (known.noise.gyro, known.noise.accelerometer),
        stated,
        (
            float(known.noise.position * config.position_sigma * s.scale),
            float(known.noise.rotation * config.rotation_sigma_deg),
        ),
        (float(np.median(spread[0])), float(np.degrees(np.median(spread[1])))),
        notes,
    )

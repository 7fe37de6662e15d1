"""Which pose field carries a motion: several fitted to timestamped poses, and the error of each.

TRAJECTORY is a file of timestamped poses (TUM, KITTI, EuRoC or TUM-VI csv, 4x4 lists: found by its content),
a run folder, a recording with true poses, or photographs with poses (COLMAP's models, transforms.json). Every
tenth pose is held out. With --imu the fields' own derivatives, which have seen poses only, are compared with
a gyroscope and an accelerometer.

With --imu and --estimate poses and readings together give one trajectory, in metres and upright, with its
covariance, and the sensors: how far apart their clocks are, how the camera is mounted, scale, biases.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from jaxpose.cli.fit.types import FEWEST, Fitted, Sensor
from jaxpose.cli.source import read_source
from jaxpose.errors import DataError
from jaxpose.experiments.checks import check_apart, check_least, check_positive, check_unused
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.outcome import markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files.trajectories import Trajectory
from jaxpose.geometry.rigid import Similarity

if TYPE_CHECKING:
    from jaxpose.cli.fit.calibration import Calibration

Quantity = Literal["biases", "gravity", "offset", "extrinsics", "scale"]
_SLOW = 3.0  # times the best field's error


@dataclass(frozen=True)
class Config:
    """Settings of the comparison; the trajectory and these are all that the numbers depend on."""

    trajectory: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRAJECTORY")
    ]  # file of timestamped poses, or a run folder
    # Folder in the EuRoC layout whose mav0/imu0 was read by the same clock, in the same body, as the poses;
    # with --estimate also a file of readings, EuRoC's csv or lines of `t wx wy wz ax ay az`.
    imu: Path | None = None
    estimate: tuple[Quantity, ...] = ()  # what to find by --imu, beside the trajectory
    extrinsics: Path | None = (
        None  # of --estimate: T_body_cam, or where its estimate starts, as in `jaxpose slam`
    )
    position_sigma: float = (
        0.02  # of --estimate: one sigma of positions, in their unit; a first guess will do
    )
    rotation_sigma_deg: float = 0.5  # of --estimate: one sigma of rotations; a first guess will do
    kalibr: Path | None = None  # of --estimate: write Kalibr's camchain, T_cam_imu and timeshift_cam_imu
    recorded_hz: float | None = None  # [Hz] rate of the poses where the file has no timestamps
    posenet_octaves: tuple[int, ...] = (5, 8)  # PoseNets to fit, by the octaves of their time encoding
    posenet_layers: int = 8  # of PoseNets
    posenet_width: int = 256  # of the layers of PoseNets
    bspline_hz: tuple[float, ...] = (2.0, 5.0, 10.0, 20.0)  # B-splines to fit, by their knots a second
    steps: int = 1000  # of Adam, for each field
    seed: int = 0  # of the networks' start
    out: Path | None = (
        None  # write the trajectory, or the best field: npz that `jaxpose/fields/numpy_evaluator.py` reads
    )
    json: bool = False  # print the numbers as JSON and nothing else

    def __post_init__(self):
        if not self.posenet_octaves and not self.bspline_hz:
            raise ValueError("--bspline-hz: expected a field to fit, PoseNet or B-spline, got none")
        check_least(self, posenet_octaves=0, posenet_layers=1, posenet_width=1, steps=1)
        check_positive(self, "bspline_hz", "recorded_hz")
        check_positive(self, "position_sigma", "rotation_sigma_deg")
        check_apart("--out", self.out, self.trajectory, self.imu, self.extrinsics)
        check_apart("--kalibr", self.kalibr, self.trajectory, self.imu, self.extrinsics, self.out)
        if self.estimate and self.imu is None:
            raise ValueError("--estimate: expected --imu with it, got none")
        if not self.estimate:
            alone = ("extrinsics", "position_sigma", "rotation_sigma_deg", "kalibr")
            check_unused(self, alone, "without --estimate")


class Result(NamedTuple):
    """The fields, and how they were measured."""

    source: str
    poses: int
    held_out: int
    span_s: float
    rate_hz: float
    bandwidth_hz: float  # below it lies 95% of the power of the speeds
    sensor: Sensor | None
    fields: tuple[Fitted, ...]
    best: str  # least median error of position (in half the extent) and orientation [rad] together
    too_slow: tuple[str, ...]  # do not reach the bandwidth, and leave three times what the best leaves
    notes: tuple[str, ...]


def run(config: Config, on_update: OnUpdate = silent) -> "Result | Calibration":
    """Fit every field that the config names, or estimate what it names, and write what it says.

    Args:
        config: the trajectory, and the fields to fit.
        on_update: called with what is being done.

    Returns:
        The fields, and how they were measured.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    source, trajectory = _trajectory(config)
    on_update(Update("loading JAX", quiet=True))
    if config.estimate:
        from jaxpose.cli.fit.calibration import calibrate

        return calibrate(config, source, trajectory, on_update)
    return _compared(config, source, trajectory, on_update)


def _compared(config: Config, source: str, trajectory: Trajectory, on_update: OnUpdate) -> Result:
    """Every field that the config names, fitted."""
    from jaxpose.cli.fit import candidates as fit_candidates

    imu, sensor, notes = (None, None, ())
    if config.imu is not None:
        imu, sensor, notes = fit_candidates.readings(config.imu, trajectory)
    span_s = float(trajectory.t[-1] - trajectory.t[0])
    rate_hz = 1 / float(np.median(np.diff(trajectory.t)))
    held = np.arange(len(trajectory.t)) % 10 == 5
    chosen, sparse = _candidates(config, span_s, rate_hz)
    notes += sparse
    if not chosen:
        raise DataError(f"{source}: expected more poses for these B-splines, got {rate_hz:.3g} Hz")
    around = fit_candidates.frame(trajectory)
    fitted: list[Fitted] = []
    found: list[tuple[Any, Any]] = []
    for number, candidate in enumerate(chosen):
        on_update(Update(f"fitting {candidate.name}, {number + 1} of {len(chosen)} fields"))
        one = fit_candidates.fit_field(candidate, trajectory, held, around, imu, config.steps)
        fitted.append(one[0])
        found.append(one[1:])
    off = np.array(
        [f.translation_m.median / around.scale + np.radians(f.rotation_deg.median) for f in fitted]
    )
    best = int(np.argmin(off))
    bandwidth_hz = fit_candidates.bandwidth_hz(trajectory)
    slow = [f.highest_hz < bandwidth_hz and x > _SLOW * off.min() for f, x in zip(fitted, off, strict=True)]
    if config.out is not None:
        _write(config.out, *found[best], Similarity(around.scale, np.eye(3), around.middle))
        notes += (f"{fitted[best].name} written to {config.out}, seconds as in {config.trajectory.name}",)
    return Result(
        source,
        len(held),
        int(held.sum()),
        span_s,
        rate_hz,
        bandwidth_hz,
        sensor,
        tuple(fitted),
        fitted[best].name,
        tuple(f.name for f, is_slow in zip(fitted, slow, strict=True) if is_slow),
        notes,
    )


def main(args: Sequence[str] | None = None, prog: str = "jaxpose fit") -> None:
    """The command `jaxpose fit`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, report), args)


def report(result: "Result | Calibration") -> str:
    """The fields side by side, or what was estimated, and how it was measured."""
    if not isinstance(result, Result):
        from jaxpose.cli.fit.calibration import calibration_report

        return calibration_report(result)
    sensor = result.sensor
    head = ["field", "up to [Hz]", "parameters", "position [mm]", "rotation [deg]"]
    if sensor is not None:
        head += ["body rate [rad/s]", "acceleration [m/s^2]"]
    rows = [[*head, "fit [s]", ""]]
    for field in result.fields:
        row = [field.name, f"{field.highest_hz:.3g}", f"{field.parameters}"]
        for statistics, factor in ((field.translation_m, 1e3), (field.rotation_deg, 1.0)):
            row.append(f"{factor * statistics.median:.3g} (rmse {factor * statistics.rmse:.3g})")
        if sensor is not None and field.inertial is not None:
            left = (field.inertial.omega_rms, field.inertial.acceleration_rms)
            row += [f"{x:.3g} ({x / s:.3g}x)" for x, s in zip(left, sensor.stated, strict=True)]
        verdict = " ".join(
            word
            for word, holds in (
                ("best", field.name == result.best),
                ("too slow", field.name in result.too_slow),
            )
            if holds
        )
        rows.append([*row, f"{field.seconds:.1f}", verdict])
    lines = [
        ("poses", f"{result.source}: {result.rate_hz:.4g} Hz over {result.span_s:.4g} s"),
        (
            "motion",
            f"95% of the power of velocity and body rate lies below {result.bandwidth_hz:.3g} Hz; a field is "
            "too slow whose fastest band (PoseNet) or half of whose knots a second (B-spline) do not reach "
            f"that, and which leaves {_SLOW:g} times what the best leaves",
        ),
        (
            "residuals",
            f"median over {result.held_out} of {result.poses} poses, every tenth, that no field has seen",
        ),
    ]
    if sensor is not None:
        omega, acceleration = sensor.measured
        lines += [
            (
                "inertial",
                f"RMS per axis over {sensor.readings} readings at {sensor.rate_hz:.4g} Hz, constant biases "
                "and gravity fitted; in brackets times the data sheet's sigma, "
                f"{sensor.stated[0]:.3g} rad/s and {sensor.stated[1]:.3g} m/s^2",
            ),
            (
                "readings",
                f"differ from their neighbours as if their own noise were {omega:.3g} rad/s and "
                f"{acceleration:.3g} m/s^2 (RMS of second differences / sqrt 6: sensor and vibration)",
            ),
        ]
    lines += [("note", note) for note in result.notes]
    told = "\n".join(f"  {name:<10} {text}" for name, text in lines)
    return f"{markdown_table(rows)}\n\n{told}"


def _candidates(config: Config, span_s: float, rate_hz: float) -> tuple[list, tuple[str, ...]]:
    """The fields to fit, and a note for each that has too many knots for these poses."""
    from jaxpose.cli.fit import candidates

    net = config.posenet_layers, config.posenet_width, config.seed
    chosen = [candidates.posenet(span_s, octaves, *net) for octaves in config.posenet_octaves]
    dense = [hz for hz in config.bspline_hz if hz > rate_hz / 2]
    chosen += [candidates.bspline(span_s, hz) for hz in config.bspline_hz if hz not in dense]
    why = f"fewer than two poses for each ({rate_hz:.3g} Hz)"
    return chosen, tuple(f"no B-spline of {hz:g} knots/s: {why}" for hz in dense)


def _write(out: Path, field: Any, params: Any, moved: Similarity) -> None:
    """A fitted field as a file."""
    from jaxpose.fields import save

    out.parent.mkdir(parents=True, exist_ok=True)
    save(out, field, params, alignment=moved)


def _trajectory(config: Config) -> tuple[str, Trajectory]:
    """The poses with their timestamps, and what they are in words."""
    source = read_source(config.trajectory)
    trajectory = source.trajectory
    if not source.stamped:
        if config.recorded_hz is None:
            raise DataError(
                f"{source.path}: expected --recorded-hz, as a {source.what} has no timestamps, got none"
            )
        trajectory = trajectory._replace(t=trajectory.t / config.recorded_hz)
    elif config.recorded_hz is not None:
        raise DataError(f"{source.path}: expected no --recorded-hz, as a {source.what} has timestamps")
    if len(trajectory.t) < FEWEST:
        raise DataError(f"{source.path}: expected at least {FEWEST} poses to fit, got {len(trajectory.t)}")
    return str(source), trajectory

"""How far an estimated trajectory is from a reference: ATE, RPE and rotation error, with their protocol.

ESTIMATE and REFERENCE are trajectory files (TUM, KITTI, EuRoC, TUM-VI or VINS csv, tables with a header,
lists of 4x4 matrices: found by their content), run folders of this package, recordings, or photographs with
poses (COLMAP's models, transforms.json, LLFF). Poses are paired by nearest timestamp; where one of the two
has none, by the names of the images or row by row. A run's continuous trajectory is evaluated at the
reference's own timestamps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float

from jaxpose.cli.source import FIELD, Source, read_field, read_source
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.evaluation.consistency import Consistency, aligned_error, consistency, relative_error
from jaxpose.evaluation.observability import free_rotation
from jaxpose.evaluation.trajectory_error import Alignment, Statistics
from jaxpose.experiments.checks import check_apart, check_finite, check_least, check_positive
from jaxpose.experiments.command import Command, execute
from jaxpose.experiments.outcome import markdown_table
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files import trajectories
from jaxpose.files.association import associate, associate_names, nearest
from jaxpose.geometry import rigid
from jaxpose.geometry.rigid import Similarity

_INDEPENDENT_S = 0.5
Unit = Literal["frames", "s", "m"]
_ALIGNMENTS = {
    "none": "none: poses are compared as they are",
    "se3": "SE(3): rotation and translation, least squares of the positions (Umeyama)",
    "sim3": "Sim(3): rotation, translation and scale, least squares of the positions (Umeyama)",
}


@dataclass(frozen=True)
class Config:
    """Settings of a comparison; the two trajectories and these are all that the numbers depend on."""

    estimate: Annotated[
        Path, tyro.conf.Positional, tyro.conf.arg(metavar="ESTIMATE")
    ]  # the trajectory to measure: file or run folder
    # The ground truth, or what is taken for it: file or run folder.
    reference: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REFERENCE")]
    align: Alignment = "se3"  # how the estimate is moved onto the reference first
    # nearest: each pose of the shorter trajectory with the nearest in time of the other; exact: the
    # continuous trajectory of the estimate at the reference's timestamps; auto: exact if the estimate is a
    # run that has one.
    match: Literal["auto", "nearest", "exact"] = "auto"
    max_difference_s: float = 0.01  # [s] largest distance of two timestamps that are paired as nearest
    time_offset_s: float = 0.0  # [s] added to the timestamps of the estimate
    rpe_frames: tuple[int, ...] = (1,)  # relative errors over so many poses
    rpe_seconds: tuple[float, ...] = (1.0,)  # relative errors over so much time [s]
    rpe_metres: tuple[float, ...] = ()  # relative errors over so much of the reference's path [m]
    consistency: bool = False  # whether errors are as large as the covariances of a run's field.npz say
    plot: Path | None = None  # PNG to draw both trajectories and the errors in
    columns: str | None = None  # of ESTIMATE, where it does not say: `t[us] tx ty tz qw qx qy qz`
    reference_columns: str | None = None  # of REFERENCE, likewise
    json: bool = False  # print the numbers as JSON and nothing else

    def __post_init__(self):
        check_least(self, max_difference_s=0)
        check_finite(self, "time_offset_s")
        check_positive(self, "rpe_frames", "rpe_seconds", "rpe_metres")
        check_apart("--plot", self.plot, self.estimate, self.reference)
        if self.plot is not None and self.plot.suffix != ".png":
            raise ValueError(f"--plot: expected a name that ends in .png, got {self.plot}")


class Relative(NamedTuple):
    """Relative errors over one distance."""

    delta: float
    unit: Unit
    translation_m: Statistics
    rotation_deg: Statistics
    pairs: int


class Result(NamedTuple):
    """The errors of a comparison, and how they were measured."""

    estimate: str  # in words
    reference: str
    pairs: int
    association: str
    alignment: Alignment
    transform: Similarity  # estimate -> reference
    ate_m: Statistics
    rotation_deg: Statistics  # NaN where the alignment leaves a rotation free
    rpe: tuple[Relative, ...]
    consistency: dict[str, Consistency] | None  # of poses, and of moves of one second
    notes: tuple[str, ...]
    plot: Path | None


class _Pairs(NamedTuple):
    """Poses row by row, at the reference's timestamps."""

    t: Float[np.ndarray, " n"]  # [s] since the reference's origin; of an exact match, on the run's clock
    estimate: Float[np.ndarray, "n 4 4"]
    reference: Float[np.ndarray, "n 4 4"]
    how: str
    stamped: bool
    exact: bool = False  # of the continuous trajectory


def run(config: Config, on_update: OnUpdate = silent) -> Result:
    """Compare the trajectories that the config names, and draw them if it says so.

    Args:
        config: the two trajectories, and how to compare them.
        on_update: called with what is being done.

    Returns:
        The errors, and how they were measured.

    Raises:
        DataError, OSError: for what cannot be used.
    """
    on_update(Update(f"reading {config.estimate} and {config.reference}", quiet=True))
    estimate = read_source(config.estimate, config.columns)
    reference = read_source(config.reference, config.reference_columns)
    pairs = _pair(config, estimate, reference)
    ate = trajectory_error.ate(pairs.estimate, pairs.reference, config.align)
    aligned = trajectory_error.align(ate.alignment, pairs.estimate)
    turned = np.degrees(rigid.rotation_angle(aligned[:, :3, :3], pairs.reference[:, :3, :3]))
    rpe, notes = _relative(config, pairs)
    rotation = trajectory_error.statistics(turned)
    if config.align != "none" and (free := _free(pairs, aligned)):
        rotation, notes = trajectory_error.statistics(np.full(1, np.nan)), (*notes, free)
    consistent = _consistency(config, pairs, ate.alignment) if config.consistency else None
    if config.plot is not None:
        on_update(Update("drawing figures", quiet=True))
        from jaxpose.plots.evaluation import comparison

        comparison(
            config.plot,
            pairs.t if pairs.stamped else None,
            aligned,
            pairs.reference,
            ate.errors,
            turned,
            f"{config.estimate.name} against {config.reference.name}: ATE-RMSE {ate.rmse:.4g} m, "
            f"alignment {config.align}, {len(pairs.t)} pairs",
        )
    return Result(
        estimate=str(estimate),
        reference=str(reference),
        pairs=len(pairs.t),
        association=pairs.how,
        alignment=config.align,
        transform=ate.alignment,
        ate_m=trajectory_error.statistics(ate.errors),
        rotation_deg=rotation,
        rpe=rpe,
        consistency=consistent,
        notes=notes,
        plot=config.plot,
    )


def main(args: Sequence[str] | None = None, prog: str = "jaxpose eval") -> None:
    """The command `jaxpose eval`.

    Args:
        args: the command line; None is that of this process.
        prog: the command as it is typed.
    """
    execute(Command(prog, Config, __doc__, run, report), args)


def report(result: Result) -> str:
    """The numbers as a table under their protocol."""
    scale = f", scale {result.transform.scale:.6g}" if result.alignment == "sim3" else ""
    lines = [
        _line("estimate", result.estimate),
        _line("reference", result.reference),
        _line("pairs", f"{result.pairs} {result.association}"),
        _line("alignment", _ALIGNMENTS[result.alignment] + scale),
        "",
        markdown_table([
            ("error", "unit", "RMSE", "mean", "median", "max"),
            _row("ATE", "m", result.ate_m),
            _row("rotation", "deg", result.rotation_deg),
            *(
                _row(f"RPE over {_distance(rpe.delta, rpe.unit)}", unit, statistics)
                for rpe in result.rpe
                for unit, statistics in (("m", rpe.translation_m), ("deg", rpe.rotation_deg))
            ),
        ]),
        "",
        "  ATE: distance of positions after alignment; rotation: angle between orientations after it;",
        "  RPE: error of the motion between two poses so far apart (s, m: within a tenth), all such pairs",
    ]  # fmt: skip
    for name, found in (result.consistency or {}).items():
        low, high = found.band
        lines.append(_line(
            "NEES",
            f"{found.nees:.2f} of {name}, expected {low:.2f} to {high:.2f} (95%, {found.independent} "
            f"independent errors); {100 * found.inside_50:.0f}% and {100 * found.inside_90:.0f}% of "
            f"{found.count} inside the 50 and 90% ellipsoids",
        ))  # fmt: skip
    lines += [_line("note", note) for note in result.notes]
    if result.plot is not None:
        lines.append(_line("drawn in", str(result.plot)))
    return "\n".join(lines)


def _pair(config: Config, estimate: Source, reference: Source) -> _Pairs:
    """Poses of the two for each other."""
    match = config.match
    if match == "auto":
        match = "exact" if (config.estimate / FIELD).is_file() and reference.stamped else "nearest"
    if match == "exact":
        return _exact(config, estimate, reference)
    if not (estimate.stamped and reference.stamped):
        if estimate.names and reference.names:
            return _by_name(estimate, reference)
        return _row_by_row(config, estimate, reference)
    t_reference, T_reference, t0_ns = reference.trajectory
    t_estimate = trajectories.since(estimate.trajectory, t0_ns - round(config.time_offset_s * 1e9))
    T_estimate = estimate.trajectory.T
    apart = np.abs(t_estimate - t_reference[nearest(t_estimate, t_reference)]).min()
    if apart > config.max_difference_s:
        raise DataError(
            f"{estimate.path}: expected timestamps within {config.max_difference_s:g} s of those of "
            f"{reference.path}, {reference.span()}, got {estimate.span()}: nearest timestamps {apart:.3g} s "
            "apart; --max-difference-s, --time-offset-s"
        )
    # Reference first: of two equally long ones each pose of the estimate takes its nearest, as evo does.
    of_reference, of_estimate = associate(t_reference, t_estimate, config.max_difference_s)
    fewer = min(len(t_reference), len(t_estimate))
    most = f"at most {config.max_difference_s:g} s apart"
    how = f"of {fewer} poses of the shorter one: nearest timestamps, {most}"
    how += f"; the estimate's moved by {config.time_offset_s:g} s" if config.time_offset_s else ""
    return _Pairs(t_reference[of_reference], T_estimate[of_estimate], T_reference[of_reference], how, True)


def _by_name(estimate: Source, reference: Source) -> _Pairs:
    """Poses of the same images, where one of the two has no timestamps."""
    of_estimate, of_reference = associate_names(estimate.path, estimate.names, reference.names)
    t = reference.trajectory.t[of_reference]
    if not reference.stamped:
        t = estimate.trajectory.t[of_estimate]
    fewer = min(len(estimate.names), len(reference.names))
    how = f"of {fewer} poses of the shorter one: names of images, as not both have timestamps"
    T_estimate, T_reference = estimate.trajectory.T[of_estimate], reference.trajectory.T[of_reference]
    return _Pairs(t, T_estimate, T_reference, how, reference.stamped or estimate.stamped)


def _row_by_row(config: Config, estimate: Source, reference: Source) -> _Pairs:
    """Poses of equal numbers, where one of the two has no timestamps; a line left out has no partner."""
    if estimate.lines != reference.lines:
        raise DataError(
            f"{estimate.path}: expected {reference.lines} poses, as {reference.path} has, to pair them "
            f"row by row (one of the two has no timestamps), got {estimate.lines}"
        )
    rows = []
    for source in (estimate, reference):
        if source.stamped and len(source.trajectory.t) < source.lines:
            raise DataError(
                f"{source.path}: expected a pose in every line, to pair them row by row with those of a file "
                f"without timestamps, got {source}"
            )
        rows.append(np.arange(source.lines) if source.stamped else source.trajectory.t.astype(int))
    _, of_estimate, of_reference = np.intersect1d(*rows, return_indices=True)
    t = reference.trajectory.t[of_reference]
    if not reference.stamped:
        t = estimate.trajectory.t[of_estimate] + config.time_offset_s
    T_estimate, T_reference = estimate.trajectory.T[of_estimate], reference.trajectory.T[of_reference]
    stamped = reference.stamped or estimate.stamped
    return _Pairs(t, T_estimate, T_reference, "row by row, as not both have timestamps", stamped)


def _free(pairs: _Pairs, aligned: Float[np.ndarray, "n 4 4"]) -> str:
    """What to say where positions do not determine the alignment; nothing where they do."""
    what, spread = free_rotation(pairs.reference[:, :3, 3], aligned[:, :3, 3])
    if what == "none":
        return ""
    path = "the path is straight" if what == "about the path" else "the camera stays in one place"
    turned = "turning about it" if what == "about the path" else "any rotation"
    return (
        f"{path}, to {spread:.2g} m RMS: {turned} stays free in the alignment, so there is no rotation error "
        "after it (RPE has that of the motion; --align none compares orientations as they are)"
    )


def _exact(config: Config, estimate: Source, reference: Source) -> _Pairs:
    """The estimate's continuous trajectory at the reference's timestamps, as far as it goes."""
    pose = read_field(estimate)
    if not reference.stamped:
        raise DataError(f"{reference.path}: expected timestamps for --match exact, got a {reference.what}")
    first, last = estimate.trajectory.t[[0, -1]]
    t = trajectories.since(reference.trajectory, round(config.time_offset_s * 1e9))
    inside = (t >= first) & (t <= last)
    if not inside.any():
        apart = min(np.abs(t - first).min(), np.abs(t - last).min())
        raise DataError(
            f"{reference.path}: expected timestamps from {estimate.span()}, as {estimate.path} has, got "
            f"{reference.span()}, {apart:.3g} s apart; --time-offset-s brings them to one clock"
        )
    outside = len(t) - int(inside.sum())
    how = f"exact: the continuous trajectory ({FIELD}) at the reference's timestamps"
    how += f"; {outside} timestamps of the reference beyond its ends are left out" if outside else ""
    how += f"; the estimate's clock moved by {config.time_offset_s:g} s" if config.time_offset_s else ""
    of_reference = reference.trajectory.T[inside]
    return _Pairs(t[inside], pose(t[inside]), of_reference, how, True, exact=True)


def _consistency(config: Config, pairs: _Pairs, alignment: Similarity) -> dict[str, Consistency]:
    """Squared errors over the covariances of a run's file, of poses and of moves of one second.

    Errors half a second apart and more are counted as independent.
    """
    from jaxpose.fields import _entries, numpy_evaluator

    file = config.estimate / FIELD
    if not pairs.exact:
        raise DataError(f"{config.estimate}: --consistency expected a run and timestamps, to match exactly")
    known = _entries.read_entries(file)
    if "covariance" not in known:
        raise DataError(f"{file}: expected covariance, got a trajectory without")
    of_pose = numpy_evaluator.load_covariance(known)
    t = pairs.t
    P = of_pose(t)
    aligned = trajectory_error.align(alignment, pairs.estimate)
    error = aligned_error(aligned, pairs.reference, P)
    independent = lambda t: max(int((t[-1] - t[0]) / _INDEPENDENT_S), 1)
    found = {"poses after alignment": consistency(error, P, independent=independent(t))}
    later = np.searchsorted(t, t + 1.0 - 1e-6)
    i = np.flatnonzero((later < len(t)) & (np.abs(t[np.minimum(later, len(t) - 1)] - t - 1.0) < 1e-3))
    seconds = known.get("relative_covariance", ())
    i = i[t[i] <= known["covariance_times"][len(seconds) - 1]] if len(seconds) else i[:0]
    if len(i):
        of_second = numpy_evaluator.load_covariance(known, "relative_covariance")
        j = later[i]
        moves = relative_error(
            (pairs.estimate[i], pairs.estimate[j]), (pairs.reference[i], pairs.reference[j])
        )
        found["moves of 1 s"] = consistency(moves, of_second(t[i]), independent=independent(t[i]))
    return found


def _relative(config: Config, pairs: _Pairs) -> tuple[tuple[Relative, ...], tuple[str, ...]]:
    """Relative errors over all distances asked for, and notes on those that are not to be had."""
    along = {"s": pairs.t - pairs.t[0], "m": trajectory_error.path_length(pairs.reference)}
    asked: list[tuple[Unit, float]] = [("frames", delta) for delta in config.rpe_frames]
    asked.extend(("s", delta) for delta in config.rpe_seconds if pairs.stamped)
    asked.extend(("m", delta) for delta in config.rpe_metres)
    found, notes = [], []
    if config.rpe_seconds and not pairs.stamped:
        notes.append("no timestamps, so no RPE over seconds")
    for unit, delta in asked:
        try:
            rpe = trajectory_error.rpe(
                pairs.estimate, pairs.reference, delta, config.align, along=along.get(unit)
            )
        except DataError:
            notes.append(f"RPE over {_distance(delta, unit)}: no two poses are that far apart, to a tenth")
        else:
            found.append(Relative(float(delta), unit, rpe.translation_m, rpe.rotation_deg, rpe.pairs))
    return tuple(found), tuple(notes)


def _distance(delta: float, unit: Unit) -> str:
    return f"{delta:g} {'frame' if unit == 'frames' and delta == 1 else unit}"


def _row(name: str, unit: str, statistics: Statistics) -> tuple[str, ...]:
    values = (statistics.rmse, statistics.mean, statistics.median, statistics.max)
    return (name, unit, *("free" if np.isnan(value) else f"{value:.6f}" for value in values))


def _line(name: str, text: str) -> str:
    return f"  {name:<10} {text}"

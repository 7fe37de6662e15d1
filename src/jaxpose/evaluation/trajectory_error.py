"""How far an estimate is from the ground truth: alignment, trajectory errors, image error. numpy, float64.

Poses are camera-to-world (or body-to-world) matrices, matched row by row. Rows with a NaN or an infinity in
either input carry no information: they are left out and counted, never an error by themselves.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxpose._checks import check_finite, check_shapes
from jaxpose.errors import DataError
from jaxpose.geometry import rigid
from jaxpose.geometry.rigid import Similarity, nearest_rotation, rotation_angle

Alignment = Literal["none", "se3", "sim3"]


class Statistics(NamedTuple):
    """Summary of per-frame errors, in their unit; `std` is that of the population (divided by n)."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


class Ate(NamedTuple):
    """Absolute trajectory error [m]: distances between camera centres after alignment."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    errors: Float[np.ndarray, " n"]  # one per row of the input, NaN where left out
    alignment: Similarity  # estimate -> reference
    frames: int  # rows used
    skipped: int  # rows left out for a NaN or an infinity


class Rpe(NamedTuple):
    """Relative pose error over equal stretches: drift of translation [m] and of rotation [deg]."""

    translation_m: Statistics
    rotation_deg: Statistics
    translation_errors_m: Float[np.ndarray, " p"]  # one per pair, NaN where left out
    rotation_errors_deg: Float[np.ndarray, " p"]
    pairs: int
    skipped: int


class PoseErrors(NamedTuple):
    """Errors of camera poses after a similarity; means over views, then one value per row of the input.

    Lengths are in the reference's unit; rows left out for a NaN or an infinity are NaN.
    """

    rotation_deg: float
    translation: float  # between world-to-camera translation vectors, as BARF reports it
    centre: float  # between camera centres
    rotation_errors_deg: Float[np.ndarray, " n"]
    translation_errors: Float[np.ndarray, " n"]
    centre_errors: Float[np.ndarray, " n"]
    alignment: Similarity  # estimate -> reference
    frames: int  # rows used
    skipped: int


def umeyama(
    estimate: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "n 3"], with_scale: bool
) -> Similarity:
    """The rigid map (similarity if `with_scale`) of points closest to others, in the sum of squares.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. It
    is a minimum for any input, but not the only one for points on a line, about which the rotation stays
    free, nor for points all in one place, where the rotation is then the identity and the scale 1.

    Args:
        estimate: Points (n, 3) [m].
        reference: Points (n, 3) [m], matched row by row.
        with_scale: Whether the scale is free.

    Returns:
        The map from the estimate to the reference.

    Raises:
        DataError: Unless there is a point and all are finite.
        ValueError: For other shapes.

    >>> points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> umeyama(points, 2 * points + 1, with_scale=True).translation.round(9).tolist()
    [1.0, 1.0, 1.0]
    """
    check_shapes(estimate=(estimate, "n 3"), reference=(reference, "n 3"))
    if len(estimate) == 0 or not (np.isfinite(estimate).all() and np.isfinite(reference).all()):
        raise DataError(f"alignment: expected finite points, at least one, got {len(estimate)} rows")
    center_estimate, estimate = _centered(estimate)
    center_reference, reference = _centered(reference)
    covariance = reference.T @ estimate
    rotation = nearest_rotation(covariance)
    size = np.sum(estimate**2)
    scale = float(np.sum(rotation * covariance) / size) if with_scale and size > 0 else 1.0
    return Similarity(scale, rotation, center_reference - scale * rotation @ center_estimate)


def align(alignment: Similarity, T_ref_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Move poses by a similarity; centres are scaled, rotations stay rotations.

    Args:
        alignment: From the poses' world to another.
        T_ref_cam: Poses (n, 4, 4), camera-to-world.

    Returns:
        Poses (n, 4, 4) in the other world.

    Raises:
        ValueError: For another shape.
    """
    check_shapes(T_ref_cam=(T_ref_cam, "n 4 4"))
    aligned = np.array(T_ref_cam, np.float64)
    aligned[:, :3, :3] = alignment.rotation @ T_ref_cam[:, :3, :3]
    aligned[:, :3, 3] = alignment.apply(T_ref_cam[:, :3, 3])
    return aligned


def align_trajectory(
    estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"], alignment: Alignment
) -> Similarity:
    """The map of estimated camera centres onto the reference: nothing, rigid or with scale.

    Args:
        estimate: Poses (n, 4, 4); rows with NaN, here or in the reference, are left out.
        reference: Poses (n, 4, 4), matched row by row.
        alignment: "none" (the identity), "se3" or "sim3".

    Returns:
        The map from the estimate's world to the reference's. Centres on a line are aligned; `umeyama` says
        what stays free.

    Raises:
        DataError: Where an alignment is asked of fewer than three usable poses: it would fit them perfectly
            and mean nothing.
        ValueError: For another name, and for other shapes.
    """
    if alignment not in get_args(Alignment):
        raise ValueError(f"alignment: expected {', '.join(get_args(Alignment))}, got {alignment!r}")
    used = _usable(estimate, reference)
    least = 1 if alignment == "none" else 3
    if used.sum() < least:
        raise DataError(
            f"alignment {alignment}: expected at least {least} pairs of finite poses, got {used.sum()}"
        )
    if alignment == "none":
        return Similarity(1.0, np.eye(3), np.zeros(3))
    return umeyama(estimate[used, :3, 3], reference[used, :3, 3], with_scale=alignment == "sim3")


def ate(
    estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"], alignment: Alignment = "se3"
) -> Ate:
    """Absolute trajectory error of matched poses after an alignment of their camera centres.

    Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.

    Args:
        estimate: Poses (n, 4, 4), camera- or body-to-world [m]; rows with NaN are left out.
        reference: Ground truth (n, 4, 4), matched row by row.
        alignment: What the estimate's world is free of: "none", "se3" or "sim3".

    Returns:
        Distances [m] between the centres and their statistics.

    Raises:
        DataError: For too few usable rows, as `align_trajectory`.
        ValueError: For another name, and for other shapes.

    >>> T = np.tile(np.eye(4), (4, 1, 1))
    >>> T[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]]
    >>> moved = T + np.array([[0, 0, 0, 5.0], [0] * 4, [0] * 4, [0] * 4])
    >>> round(ate(moved, T).rmse, 9), ate(moved, T, "none").rmse
    (0.0, 5.0)
    """
    similarity = align_trajectory(estimate, reference, alignment)
    used = _usable(estimate, reference)
    errors = np.full(len(used), np.nan)
    aligned = align(similarity, estimate[used])
    errors[used] = np.linalg.norm(aligned[:, :3, 3] - reference[used, :3, 3], axis=-1)
    frames = int(used.sum())
    return Ate(*statistics(errors), errors, similarity, frames, len(used) - frames)


def rpe(
    estimate: Float[np.ndarray, "n 4 4"],
    reference: Float[np.ndarray, "n 4 4"],
    delta: int | float = 1,
    alignment: Alignment = "se3",
    *,
    along: Float[np.ndarray, " n"] | None = None,
) -> Rpe:
    """Relative pose error over every pair of rows some way apart, overlapping pairs included.

    Motions relative to a frame are free of any rigid alignment, so "none" and "se3" agree; "sim3" scales the
    estimate first. Sturm et al., IROS 2012.

    Args:
        estimate: Poses (n, 4, 4); pairs with NaN are left out.
        reference: Ground truth (n, 4, 4), matched row by row.
        delta: How far apart a pair is: rows (i, i + delta), or in the unit of `along`.
        alignment: "none", "se3" or "sim3".
        along: A number for each row (n,) that never decreases, such as its timestamp or the path travelled
            until then (`path_length`): row i is paired with the later row whose number is nearest to along[i]
            + delta, if that is at most a tenth of `delta` off.

    Returns:
        Errors of translation [m] and rotation [deg] of each pair, and their statistics.

    Raises:
        ValueError: For `delta` below 1 frame or not positive, and for arrays of other shapes.
        DataError: Without a usable pair.
    """
    if along is None and not (delta >= 1 and delta == int(delta)):
        raise ValueError(f"rpe: expected delta of at least 1 frame, got {delta}")
    if not delta > 0:
        raise ValueError(f"rpe: expected a positive delta, got {delta}")
    if along is not None:
        check_shapes(estimate=(estimate, "n 4 4"), along=(along, "n"))
        check_finite(along=along)
        for row in np.flatnonzero(np.diff(along) < 0) + 1:
            raise ValueError(
                f"along: expected numbers that never decrease, got {along[row]} after {along[row - 1]}"
            )
    scale = align_trajectory(estimate, reference, "sim3").scale if alignment == "sim3" else 1.0
    frames = np.arange(float(len(estimate)))
    first, last = _pairs(frames, delta, 0) if along is None else _pairs(along, delta, 0.1 * delta)
    usable = _usable(estimate, reference)
    used = np.logical_and(usable[first], usable[last])
    if not used.any():
        apart = "frames apart" if along is None else "apart (within a tenth)"
        raise DataError(
            f"relative pose error: expected two finite poses {delta:g} {apart}, got {len(estimate)} poses"
        )
    moved, ground_truth = (rigid.inverse(T[first[used]]) @ T[last[used]] for T in (estimate, reference))
    moved[:, :3, 3] *= scale
    translation, rotation = np.full((2, len(used)), np.nan)
    # The error's translation is this difference turned into the reference's last frame: of the same length.
    translation[used] = np.linalg.norm(moved[:, :3, 3] - ground_truth[:, :3, 3], axis=-1)
    rotation[used] = np.degrees(rotation_angle(moved[:, :3, :3], ground_truth[:, :3, :3]))
    pairs = int(used.sum())
    return Rpe(statistics(translation), statistics(rotation), translation, rotation, pairs, len(used) - pairs)


def path_length(T_world_cam: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """The distance travelled until each row, straight from one finite pose to the next.

    Args:
        T_world_cam: Poses (n, 4, 4) [m]; rows with NaN count as standing still.

    Returns:
        Distances (n,) [m], never decreasing.

    Raises:
        ValueError: For another shape.

    >>> T = np.tile(np.eye(4), (3, 1, 1))
    >>> T[:, 0, 3] = [0.0, 3.0, 1.0]
    >>> path_length(T).tolist()
    [0.0, 3.0, 5.0]
    """
    check_shapes(T_world_cam=(T_world_cam, "n 4 4"))
    finite = np.isfinite(T_world_cam).all((1, 2))
    centres = np.asarray(T_world_cam[finite, :3, 3], np.float64)
    steps = np.linalg.norm(np.diff(centres, axis=0, prepend=centres[:1]), axis=1)
    distance = np.zeros(len(T_world_cam))
    distance[finite] = np.cumsum(steps)
    return np.maximum.accumulate(distance)


def procrustes(estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]) -> Similarity:
    """The similarity of BARF's evaluation, which maps estimated camera centres onto the reference's.

    Unlike `umeyama` its scale is the ratio of the centres' spreads, so it does not shrink a bad estimate.
    What the centres leave free (cameras on a line, or all in one place) is settled by the orientations; where
    the estimate is all in one place the scale is 1. Lin et al., "BARF", ICCV 2021, section 4.2.

    Args:
        estimate: Poses (n, 4, 4); rows with NaN are left out.
        reference: Poses (n, 4, 4), matched row by row.

    Returns:
        The map from the estimate's world to the reference's.

    Raises:
        DataError: For fewer than three pairs of finite poses.
        ValueError: For other shapes.
    """
    used = _usable(estimate, reference)
    if used.sum() < 3:
        raise DataError(f"pose errors: expected at least 3 pairs of finite poses, got {used.sum()}")
    estimate, reference = estimate[used], reference[used]
    center_estimate, points = _centered(estimate[:, :3, 3])
    center_reference, targets = _centered(reference[:, :3, 3])
    spread, target_spread = np.sqrt(np.sum(points**2)), np.sqrt(np.sum(targets**2))
    covariance = targets.T @ points / (spread * target_spread or 1)
    orientations = np.mean(reference[:, :3, :3] @ estimate[:, :3, :3].swapaxes(1, 2), axis=0)
    # So faint that it decides only where the centres do not.
    rotation = nearest_rotation(covariance + 1e-9 * orientations)
    scale = float(target_spread / spread) if spread > 0 else 1.0
    return Similarity(scale, rotation, center_reference - scale * rotation @ center_estimate)


def pose_errors(estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]) -> PoseErrors:
    """Errors of camera poses after `procrustes`, as BARF evaluates (Lin et al., ICCV 2021).

    BARF's own formula of the angle cannot tell angles below 0.026 degrees from 0, `rigid.rotation_angle` can.
    A world-to-camera vector turns with the camera, so `translation` also holds a share of the rotation error
    that grows with the distance to the origin; `centre` does not.

    Args:
        estimate: Poses (n, 4, 4), camera-to-world; rows with NaN are left out.
        reference: Ground truth (n, 4, 4), matched row by row.

    Returns:
        Errors of each view, and their means.

    Raises:
        DataError: For fewer than three pairs of finite poses.
        ValueError: For other shapes.
    """
    alignment = procrustes(estimate, reference)
    used = _usable(estimate, reference)
    aligned, ground_truth = align(alignment, estimate[used]), np.asarray(reference[used], np.float64)
    rotation, translation, centre = np.full((3, len(used)), np.nan)
    rotation[used] = np.degrees(rotation_angle(aligned[:, :3, :3], ground_truth[:, :3, :3]))
    vectors = [rigid.inverse(T)[:, :3, 3] for T in (aligned, ground_truth)]
    translation[used] = np.linalg.norm(vectors[0] - vectors[1], axis=-1)
    centre[used] = np.linalg.norm(aligned[:, :3, 3] - ground_truth[:, :3, 3], axis=-1)
    mean = lambda values: float(np.mean(values[used]))
    frames = int(used.sum())
    means = mean(rotation), mean(translation), mean(centre)
    return PoseErrors(*means, rotation, translation, centre, alignment, frames, len(used) - frames)


def statistics(errors: Float[np.ndarray, " n"]) -> Statistics:
    """Summary of errors.

    Args:
        errors: (n,), in any unit; NaN is left out.

    Returns:
        In the same unit; all NaN if nothing is left.

    >>> statistics(np.array([3.0, np.nan, 4.0])).mean
    3.5
    """
    errors = errors[~np.isnan(errors)]
    if not len(errors):
        return Statistics(*[float("nan")] * 6)
    rmse, median = np.sqrt(np.mean(errors**2)), np.median(errors)
    numbers = (rmse, errors.mean(), median, errors.std(), errors.min(), errors.max())
    return Statistics(*map(float, numbers))


def _centered(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "n 3"]]:
    """Mean and deviations; deviations that are only the mean's rounding (a camera at rest) are zero."""
    points = np.asarray(points, np.float64)
    center = points.mean(0)
    deviations = points - center
    at_rest = np.abs(deviations).max() <= 1e-13 * np.abs(center).max()
    return center, np.zeros_like(points) if at_rest else deviations


def _usable(
    estimate: Float[np.ndarray, "n 4 4"], reference: Float[np.ndarray, "n 4 4"]
) -> Bool[np.ndarray, " n"]:
    """Rows that are finite in both; DataError for different numbers of rows, which would broadcast."""
    if estimate.shape != reference.shape:
        raise DataError(f"trajectories: expected matched poses, got {estimate.shape} and {reference.shape}")
    check_shapes(estimate=(estimate, "n 4 4"))
    return np.asarray(np.isfinite(np.concatenate([estimate, reference], -1)).all((1, 2)))


def _pairs(
    along: Float[np.ndarray, " n"], delta: int | float, tolerance: int | float
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Rows and their partners about `delta` further along; of equally near ones the first."""
    after = np.searchsorted(along, along + delta)
    before = np.searchsorted(along, along[np.maximum(after - 1, 0)])
    after = np.minimum(after, len(along) - 1)
    off = [np.asarray(np.abs(along[partner] - along - delta)) for partner in (before, after)]
    partner = np.where(off[0] <= off[1], before, after)
    close = (np.minimum(*off) <= tolerance) & (partner > np.arange(len(along)))
    return np.flatnonzero(close), partner[close]

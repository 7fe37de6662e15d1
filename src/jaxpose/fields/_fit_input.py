"""What `fields.fit` is given: refused where nothing can come of it, completed where it is left open."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxpose._checks import check_finite, check_increasing, check_shapes
from jaxpose.fields import numpy_evaluator
from jaxpose.fields._bspline import unbroken_quaternions
from jaxpose.fields._posenet import PoseNet, PoseNetConfig, posenet
from jaxpose.fields.composition import Composition, constant, right_correction
from jaxpose.fields.types import Factor, PoseField

_RIGID = 1e-2  # how far R^T R may be from the identity
_OUTSIDE = 1e-6  # of the span: what a timestamp may be outside of it


def checked_poses(
    times: ArrayLike, poses: ArrayLike
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Both as float64 numpy arrays; ValueError for what no field can be fitted to."""
    t, T = np.asarray(times, np.float64), np.asarray(poses, np.float64)
    check_shapes(times=(t, "n"), poses=(T, "n 4 4"))
    if len(t) == 0:
        raise ValueError("poses: expected at least one, got none")
    check_increasing(times=t)
    check_finite(poses=T)
    R = T[:, :3, :3]
    off = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bad = (off > _RIGID) | (np.linalg.det(R) < 0) | (np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1) > _RIGID)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"poses: expected rigid transforms, got one at index {i} whose R^T R is off the identity by "
            f"{off[i]:.3g}, determinant {np.linalg.det(R[i]):.3g}, last row {T[i, 3].tolist()}"
        )
    return t, T


def check_span(field: PoseField, t: Float[np.ndarray, " n"]) -> None:
    """ValueError for timestamps [s] outside of a field's span, and for a single one of a field that moves."""
    first, last = field.span
    if not np.isfinite([first, last]).all():
        return
    slack = _OUTSIDE * (last - first)
    if t[0] < first - slack or t[-1] > last + slack:
        raise ValueError(
            f"times: expected within the field's span, {first} to {last} s, got {t[0]} to {t[-1]} s"
        )
    if first < last and len(t) < 2:
        raise ValueError("poses: expected at least two for a field that moves, got one")


def check_bounds(field: PoseField, t, T) -> None:
    """ValueError for poses that a PoseNet's head cannot reach, alone or as a correction of known poses."""
    description = field.description
    if isinstance(description, Composition) and description.kind.endswith("correction"):
        left = description.kind == "left_correction"
        net, known = description.fields if left else description.fields[::-1]
        if known.description is None:
            return
        initial = np.linalg.inv(evaluated(known.description.factors(()), t))
        T = T @ initial if left else initial @ T
        description = net.description
    if not isinstance(description, PoseNet) or description.config.head != "paper":
        return
    reach, scale = float(np.abs(T[:, :3, 3]).max()), description.translation_scale
    if reach >= scale:
        raise ValueError(
            f"poses: expected translations within {scale:g} m, the PoseNet's translation_scale, got "
            f"{reach:.4g} m; give `fit` the PoseNetConfig without a translation_scale, and it chooses one"
        )
    real = unbroken_quaternions(T)[:, 0]
    real = real if real[0] > 0 else -real
    if real.min() <= 0:
        i = int(np.argmax(real <= 0))
        raise ValueError(
            "poses: expected rotations below 180 degrees from the field's reference, the bound of a "
            f"PoseNet with head='paper', got a turn past it at index {i} ({t[i]} s); use head='free' or a "
            "B-spline"
        )


def posenet_for(config: PoseNetConfig, t, T) -> PoseField:
    """A PoseNet about the middle of the poses, with the span and the scale that they ask for."""
    if len(t) < 2:
        raise ValueError("poses: expected at least two for a field that moves, got one")
    middle = np.eye(4)
    low, high = T[:, :3, 3].min(axis=0), T[:, :3, 3].max(axis=0)
    quaternion = unbroken_quaternions(T).mean(axis=0)
    middle[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    middle[:3, 3] = (low + high) / 2
    half = float(np.abs(np.linalg.inv(middle) @ T)[:, :3, 3].max())
    span = (float(t[0]), float(t[-1])) if config.span is None else config.span
    scale = config.translation_scale
    if scale is None:
        scale = 2 * half if half > 0 else 1.0
    net = posenet(replace(config, span=span, translation_scale=scale))
    return right_correction(net, initial=constant(middle))


def evaluated(factors: tuple[Factor, ...], t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """The poses that factors of a field, whatever arrays they hold, describe at times [s], in float64."""
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    for factor in factors:
        numbers = {k: np.asarray(v, float) if k != "kind" else v for k, v in factor.items()}
        poses = poses @ numpy_evaluator.evaluate(numbers, t)
    return poses

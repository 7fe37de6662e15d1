"""A continuous trajectory as one file, `field.npz`, that `jaxpose.fields.numpy_evaluator` reads without JAX.

The pose at time t is a product of factors, factor 0 . factor 1 . ..., camera-to-world. The file holds

    version     1, that of this description
    span        (2,) the first and last time [s]; before and after it the trajectory stands still
    count       how many factors there are; each entry of factor K is named "K." and then
    kind        "posenet", "bspline", "table" or "stamped"

    posenet     span [s], mapped to -1 and 1; weights, one for each octave of the time encoding; activation;
                head ("paper": the seven outputs pass through tanh, and the quaternion's first is turned
                over; "free"); translation_scale; NETWORK.LAYER.kernel and .bias, where NETWORK is translation
                and rotation, or coupled. Where a kernel has more rows than features come in, the encoding is
                appended to them.
    bspline     span [s]; control_points (n, 7): position and quaternion wxyz less (1, 0, 0, 0), the first one
                knot interval before the span
    table       times (n,) [s]; poses (n, 4, 4): that of the nearest timestamp, the earlier of two equally
                near (`fields.per_frame_poses`)
    stamped     times (n,) [s]; poses (n, 4, 4): constant twist between timestamps, at rest before and
                after (`fields.piecewise_geodesic`; with one timestamp `fields.constant`)

Where it is known how sure the pose is, the file holds too

    covariance_times   (m,) increasing [s]
    covariance         (m, 6, 6) at those times, to be interpolated: of the increment [translation, rotation]
                       (m, rad) on the right of the pose, along and about the camera's own axes
    relative_covariance   (k, 6, 6) at the first k of those times: the same of the pose one second later, seen
                       from the pose
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxpose._checks import check_shapes
from jaxpose.fields import _bspline, _per_frame, _posenet, composition
from jaxpose.fields._entries import VERSION, read_entries
from jaxpose.fields.types import Factor, Params, PoseField
from jaxpose.files.atomic import atomic
from jaxpose.files.untrusted import reading
from jaxpose.geometry.rigid import Similarity

_FROM_FACTOR = {
    "posenet": _posenet.from_factor,
    "bspline": _bspline.from_factor,
    "table": _per_frame.from_factor,
    "stamped": composition.from_factor,
}


class Covariances(NamedTuple):
    """How sure a trajectory is, of increments [translation, rotation] [m, rad] on the right."""

    t: Float[np.ndarray, " m"]  # [s], increasing
    pose: Float[np.ndarray, "m 6 6"]
    second: Float[np.ndarray, "k 6 6"]  # of the pose a second later seen from it, at the first k times


def save(
    path: Path | str,
    field: PoseField,
    params: Params,
    *,
    alignment: Similarity | None = None,
    covariance: Covariances | None = None,
) -> None:
    """Write a field with its parameters to a file, as this module describes it.

    Args:
        path: a name that ends in `.npz`.
        field: any field of this package or composition of such; `PoseField(init, pose)` of functions alone
            cannot be saved.
        params: its parameters.
        alignment: what the poses are moved by, as `trajectory_error.align` does: scaled, turned and moved.
        covariance: how sure the pose is, where that is known.

    Raises:
        ValueError: the field, or a part of it, has no description.
    """
    if field.description is None:
        raise ValueError("save: expected a field with a description, got one of functions alone")
    factors = field.description.factors(params)
    if alignment is not None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = alignment.rotation, alignment.translation
        moved = {"kind": "stamped", "times": np.zeros(1), "poses": T[None]}
        factors = (moved, *(_scaled(factor, alignment.scale) for factor in factors))
    known = {}
    if covariance is not None:
        check_shapes(t=(covariance.t, "m"), pose=(covariance.pose, "m 6 6"))
        check_shapes(second=(covariance.second, "k 6 6"))
        lengths = np.repeat([1.0 if alignment is None else alignment.scale, 1.0], 3)
        units = np.outer(lengths, lengths)
        known = {"covariance_times": covariance.t, "covariance": covariance.pose * units}
        if len(covariance.second):
            known["relative_covariance"] = covariance.second * units
    entries = {f"{k}.{name}": value for k, factor in enumerate(factors) for name, value in factor.items()}
    with atomic(path) as temporary:
        np.savez(
            temporary,
            allow_pickle=False,
            version=VERSION,
            span=np.asarray(field.span, np.float64),
            count=len(factors),
            **entries,
            **known,
        )


def load(path: Path | str) -> tuple[PoseField, Params]:
    """The field and the parameters of a file that `save` wrote.

    Args:
        path: a `field.npz`, such as every run leaves.

    Returns:
        The field and its parameters in the default floating-point type: the field itself where the file holds
        one factor, else a `fields.product`. What only concerns how it was trained is not in the file.

    Raises:
        DataError: the file holds no trajectory of this version.
    """
    data = read_entries(path)
    parts = []
    for number in range(int(data["count"])):
        name = f"{number}."
        factor = {k.removeprefix(name): value for k, value in data.items() if k.startswith(name)}
        with reading(path, "a trajectory"):
            parts.append(_FROM_FACTOR[str(factor["kind"])](factor))
    if len(parts) == 1:
        return parts[0]
    fields, params = zip(*parts, strict=True)
    return composition.product(*fields), params


def _scaled(factor: Factor, scale: float) -> Factor:
    """The factor with lengths times `scale`; so scaled, a product of factors is scaled as a whole."""
    scaled = dict(factor)
    if "translation_scale" in factor:
        scaled["translation_scale"] = scale * factor["translation_scale"]
    if "control_points" in factor:
        scaled["control_points"] = factor["control_points"] * np.array([scale] * 3 + [1.0] * 4)
    if "poses" in factor:
        scaled["poses"] = np.array(factor["poses"], np.float64)
        scaled["poses"][:, :3, 3] *= scale
    return scaled

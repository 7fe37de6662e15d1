"""What `field.npz` holds, read and checked; without JAX."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxpose.errors import DataError
from jaxpose.files.schema import (
    FARTHEST_M,
    LATEST_S,
    check_version,
    choice,
    increasing,
    numbers,
    rigid_transforms,
)
from jaxpose.files.untrusted import read_npz

VERSION = 1
_MOST_OCTAVES, _MOST_WEIGHT = 64, 1e6
_SHORTEST_S = 1e-9  # of what a field is stretched over


def read_entries(path: Path | str) -> dict[str, np.ndarray]:
    """Read the entries of a trajectory.

    Args:
        path: a `field.npz`.

    Returns:
        Its entries by name, in the types of the file.

    Raises:
        DataError: naming file and entry, for another file, and for what gives no finite poses.
    """
    data = read_npz(path, "a trajectory")
    check_version(path, data, VERSION, "a trajectory")
    _check_span(path, data, "span", above=False)
    for number in range(int(numbers(path, data, "count", whole=True, least=1, most=len(data)))):
        name = f"{number}."
        kind = choice(path, data, f"{name}kind", tuple(_CHECKS))
        _CHECKS[kind](path, data, name)
    if "covariance" in data or "relative_covariance" in data:
        _check_covariances(path, data)
    return data


def _check_span(path: Path | str, data: Mapping, key: str, *, above: bool = True) -> None:
    first, last = numbers(path, data, key, (2,), least=-LATEST_S, most=LATEST_S)
    if not last - first >= (_SHORTEST_S if above else 0):
        raise DataError(f"{path}: {key}: expected two increasing times, got {first:g} and {last:g}")


def _check_posenet(path: Path | str, data: Mapping, name: str) -> None:
    _check_span(path, data, f"{name}span")
    octaves = len(numbers(path, data, f"{name}weights", (None,), least=0, most=1))
    if octaves > _MOST_OCTAVES:
        raise DataError(f"{path}: {name}weights: expected up to {_MOST_OCTAVES}, got {octaves}")
    choice(path, data, f"{name}activation", ("relu", "softplus", "sigmoid"))
    choice(path, data, f"{name}head", ("paper", "free"))
    numbers(path, data, f"{name}translation_scale", above=0, most=FARTHEST_M)
    coupled = f"{name}coupled.0.kernel" in data
    for network, outputs in (("coupled", 7),) if coupled else (("translation", 3), ("rotation", 4)):
        encoded = features = 1 + 2 * octaves
        layers = sum(key.startswith(f"{name}{network}.") and key.endswith(".kernel") for key in data)
        for layer in range(max(layers, 1)):
            key = f"{name}{network}.{layer}."
            rows, columns = numbers(
                path, data, f"{key}kernel", (None, None), least=-_MOST_WEIGHT, most=_MOST_WEIGHT
            ).shape
            numbers(path, data, f"{key}bias", (columns,), least=-_MOST_WEIGHT, most=_MOST_WEIGHT)
            if rows not in (features, features + encoded):
                raise DataError(f"{path}: {key}kernel: expected {features} rows, got {rows}")
            features = columns
        if features != outputs:
            raise DataError(f"{path}: {name}{network}: expected {outputs} outputs, got {features}")


def _check_bspline(path: Path | str, data: Mapping, name: str) -> None:
    _check_span(path, data, f"{name}span")
    key = f"{name}control_points"
    points = numbers(path, data, key, (None, 7), least=-FARTHEST_M, most=FARTHEST_M)
    if len(points) < 4:
        raise DataError(f"{path}: {key}: expected 4 or more, got {len(points)}")
    norm = np.linalg.norm(points[:, 3:] + [1, 0, 0, 0], axis=1)
    for row in np.flatnonzero((norm < 1e-6) | (norm > _MOST_WEIGHT)):
        raise DataError(f"{path}: {key}: expected quaternions, got a norm of {norm[row]:g} in row {row}")


def _check_stamped(path: Path | str, data: Mapping, name: str) -> None:
    t = numbers(path, data, f"{name}times", (None,))
    if len(t) == 0:
        raise DataError(f"{path}: {name}times: expected one or more, got none")
    increasing(path, f"{name}times", t)
    rigid_transforms(path, f"{name}poses", numbers(path, data, f"{name}poses", (len(t), 4, 4)))


def _check_covariances(path: Path | str, data: Mapping) -> None:
    t = numbers(path, data, "covariance_times", (None,))
    increasing(path, "covariance_times", t)
    for key in ("covariance", "relative_covariance"):
        if key not in data:
            continue
        found = numbers(path, data, key, (None, 6, 6))
        least = max(len(t), 1) if key == "covariance" else 1  # few times have a second after them
        if not least <= len(found) <= len(t):
            raise DataError(f"{path}: {key}: expected one for each of {len(t)} times, got {len(found)}")
        sigma = np.sqrt(np.maximum(np.diagonal(found, axis1=1, axis2=2), 0))
        most = sigma[:, :, None] * sigma[:, None] * (1 + 1e-3) + 1e-30  # no correlation is above one
        off = np.abs(found - np.swapaxes(found, 1, 2)) > 1e-3 * most
        if off.any() or (np.abs(found) > most).any():
            raise DataError(f"{path}: {key}: expected covariances, got entries that no covariance has")


_CHECKS = {
    "posenet": _check_posenet,
    "bspline": _check_bspline,
    "table": _check_stamped,
    "stamped": _check_stamped,
}

"""A continuous trajectory, `field.npz`, at any time. It needs numpy alone: copy it."""

import numpy as np


def load(path):
    """The trajectory of a file, in float64.

    Args:
        path: a `field.npz`, or a dict of what it holds.

    Returns:
        A function of times (n,) [s] to camera-to-world poses (n, 4, 4). Before its first time and after its
        last, `span` in the file, the trajectory stands still.

    Raises:
        ValueError: another file.
    """
    if not isinstance(path, dict):
        with np.load(path, allow_pickle=False) as file:
            if not np.array_equal(file.get("version", "none"), 1):
                found = " ".join(str(file.get("version", "none")).split())[:40]
                raise ValueError(f"{path}: expected a trajectory of version 1, got {found}")
            return load(dict(file))
    data = {k: v.astype(float) if v.dtype.kind == "f" else v for k, v in path.items()}
    names = [f"{number}." for number in range(int(data["count"]))]
    factors = [{k.removeprefix(name): v for k, v in data.items() if k.startswith(name)} for name in names]

    def pose(t):
        t = np.clip(np.atleast_1d(np.asarray(t, float)), *data["span"])
        T = np.tile(np.eye(4), (len(t), 1, 1))
        for factor in factors:
            T = T @ evaluate(factor, t)
        return T

    return pose


def load_covariance(path, name="covariance"):
    """How sure a trajectory is.

    Args:
        path: a `field.npz` of a run that knows, or a dict of what it holds.
        name: "covariance", of the pose, or "relative_covariance", of the move in the second that follows.

    Returns:
        A function of times (n,) [s] to covariances (n, 6, 6) of the increment [translation, rotation] (m,
        rad) on the right. It raises a ValueError for times beyond those that are known.

    Raises:
        ValueError: a file without covariances.
    """
    if not isinstance(path, dict):
        with np.load(path, allow_pickle=False) as file:
            if name not in file:
                raise ValueError(f"{path}: expected {name}, got a trajectory without")
            return load_covariance(dict(file), name)
    times, known = path["covariance_times"][: len(path[name])], path[name]

    def covariance(t):
        t = np.atleast_1d(np.asarray(t, float))
        if not ((t >= times[0] - 1e-6) & (t <= times[-1] + 1e-6)).all():  # a file's digits
            raise ValueError(f"t: expected times between {times[0]:.6g} and {times[-1]:.6g} s, got {t}")
        j = np.clip(np.searchsorted(times, t, side="right"), 1, max(len(times) - 1, 1)) % len(times)
        i = np.maximum(j - 1, 0)
        share = np.clip((t - times[i]) / np.maximum(times[j] - times[i], 1e-9), 0, 1)[:, None, None]
        return (1 - share) * known[i] + share * known[j]

    return covariance


def evaluate(factor, t):
    """One factor of a trajectory.

    Args:
        factor: its entries in the file, with `kind`, as float64 arrays.
        t: times (n,) [s] within its span.

    Returns:
        Poses (n, 4, 4).
    """
    return _KINDS[str(factor["kind"])](factor, t)


def _posenet(p, t):
    tau = (2 * t - p["span"].sum()) / (p["span"][1] - p["span"][0])
    phase = np.pi * tau[:, None] * 2.0 ** np.arange(len(p["weights"]))
    x, out = np.hstack([tau[:, None], np.sin(phase) * p["weights"], np.cos(phase) * p["weights"]]), []
    activation = _ACTIVATIONS[str(p["activation"])]
    for name in ["coupled"] if "coupled.0.kernel" in p else ["translation", "rotation"]:
        hidden, layers = x, sum(k.startswith(name) and k.endswith("kernel") for k in p)
        for layer in range(layers):
            kernel, hidden = p[f"{name}.{layer}.kernel"], activation(hidden) if layer else hidden
            skips = len(kernel) != hidden.shape[1]  # such a layer takes the encoding again
            hidden = np.hstack([hidden, x] if skips else [hidden]) @ kernel + p[f"{name}.{layer}.bias"]
        out.append(hidden)
    out = np.tanh(np.hstack(out)) * [1, 1, 1, -1, 1, 1, 1] if str(p["head"]) == "paper" else np.hstack(out)
    return _transform(out[:, 3:] + [1, 0, 0, 0], p["translation_scale"] * out[:, :3])


def _bspline(p, t):
    points, (first, last) = p["control_points"], p["span"]
    control = _transform(points[:, 3:] + [1, 0, 0, 0], points[:, :3])
    place = (t - first) * ((len(points) - 3) / (last - first))
    row = np.clip(np.floor(place), 0, len(points) - 4).astype(int)
    s, T, (used, at) = place - row, control[row], np.unique(row, return_inverse=True)
    for k, weight in enumerate((5 + s * (3 + s * (s - 3)), 1 + s * (3 + s * (3 - 2 * s)), s**3)):
        T = T @ _exp(weight[:, None] / 6 * _log(np.linalg.inv(control[used + k]) @ control[used + k + 1])[at])
    return T


def _per_frame_poses(p, t):
    return p["poses"][np.searchsorted((p["times"][1:] + p["times"][:-1]) / 2, t)]


def _piecewise_geodesic(p, t):
    times, poses = p["times"], p["poses"]
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0))
    j = np.minimum(i + 1, len(times) - 1)
    share = np.clip((t - times[i]) / np.where(j > i, times[j] - times[i], 1), 0, 1)
    return poses[i] @ _exp(share[:, None] * _log(np.linalg.inv(poses[i]) @ poses[j]))


def _transform(q, position):  # of a quaternion wxyz of any length
    T, scale = np.tile(np.eye(4), (len(q), 1, 1)), 2 / (q * q).sum(1)
    T[:, :3, :3], T[:, :3, 3] = _turn(q[:, 1:], scale * q[:, 0], scale), position
    return T


def _turn(v, a, b):  # I + a hat(v) + b hat(v)^2
    W = np.cross(np.eye(3), v[:, None])
    return np.eye(3) + a[:, None, None] * W + b[:, None, None] * W @ W


def _shift(phi):  # (n, 3, 3): how far unit velocities come in unit time while turning by phi
    angle = np.linalg.norm(phi, axis=1) / np.pi
    c = (1 - np.sinc(angle)) / np.maximum((np.pi * angle) ** 2, 1e-12)
    return _turn(phi, 0.5 * np.sinc(angle / 2) ** 2, c)


def _exp(xi):
    half = np.linalg.norm(xi[:, 3:], axis=1, keepdims=True) / 2
    q = np.hstack([np.cos(half), np.sinc(half / np.pi) / 2 * xi[:, 3:]])
    return _transform(q, (_shift(xi[:, 3:]) @ xi[:, :3, None])[..., 0])


def _log(T):
    R, trace, K = T[:, :3, :3], np.trace(T[:, :3, :3], axis1=1, axis2=2)[:, None, None], np.empty_like(T)
    K[:, 0, :1], K[:, 1:, 1:] = 1 + trace[:, 0], R + R.swapaxes(1, 2) + (1 - trace) * np.eye(3)
    K[:, 0, 1:] = K[:, 1:, 0] = (R.swapaxes(1, 2) - R)[:, [1, 2, 0], [2, 0, 1]]
    q = K[np.arange(len(T)), K.diagonal(0, 1, 2).argmax(1)]  # K is 4 q q^T of the quaternion; its surest row
    sine, side = np.linalg.norm(q[:, 1:], axis=1, keepdims=True), np.where(q[:, :1] < 0, -1, 1)
    phi = 2 * side * np.arctan2(sine, side * q[:, :1]) / np.maximum(sine, 1e-300) * q[:, 1:]
    return np.hstack([np.linalg.solve(_shift(phi), T[:, :3, 3:])[..., 0], phi])


_KINDS = {"posenet": _posenet, "bspline": _bspline, "table": _per_frame_poses, "stamped": _piecewise_geodesic}
_ACTIVATIONS = {"relu": lambda h: np.maximum(h, 0), "softplus": lambda h: np.logaddexp(h, 0)}
_ACTIVATIONS["sigmoid"] = lambda h: (1 + np.tanh(h / 2)) / 2

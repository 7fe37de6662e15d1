"""Tests of poses by themselves: jumps, and the order in which quaternions are written."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose.cli.check.findings import Checked, Fact, Finding
from jaxpose.geometry import rigid

Order = Literal["xyzw", "wxyz"]
_JUMP = 10.0  # times what 95% of the steps stay below
_LEAST_TURN = 0.2  # rad between some two poses, for their order to show
_SIGN_FLIPS = 3  # of quaternions, without which nothing made one column positive
_MORE_EXPLAINED = 0.15  # share of the positions' variance
_BY_CHANCE = 5.2  # over the times that the positions cross their mean: independent motions stay below it
_SURE, _LEFT = 0.8, 3.0  # a share that tells by itself, if the given order leaves so many times more
_MOST = 2000  # poses looked at
_OFF_NORM = 1e-2


class Quaternions(NamedTuple):
    """Four columns as they stand in a file, and the order in which its format has them."""

    values: Float[np.ndarray, "n 4"]
    order: Order


def reorder(T: Float[np.ndarray, "n 4 4"], read_as: Order) -> Float[np.ndarray, "n 4 4"]:
    """Poses whose quaternions were read as `read_as`, but written in the other order."""
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    meant = T.copy()
    meant[:, :3, :3] = Rotation.from_quat(np.roll(xyzw, -1 if read_as == "xyzw" else 1, axis=1)).as_matrix()
    return meant


def check_poses(
    t: Float[np.ndarray, " n"] | None, T: Float[np.ndarray, "n 4 4"], written: Quaternions | None = None
) -> Checked:
    """Path, extent and speed of finite poses, jumps among them, and the order of their quaternions."""
    position = T[:, :3, 3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    extent = np.ptp(position, axis=0)
    text = f"path {steps.sum():.4g} m, extent {' x '.join(f'{x:.3g}' for x in extent)} m"
    numbers = {"path_m": float(steps.sum()), "extent_m": float(extent.max())}
    findings = []
    if len(T) > 2 and t is not None:
        # Motion capture writes some timestamps too close together: those make no speed.
        speed = steps / np.maximum(np.diff(t), np.median(np.diff(t)))
        fast = float(np.quantile(speed, 0.95))
        text += f", 95% of the speeds below {fast:.3g} m/s"
        numbers["speed_95_m_s"] = fast
        jumps = np.flatnonzero(speed > _JUMP * fast)
        if len(jumps) and fast > 0:
            worst = int(jumps[speed[jumps].argmax()])
            findings.append(
                Finding(
                    "warning",
                    "jumps",
                    f"{len(jumps)} beyond, the largest {steps[worst]:.3g} m after {t[worst] - t[0]:.4g} s",
                    f"steps at up to {_JUMP:g} times the speed of 95% of them ({fast:.3g} m/s)",
                    "cut the trajectory there, or leave these poses out",
                )
            )
        else:
            findings.append(Finding("ok", "jumps", f"none above {_JUMP:g} x {fast:.3g} m/s"))
    if written is not None:
        findings += _quaternions(T, written)
    return Checked((Fact("motion", text, numbers),), tuple(findings))


def _quaternions(T: Float[np.ndarray, "n 4 4"], written: Quaternions) -> list[Finding]:
    """Whether the numbers are unit quaternions in the order that the format has.

    The other order turns every rotation into its inverse between two constant ones: neighbours are as close
    as before, and only what the poses have to do with the world tells.
    """
    findings = []
    norm = np.linalg.norm(written.values, axis=1)
    off = int((np.abs(norm - 1) > _OFF_NORM).sum())
    if off:
        found = f"{off} of another norm, from {norm.min():.3g} to {norm.max():.3g}"
        findings.append(Finding("warning", "quaternions", found, "unit quaternions", "check the columns"))
    other: Order = "wxyz" if written.order == "xyzw" else "xyzw"
    signs = _other_order(T, written, other)
    if signs:
        found = f"signs of {other}: {'; '.join(signs)}"
        fix = f"write quaternions as {written.order}"
        return [
            *findings,
            Finding("warning", "quaternion order", found, f"quaternions {written.order}", fix),
        ]
    return [*findings, Finding("ok", "quaternion order", f"nothing speaks against {written.order}")]


def _other_order(T: Float[np.ndarray, "n 4 4"], written: Quaternions, other: Order) -> list[str]:
    """What speaks for the other order, in words."""
    values, own = written.values, 3 if written.order == "xyzw" else 0
    reasons = []
    first = np.abs(values[0])
    if first[3 - own] == 1 and not T[0, :3, 3].any() and (first != 1).sum() == 3:
        reasons.append("the first pose, at the origin, is then the identity, not half a turn")
    flips = int(((values[1:] * values[:-1]).sum(1) < 0).sum())
    signed = (values.min(0) < 0) & (values.max(0) > 0)
    if flips >= _SIGN_FLIPS and signed.sum() == 3 and not signed[3 - own] and values[:, 3 - own].min() >= 0:
        reasons.append(
            f"column {4 - own} of 4 is never negative, though signs flip {flips} times, as writers make w"
        )
    some = T[:: max(1, len(T) // _MOST)]
    turn = rigid.rotation_angle(some[0, :3, :3], some[:, :3, :3])
    if turn.max() > _LEAST_TURN and np.ptp(T[:, :3, 3], axis=0).any():
        given, meant = _explained(some), _explained(reorder(some, written.order))
        chance = _BY_CHANCE / max(_crossings(T), 1)
        sure = meant > _SURE and 1 - given > _LEFT * (1 - meant)
        if meant > given + _MORE_EXPLAINED and (sure or meant > chance):
            reasons.append(
                f"turning about one point then explains {meant:.0%} of the positions, not {given:.0%}"
            )
    return reasons


def _explained(T: Float[np.ndarray, "n 4 4"]) -> float:
    """Share of the positions' variance that a lever explains: p = centre + R lever, by least squares."""
    design = np.concatenate([np.tile(np.eye(3), (len(T), 1)), T[:, :3, :3].reshape(-1, 3)], axis=1)
    wanted = T[:, :3, 3].reshape(-1)
    left = wanted - design @ np.linalg.lstsq(design, wanted, rcond=None)[0]
    return 1 - float(left @ left / ((T[:, :3, 3] - T[:, :3, 3].mean(0)) ** 2).sum())


def _crossings(T: Float[np.ndarray, "n 4 4"]) -> float:
    """How often the positions cross their mean, over the axes: about as many samples are independent."""
    centred = T[:, :3, 3] - T[:, :3, 3].mean(0)
    return float((np.diff(np.sign(centred), axis=0) != 0).sum(0).mean())

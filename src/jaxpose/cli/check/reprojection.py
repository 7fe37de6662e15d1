"""Axis convention, direction, depth scale and clock: depth must be met where the poses carry it."""

from functools import partial

import numpy as np

from jaxpose.cli.check.findings import Checked, Finding
from jaxpose.cli.check.poses import reorder
from jaxpose.cli.check.views import Views, agreement, look
from jaxpose.datasets.photos.common import OPENGL
from jaxpose.datasets.types import Recording
from jaxpose.geometry import rigid
from jaxpose.imu.simulation import interpolant

# x forward, y left, z up: the axes of robots' bodies, from those of OpenCV.
_ROBOT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_GIVEN = "camera-to-world poses, OpenCV axes"
_CONVENTIONS = {
    _GIVEN: lambda T: T,
    "camera-to-world poses, OpenGL axes": lambda T: T @ OPENGL,
    "camera-to-world poses, axes forward, left, up": lambda T: T @ _ROBOT,
    "world-to-camera poses, OpenCV axes": np.linalg.inv,
    "world-to-camera poses, OpenGL axes": lambda T: rigid.inverse(T) @ OPENGL,
    "world-to-camera poses, axes forward, left, up": lambda T: rigid.inverse(T) @ _ROBOT,
    "quaternions in the order wxyz, read as xyzw": partial(reorder, read_as="xyzw"),
    "quaternions in the order xyzw, read as wxyz": partial(reorder, read_as="wxyz"),
}
_PER_METRE = (1000.0, 5000.0, 6553.5)  # of 7-Scenes and most others, of TUM, of Replica
_SCALES = np.array(sorted({a / b for a in _PER_METRE for b in _PER_METRE} | {1e-3, 1e3}))
_TOLERANCE = 0.02  # of the depth
_BETTER, _TIMES = 0.04, 1.1  # by how much, and how many times, more points have to agree
_FEW = 0.2  # of the points that land in the other image; nothing fits
_SAME = 0.03  # shares this near are not told apart
_LEAST_PAIRS = 4  # of frames that agree better

_LEAST_HZ = 10.0  # of the frames, so that poses between them can be had
_OFFSETS_S = np.arange(-20, 21) * 0.01
_LEAST_OFFSET_S = 0.02
_FINE = 0.015  # of the depth: an offset moves points by little


def check_reprojection(recording: Recording) -> Checked:
    """Which convention of the poses, which depth scale and which clock the depth images agree with."""
    views = look(recording)
    if views is None or recording.T_world_cam is None:
        return Checked(notes=("no two true poses: conventions and depth scale are not tested",))
    test, told = "poses and depth", f"in {len(views.pairs)} pairs of frames"
    of_all, in_view = _scores(views, recording.T_world_cam)
    share = of_all.mean(0)
    names, given = tuple(_CONVENTIONS), (0, int(np.flatnonzero(_SCALES == 1)[0]))
    best = tuple(int(k) for k in np.unravel_index(share.argmax(), share.shape))
    wins, loses = (of_all[:, *best] > of_all[:, *given]).sum(), (of_all[:, *best] < of_all[:, *given]).sum()
    more = share[best] > max(share[given] + _BETTER, _TIMES * share[given])
    if more and wins >= max(_LEAST_PAIRS, 2 * loses) and in_view.mean(0)[best] >= _FEW:
        scale = float(_SCALES[best[1]])
        words, mend = [], []
        if best[0] != given[0]:
            words, mend = [names[best[0]]], ["convert the poses"]
        if scale != 1:
            words, mend = [*words, _scale(scale)], [*mend, f"multiply the depth by {scale:.4g}"]
        found = f"{' and '.join(words)}: so {share[best]:.0%} of the depth agrees within {_TOLERANCE:.0%}, "
        found += f"as read {share[given]:.0%}, {told}"
        expected = f"{_GIVEN}, depth in metres"
        return Checked((), (Finding("warning", test, found, expected, " and ".join(mend)),))
    if in_view.mean(0)[given] < _FEW:
        found = f"{in_view.mean(0)[given]:.0%} of the depth in the other image's view agreeing, {told}, and "
        found += "no other convention fits"
        fix = "check that poses belong to these frames, depth to this colour camera, and the intrinsics"
        return Checked((), (Finding("warning", test, found, "poses that carry depth onto depth", fix),))
    others = np.delete(share, given[0], axis=0).max(1)
    scales = np.delete(share[given[0]], given[1]).max()
    found = f"{_GIVEN}, and the depth's scale fit: {share[given]:.0%} of the depth agrees within "
    found += f"{_TOLERANCE:.0%} {told}; next {names[1 + others.argmax()]} {others.max():.0%}, "
    found += f"another scale {scales:.0%}"
    notes = []
    if max(others.max(), scales) > share[given] - _SAME:
        notes.append("the camera moves too little for depth to tell all conventions or scales apart")
    return Checked((), (Finding("ok", test, found), *_clock(recording, views)), tuple(notes))


def _scale(scale: float) -> str:
    """In words what depth has to be multiplied by."""
    if scale in (1e3, 1e-3):
        return f"depth {'1/1000' if scale > 1 else '1000'} of the poses' unit"
    read, meant = next((a, b) for a in _PER_METRE for b in _PER_METRE if a / b == scale)
    size = f"{1 / scale:.4g} times too large" if scale < 1 else f"{scale:.4g} times too small"
    return f"depth scale {meant:g} for {read:g} (depth is {size})"


def _scores(views: Views, T_given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the points that agree, of all and of those in view: by pair, convention and scale."""
    used = sorted({i for pair in views.pairs for i in pair})
    of_all = np.zeros((len(views.pairs), len(_CONVENTIONS), len(_SCALES)))
    in_view = np.zeros_like(of_all)
    for c, convention in enumerate(_CONVENTIONS.values()):
        T = dict(zip(used, convention(T_given[used]), strict=True))
        for p, (i, j) in enumerate(views.pairs):
            T_j_i = np.tile(rigid.inverse(T[j]) @ T[i], (len(_SCALES), 1, 1))
            of_all[p, c], in_view[p, c] = agreement(views, p, T_j_i, _SCALES, _TOLERANCE)
    return of_all, in_view


def _clock(recording: Recording, views: Views) -> list[Finding]:
    """Whether images agree better with the poses of another time."""
    t, T = recording.t, recording.T_world_cam
    if T is None or 1 / np.median(np.diff(t)) < _LEAST_HZ or len(t) < 4:
        return []
    path = interpolant(t, T)
    at = lambda i: path.pose(np.clip(t[i] + _OFFSETS_S, path.first, path.last))
    ones = np.ones(len(_OFFSETS_S))
    shares = np.stack(
        [
            agreement(views, p, rigid.inverse(at(j)) @ at(i), ones, _FINE)[0]
            for p, (i, j) in enumerate(views.pairs)
        ]
    )
    best, given = int(shares.mean(0).argmax()), len(_OFFSETS_S) // 2
    offset, share = float(_OFFSETS_S[best]), shares.mean(0)
    wins, loses = (shares[:, best] > shares[:, given]).sum(), (shares[:, best] < shares[:, given]).sum()
    told = f"{share[best]:.0%} of the depth agrees within {_FINE:.1%}, as read {share[given]:.0%}"
    if abs(offset) >= _LEAST_OFFSET_S and share[best] > share[given] + _SAME and wins > 3 * loses:
        side = "later" if offset > 0 else "earlier"
        found = f"images that fit the poses of {1e3 * abs(offset):.0f} ms {side}: "
        fix = f"add {offset:.2f} s to the timestamps of the images"
        expected = "images and poses by one clock"
        return [Finding("warning", "clock of poses", found + told, expected, fix)]
    return [Finding("ok", "clock of poses", "images fit the poses of their own time best, or as well")]

"""Axis convention, direction and depth scale: depth of one frame must be met where the poses carry it."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxpose.commands.check_findings import Checked, Finding
from jaxpose.commands.check_poses import reorder
from jaxpose.data.photographs import OPENGL
from jaxpose.metrics import rotation_angle_deg
from jaxpose.recording import Recording

# x forward, y left, z up: the axes of robots' bodies, from those of OpenCV.
_ROBOT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_GIVEN = ("camera-to-world poses, OpenCV axes", 1.0)
_CONVENTIONS = {
    _GIVEN[0]: lambda T: T,
    "camera-to-world poses, OpenGL axes": lambda T: T @ OPENGL,
    "camera-to-world poses, axes forward, left, up": lambda T: T @ _ROBOT,
    "world-to-camera poses, OpenCV axes": np.linalg.inv,
    "world-to-camera poses, OpenGL axes": lambda T: np.linalg.inv(T) @ OPENGL,
    "world-to-camera poses, axes forward, left, up": lambda T: np.linalg.inv(T) @ _ROBOT,
    "quaternions in the order wxyz, read as xyzw": partial(reorder, read_as="xyzw"),
    "quaternions in the order xyzw, read as wxyz": partial(reorder, read_as="wxyz"),
}
_PER_METRE = (1000.0, 5000.0, 6553.5)  # of 7-Scenes and most others, of TUM, of Replica
_SCALES = tuple(sorted({a / b for a in _PER_METRE for b in _PER_METRE} | {1e-3, 1e3}))
_ANCHORS = 8
_MOST_TURN_DEG = 20.0  # between two frames, so that they see the same
_COLUMNS = 64  # of the pixels looked at
_TOLERANCE = 0.03  # of the depth
_BETTER, _TIMES = 0.04, 1.1  # by how much, and how many times, more points have to agree
_FEW = 0.15  # of the points that land in the other image; nothing fits
_SAME = 0.03  # shares this near are not told apart


class _Scores(NamedTuple):
    """For each convention and scale: share of the points that agree, of all and of those in view."""

    of_all: Float[np.ndarray, "pairs c s"]
    in_view: Float[np.ndarray, "c s"]


def check_reprojection(recording: Recording) -> Checked:
    """Which convention of the poses and which depth scale the depth images agree with."""
    test = "poses and depth"
    pairs = [] if recording.T_world_cam is None else _pairs(recording.T_world_cam)
    if not pairs:
        return Checked(notes=("no two true poses: conventions and depth scale are not tested",))
    scores = _scores(recording, pairs)
    share = scores.of_all.mean(0)
    names = tuple(_CONVENTIONS)
    given = (0, _SCALES.index(1.0))
    best = tuple(int(k) for k in np.unravel_index(share.argmax(), share.shape))
    wins = (scores.of_all[:, *best] > scores.of_all[:, *given]).sum()
    loses = (scores.of_all[:, *best] < scores.of_all[:, *given]).sum()
    told = f"in {len(pairs)} pairs of frames"
    if share[best] > max(share[given] + _BETTER, _TIMES * share[given]) and wins > 2 * loses:
        words = ([] if best[0] == given[0] else [names[best[0]]]) + _scale(_SCALES[best[1]])
        found = f"{' and '.join(words)}: so {share[best]:.0%} of the depth agrees within {_TOLERANCE:.0%}, "
        found += f"as read {share[given]:.0%}, {told}"
        fix = " and ".join(
            ([] if best[0] == given[0] else ["convert the poses"])
            + ([] if _SCALES[best[1]] == 1 else [f"multiply the depth by {_SCALES[best[1]]:.4g}"])
        )
        return Checked((), (Finding("warning", test, found, f"{_GIVEN[0]}, depth in metres", fix),))
    if scores.in_view[given] < _FEW:
        found = f"{scores.in_view[given]:.0%} of the depth in the other image's view agreeing, {told}, and "
        found += "not more under any convention that was tried"
        fix = "check that poses belong to these frames, depth to this colour camera, and the intrinsics"
        return Checked((), (Finding("warning", test, found, "poses that carry depth onto depth", fix),))
    others = share.copy()
    others[given[0]] = -1
    runner = int(others.max(1).argmax())
    scales = np.delete(share[given[0]], given[1])
    found = f"{_GIVEN[0]}, and the depth's scale fit: {share[given]:.0%} of the depth agrees within "
    found += (
        f"{_TOLERANCE:.0%} {told}; next {names[runner]} {others.max():.0%}, another scale {scales.max():.0%}"
    )
    notes = []
    if max(others.max(), scales.max()) > share[given] - _SAME:
        notes.append("the camera moves too little for depth to tell all conventions or scales apart")
    return Checked((), (Finding("ok", test, found),), tuple(notes))


def _scale(scale: float) -> list[str]:
    if scale == 1:
        return []
    if scale in (1e3, 1e-3):
        return [f"depth {'1/1000' if scale > 1 else '1000'} of the poses' unit"]
    read, meant = next((a, b) for a in _PER_METRE for b in _PER_METRE if a / b == scale)
    return [f"depth scale {meant:g} for {read:g} (or {1 / scale:.4g} times too large)"]


def _pairs(T: Float[np.ndarray, "n 4 4"]) -> list[tuple[int, int]]:
    """Frames here and there, each with up to three later ones that it has not turned far from.

    The angle between two poses is the same under all conventions, so the choice favours none.
    """
    usable = np.flatnonzero(np.isfinite(T).all((1, 2)))
    if len(usable) < 2:
        return []
    pairs = set()
    for k in np.linspace(0, 0.9 * (len(usable) - 1), _ANCHORS).astype(int):
        later = usable[k + 1 :]
        turn = rotation_angle_deg(np.repeat(T[usable[k], None, :3, :3], len(later), 0), T[later, :3, :3])
        far = int((turn > _MOST_TURN_DEG).argmax()) if (turn > _MOST_TURN_DEG).any() else len(later)
        pairs |= {(int(usable[k]), int(later[max(1, far // part) - 1])) for part in (1, 2, 4)}
    return sorted(pairs)


def _scores(recording: Recording, pairs: list[tuple[int, int]]) -> _Scores:
    import jax
    import jax.numpy as jnp

    from jaxpose import camera as lens

    camera = recording.camera
    step = max(1, camera.width // _COLUMNS)
    pixels = np.mgrid[0 : camera.height : step, 0 : camera.width : step].reshape(2, -1)
    rays = np.asarray(
        lens.pixel_direction(camera, jnp.asarray(np.stack([pixels[1], pixels[0]], -1), jnp.float32))
    )
    project = jax.jit(partial(lens.project, camera))
    depth = {i: recording.read(i).depth for i in sorted({i for pair in pairs for i in pair})}
    used = np.unique([i for pair in pairs for i in pair])
    place = {int(i): k for k, i in enumerate(used)}
    shape = (len(pairs), len(_CONVENTIONS), len(_SCALES))
    agree, seen, valid = np.zeros(shape), np.zeros(shape), np.zeros(len(pairs))
    for c, convention in enumerate(_CONVENTIONS.values()):
        T = convention(recording.T_world_cam[used])  # pyright: ignore[reportOptionalSubscript]
        for p, (i, j) in enumerate(pairs):
            T_j_i = np.linalg.inv(T[place[j]]) @ T[place[i]]
            near = depth[i][pixels[0], pixels[1]]
            valid[p] = (near > 0).sum()
            points = rays * near[:, None]
            moved = np.stack([s * points @ T_j_i[:3, :3].T + T_j_i[:3, 3] for s in _SCALES])
            at = np.asarray(project(jnp.asarray(moved, jnp.float32)))
            row, column, inside = _nearest_pixel(at, camera.width, camera.height)
            there = depth[j][row, column] * np.array(_SCALES)[:, None]
            both = inside & (near > 0) & (there > 0)
            close = both & (np.abs(moved[..., 2] - there) < _TOLERANCE * there)
            agree[p, c], seen[p, c] = close.sum(1), both.sum(1)
    return _Scores(agree / np.maximum(valid, 1)[:, None, None], agree.sum(0) / np.maximum(seen.sum(0), 1))


def _nearest_pixel(
    at: Float[np.ndarray, "s n 2"], width: int, height: int
) -> tuple[Int[np.ndarray, "s n"], Int[np.ndarray, "s n"], np.ndarray]:
    """Row and column of the pixel, 0 outside, and which are inside."""
    u, v = np.round(at[..., 0]), np.round(at[..., 1])
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int), inside

"""Bundle adjustment: against the truth, against scipy on the same problem, among wrong matches, from afar."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxpose.evaluation.trajectory_error import align, pose_errors, procrustes
from jaxpose.geometry import rigid
from jaxpose.structure import Tracks, adjust

FOCAL = 200.0


def around(count: int, radius: float = 4.0, degrees: float = 360.0) -> np.ndarray:
    """Cameras on a wavy part of a circle that look at the origin."""
    angle = np.linspace(0, np.radians(degrees), count, endpoint=False)
    height = 0.6 * np.sin(2 * angle)
    centre = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    forward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return rigid.make(np.stack([right, np.cross(forward, right), forward], axis=-1), centre)


def seen(T: np.ndarray, points: np.ndarray, random, noise_px: float = 0.0, wrong: float = 0.0, share=0.6):
    """Tracks of points, each in a share of the cameras; some of the matches lead anywhere."""
    view, point = np.nonzero(random.random((len(T), len(points))) < share)
    at = np.einsum("oji,oj->oi", T[view, :3, :3], points[point] - T[view, :3, 3])
    xy = at[:, :2] / at[:, 2:] + random.normal(0, noise_px / FOCAL, (len(view), 2))
    lost = random.random(len(view)) < wrong
    xy[lost] = random.uniform(-0.3, 0.3, (lost.sum(), 2))
    return Tracks(view, point, xy, len(T), FOCAL)


def disturbed(T: np.ndarray, random, metres: float, radians: float) -> np.ndarray:
    return T @ rigid.exp(
        np.concatenate([random.normal(0, metres, (len(T), 3)), random.normal(0, radians, (len(T), 3))], 1)
    )


def test_poses_far_off_are_found_among_wrong_matches():
    random = np.random.default_rng(0)
    T, points = around(20), random.uniform(-1, 1, (150, 3))
    tracks = seen(T, points, random, noise_px=0.2, wrong=0.1)
    start = disturbed(T, random, 0.8, 0.3)
    assert pose_errors(start, T).rotation_deg > 15
    found = adjust(tracks, start, depth=4.0)
    assert found is not None and found.supported.all()
    errors = pose_errors(found.T_world_cam, T)
    assert errors.rotation_deg < 0.1 and errors.centre < 0.01
    assert found.noise_px == pytest.approx(0.2, rel=0.25)
    assert_allclose(np.median(found.depth), 4.0, rtol=0.1)


def test_against_scipy():
    """The same reprojection errors, without wrong matches, by another solver: the same least loss."""
    random = np.random.default_rng(1)
    T, points = around(6, degrees=120), random.uniform(-1, 1, (30, 3))
    tracks = seen(T, points, random, noise_px=0.5, share=1.0)
    found = adjust(tracks, disturbed(T, random, 0.05, 0.02), depth=4.0)

    def residual(x):
        poses, places = x[:36].reshape(6, 6), x[36:].reshape(-1, 3)
        R = Rotation.from_rotvec(poses[tracks.view, 3:]).as_matrix()
        at = np.einsum("oji,oj->oi", R, places[tracks.point] - poses[tracks.view, :3])
        off = FOCAL * (at[:, :2] / at[:, 2:] - tracks.xy_cam)
        ratio = (off**2).sum(1, keepdims=True) / (3 * found.noise_px) ** 2
        return (off / np.sqrt(1 + ratio)).ravel()  # Geman and McClure's, as sums of squares

    turns = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    best = least_squares(
        residual, np.concatenate([np.concatenate([T[:, :3, 3], turns], 1).ravel(), points.ravel()])
    )
    mine = Rotation.from_matrix(found.T_world_cam[:, :3, :3]).as_rotvec()
    ours = np.concatenate(
        [np.concatenate([found.T_world_cam[:, :3, 3], mine], 1).ravel(), found.points.ravel()]
    )
    assert (residual(ours) ** 2).sum() < 1.005 * (best.fun**2).sum()


def test_all_cameras_may_start_in_one_place():
    """As for photographs without poses: a forward-facing scene; the depth settles the scale."""
    random = np.random.default_rng(2)
    centres = np.concatenate([random.uniform(-0.6, 0.6, (12, 2)), np.zeros((12, 1))], axis=1)
    T = rigid.make(rigid.so3_exp(random.normal(0, 0.05, (12, 3))), centres)
    points = np.concatenate([random.uniform(-2, 2, (200, 2)), random.uniform(3, 8, (200, 1))], axis=1)
    found = adjust(seen(T, points, random, noise_px=0.2), np.tile(np.eye(4), (12, 1, 1)), depth=5.0)
    assert pose_errors(found.T_world_cam, T).rotation_deg < 0.1
    assert_allclose(np.median(found.depth), 5.0)
    moved = align(procrustes(found.T_world_cam, T), found.T_world_cam)
    assert_allclose(moved[:, :3, 3], T[:, :3, 3], atol=0.02)


def test_photographs_that_share_nothing_keep_their_poses():
    random = np.random.default_rng(3)
    T, points = around(12), random.uniform(-1, 1, (80, 3))
    tracks = seen(T, points, random)
    kept = tracks.view != 5
    tracks = tracks._replace(view=tracks.view[kept], point=tracks.point[kept], xy_cam=tracks.xy_cam[kept])
    start = disturbed(T, random, 0.05, 0.02)
    found = adjust(tracks, start, depth=4.0)
    assert_allclose(np.flatnonzero(~found.supported), [5])
    assert_allclose(found.T_world_cam[5], start[5])
    none = tracks._replace(view=np.zeros(0, int), point=np.zeros(0, int), xy_cam=np.zeros((0, 2)))
    assert adjust(none, start, depth=4.0) is None


def test_bad_input():
    tracks = seen(around(5), np.zeros((3, 3)), np.random.default_rng(0), share=1.0)
    with pytest.raises(ValueError, match=r"T_start: expected shape \(5, 4, 4\), got \(4, 4, 4\)"):
        adjust(tracks, around(4), depth=4.0)
    with pytest.raises(ValueError, match="depth: expected more than 0, got 0"):
        adjust(tracks, around(5), depth=0.0)
    with pytest.raises(ValueError, match="T_start: "):
        adjust(tracks, np.full((5, 4, 4), np.nan), depth=4.0)

"""Pose errors: gauge freedom, BARF's arithmetic again, degenerate cameras."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.geometry import rigid


def random_poses(rng, count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def disturbed(rng, T, translation, rotation):
    """Poses moved at random by about these lengths and angles [rad]."""
    noise = np.tile(np.eye(4), (len(T), 1, 1))
    noise[:, :3, :3] = Rotation.from_rotvec(rotation * rng.normal(size=(len(T), 3))).as_matrix()
    noise[:, :3, 3] = translation * rng.normal(size=(len(T), 3))
    return T @ noise


def moved(rng, T):
    """The same cameras in another world: turned, scaled, shifted."""
    similarity = rigid.Similarity(
        float(rng.uniform(0.2, 5)), Rotation.random(rng=rng).as_matrix(), 3 * rng.normal(size=3)
    )
    return trajectory_error.align(similarity, T)


def barf(estimate, reference):
    """BARF's evaluation by its description, on world-to-camera poses: mean angle [deg], mean length."""
    X0, X1 = reference[:, :3, 3], estimate[:, :3, 3]
    t0, t1 = X0.mean(0), X1.mean(0)
    s0, s1 = (np.sqrt(((X - t) ** 2).sum(-1).mean()) for X, t in ((X0, t0), (X1, t1)))
    U, _, Vt = np.linalg.svd(((X0 - t0) / s0).T @ ((X1 - t1) / s1))
    R = U @ Vt
    assert np.linalg.det(R) > 0
    centres = (X1 - t1) / s1 @ R.T * s0 + t0
    aligned = np.linalg.inv(estimate)[:, :3, :3] @ R.T
    ground_truth = np.linalg.inv(reference)
    vectors = -np.einsum("nij,nj->ni", aligned, centres)
    cosine = (np.trace(aligned @ ground_truth[:, :3, :3].swapaxes(1, 2), axis1=1, axis2=2) - 1) / 2
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angles.mean(), np.linalg.norm(vectors - ground_truth[:, :3, 3], axis=1).mean()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [0.01, 0.3])
def test_agrees_with_barf(seed, size):
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, 30)
    estimate = moved(rng, disturbed(rng, reference, size, size))
    ours = trajectory_error.pose_errors(estimate, reference)
    rotation, translation = barf(estimate, reference)
    assert ours.rotation_deg == pytest.approx(rotation, rel=1e-6)
    assert ours.translation == pytest.approx(translation, rel=1e-6)
    assert (ours.frames, ours.skipped) == (30, 0)


@pytest.mark.parametrize("seed", range(3))
def test_another_world_is_no_error_and_small_angles_are_seen(seed):
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, 12)
    same = trajectory_error.pose_errors(moved(rng, reference), reference)
    assert max(same.rotation_deg, same.translation, same.centre) < 1e-12 * 180
    turned = reference.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ Rotation.from_rotvec([0, 1e-5, 0], degrees=True).as_matrix()
    ours = trajectory_error.pose_errors(moved(rng, turned), reference)
    assert ours.rotation_deg == pytest.approx(1e-5, rel=1e-6)  # far below BARF's clamp
    assert ours.centre < 1e-12


def test_translation_holds_the_lever_arm_and_centre_does_not():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, 3] = 4 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    turned = T.copy()
    turned[:, :3, :3] = Rotation.from_rotvec([0, 0, 2.0], degrees=True).as_matrix()
    ours = trajectory_error.pose_errors(turned, T)
    assert ours.rotation_deg == pytest.approx(2)
    assert ours.centre == pytest.approx(0, abs=1e-8)
    assert ours.translation == pytest.approx(2 * 4 * np.sin(np.radians(1)))  # a chord of radius 4


def test_unusable_rows_are_left_out():
    rng = np.random.default_rng(0)
    reference = random_poses(rng, 10)
    estimate = moved(rng, disturbed(rng, reference, 0.1, 0.1))
    whole = trajectory_error.pose_errors(np.delete(estimate, [2, 5], 0), np.delete(reference, [2, 5], 0))
    estimate[2], reference[5] = np.nan, np.inf
    ours = trajectory_error.pose_errors(estimate, reference)
    assert ours[:3] == pytest.approx(whole[:3])
    assert (ours.frames, ours.skipped) == (8, 2)
    assert list(np.flatnonzero(np.isnan(ours.centre_errors))) == [2, 5]
    with pytest.raises(DataError, match="at least 3 pairs of finite poses, got 2"):
        trajectory_error.pose_errors(estimate[:3], reference[:3])


@pytest.mark.parametrize("seed", range(3))
def test_cameras_on_a_line_are_aligned_by_their_orientations(seed):
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, 9)
    reference[:, :3, 3] = np.linspace(0, 2, 9)[:, None] * [1.0, 2.0, -1.0]
    ours = trajectory_error.pose_errors(moved(rng, reference), reference)
    assert ours.rotation_deg < 1e-5
    assert ours.translation < 1e-6


def test_an_estimate_all_in_one_place_keeps_its_scale_and_takes_the_mean_orientation():
    rng = np.random.default_rng(1)
    reference = disturbed(rng, np.tile(np.eye(4), (20, 1, 1)), 1.0, 0.05)  # forward-facing
    start = np.tile(np.eye(4), (20, 1, 1))  # poses unknown
    start[:, :3, :3] = Rotation.from_rotvec([0.0, 3.0, 0.0]).as_matrix()
    ours = trajectory_error.pose_errors(start, reference)
    assert ours.alignment.scale == 1
    spread = np.linalg.norm(reference[:, :3, 3] - reference[:, :3, 3].mean(0), axis=1).mean()
    assert ours.centre == pytest.approx(spread)
    mean = Rotation.from_matrix(reference[:, :3, :3]).mean()
    deviations = (mean.inv() * Rotation.from_matrix(reference[:, :3, :3])).magnitude()
    assert ours.rotation_deg == pytest.approx(np.degrees(deviations).mean(), rel=1e-6)

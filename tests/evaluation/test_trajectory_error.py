"""Metrics against the evo package on real trajectories, closed forms, and inputs that go wrong."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.evaluation import image_quality, trajectory_error
from jaxpose.geometry import rigid

PAIRS = [
    ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
    ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt"),
    ("fr2_desk_groundtruth.txt", "fr2_desk_ORB.txt"),
]
SEEDS = st.integers(0, 10_000)


def random_poses(rng, count):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def random_similarity(rng, scale=None):
    rotation = Rotation.random(rng=rng).as_matrix()
    return rigid.Similarity(scale or float(rng.uniform(0.2, 5)), rotation, 3 * rng.normal(size=3))


# --- against evo --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=PAIRS, ids=[estimate for _, estimate in PAIRS])
def real(request, data_dir):
    """Ground truth and estimate associated by evo, as its trajectories and as plain pose arrays."""
    from evo.core import sync
    from evo.tools import file_interface

    ground_truth, estimate = (
        file_interface.read_tum_trajectory_file(data_dir / "trajectories" / name) for name in request.param
    )
    ground_truth, estimate = sync.associate_trajectories(ground_truth, estimate, max_diff=0.02)
    return ground_truth, estimate, np.array(ground_truth.poses_se3), np.array(estimate.poses_se3)


def assert_same_statistics(ours, evo_metric):
    from evo.core.metrics import StatisticsType

    for name in trajectory_error.Statistics._fields:
        assert getattr(ours, name) == pytest.approx(evo_metric.get_statistic(StatisticsType[name]), abs=1e-6)


@pytest.mark.data
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_ate_agrees_with_evo(real, alignment):
    import copy

    from evo.core.metrics import APE, PoseRelation

    ground_truth, estimate, T_truth, T_estimate = real
    estimate = copy.deepcopy(estimate)
    ours = trajectory_error.ate(T_estimate, T_truth, alignment)
    if alignment != "none":
        rotation, translation, scale = estimate.align(ground_truth, correct_scale=alignment == "sim3")
        np.testing.assert_allclose(ours.alignment.rotation, rotation, atol=1e-6)
        np.testing.assert_allclose(ours.alignment.translation, translation, atol=1e-6)
        assert ours.alignment.scale == pytest.approx(scale, abs=1e-6)
    theirs = APE(PoseRelation.translation_part)
    theirs.process_data((ground_truth, estimate))
    assert_same_statistics(ours, theirs)
    np.testing.assert_allclose(ours.errors, theirs.error, atol=1e-6)
    aligned = trajectory_error.align(ours.alignment, T_estimate)
    angles = APE(PoseRelation.rotation_angle_deg)
    angles.process_data((ground_truth, estimate))
    ours_deg = np.degrees(rigid.rotation_angle(aligned[:, :3, :3], T_truth[:, :3, :3]))
    np.testing.assert_allclose(ours_deg, angles.error, atol=1e-6)


@pytest.mark.data
@pytest.mark.parametrize("delta", [1, 30])
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_rpe_agrees_with_evo(real, delta, alignment):
    import copy

    from evo.core.metrics import RPE, PoseRelation, Unit

    ground_truth, estimate, T_truth, T_estimate = real
    estimate = copy.deepcopy(estimate)
    if alignment != "none":
        estimate.align(ground_truth, correct_scale=alignment == "sim3")
    ours = trajectory_error.rpe(T_estimate, T_truth, delta, alignment)
    for relation, statistics in (
        (PoseRelation.translation_part, ours.translation_m),
        (PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        theirs = RPE(relation, delta=delta, delta_unit=Unit.frames, all_pairs=True)
        theirs.process_data((ground_truth, estimate))
        assert_same_statistics(statistics, theirs)
        assert ours.pairs == len(theirs.error)


@pytest.mark.data
@pytest.mark.parametrize("delta", [0.05, 0.5, 2.0])
@pytest.mark.parametrize("alignment", ["none", "sim3"])
def test_rpe_over_metres_agrees_with_evo(real, delta, alignment):
    import copy

    from evo.core.metrics import RPE, PoseRelation, Unit

    ground_truth, estimate, T_truth, T_estimate = real
    estimate = copy.deepcopy(estimate)
    if alignment != "none":
        estimate.align(ground_truth, correct_scale=True)
    ours = trajectory_error.rpe(
        T_estimate, T_truth, delta, alignment, along=trajectory_error.path_length(T_truth)
    )
    for relation, statistics in (
        (PoseRelation.translation_part, ours.translation_m),
        (PoseRelation.rotation_angle_deg, ours.rotation_deg),
    ):
        theirs = RPE(
            relation,
            delta=delta,
            delta_unit=Unit.meters,
            rel_delta_tol=0.1,
            all_pairs=True,
            pairs_from_reference=True,
        )
        theirs.process_data((ground_truth, estimate))
        assert_same_statistics(statistics, theirs)
        assert ours.pairs == len(theirs.error) > 100


# --- closed forms -------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(SEEDS, st.integers(3, 30))
def test_umeyama_recovers_a_similarity(seed, count):
    rng = np.random.default_rng(seed)
    ground_truth, points = random_similarity(rng), rng.normal(size=(count, 3)) + 10
    found = trajectory_error.umeyama(
        points, ground_truth.scale * points @ ground_truth.rotation.T + ground_truth.translation, True
    )
    # Three random points may lie nearly on a line, where the rotation is poorly determined.
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)[1]
    for ours, theirs in zip(found, ground_truth, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-11 * ground_truth.scale / min(spread, 1) ** 2)


@settings(deadline=None)
@given(SEEDS)
def test_umeyama_is_a_minimum(seed):
    """No nearby rotation, translation or scale fits noisy points better, reflected clouds included."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(6, 3))
    target = points * rng.choice([-1.0, 1.0], 3) + 0.1 * rng.normal(size=(6, 3))
    cost = lambda s, R, t: np.sum((s * points @ R.T + t - target) ** 2)
    scale, rotation, translation = trajectory_error.umeyama(points, target, True)
    assert np.linalg.det(rotation) == pytest.approx(1)
    best = cost(scale, rotation, translation)
    for _ in range(20):
        turn = Rotation.from_rotvec(1e-3 * rng.normal(size=3)).as_matrix()
        assert cost(scale, turn @ rotation, translation) >= best - 1e-12
        assert cost(scale * (1 + 1e-3 * rng.normal()), rotation, translation) >= best - 1e-12
        assert cost(scale, rotation, translation + 1e-3 * rng.normal(size=3)) >= best - 1e-12


def test_rigid_alignment_agrees_with_scipy():
    rng = np.random.default_rng(0)
    points, target = rng.normal(size=(2, 20, 3))
    found = trajectory_error.umeyama(points, target, with_scale=False)
    ground_truth, _ = Rotation.align_vectors(target - target.mean(0), points - points.mean(0))
    assert found.scale == 1
    np.testing.assert_allclose(found.rotation, ground_truth.as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    "alignment, moved_by, expected",
    [("none", 1.0, None), ("se3", 1.0, 0.0), ("se3", 2.0, None), ("sim3", 2.0, 0.0)],
)
def test_ate_is_blind_to_exactly_its_alignment(alignment, moved_by, expected):
    rng = np.random.default_rng(1)
    ground_truth = random_poses(rng, 10)
    result = trajectory_error.ate(
        trajectory_error.align(random_similarity(rng, moved_by), ground_truth), ground_truth, alignment
    )
    assert result.rmse == pytest.approx(expected, abs=1e-12) if expected is not None else result.rmse > 0.1


def test_align_composes_rigidly():
    """`align` with scale 1 is multiplication from the left by the rigid map."""
    rng = np.random.default_rng(2)
    similarity, poses = random_similarity(rng, 1.0), random_poses(rng, 4)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = similarity.rotation, similarity.translation
    np.testing.assert_allclose(trajectory_error.align(similarity, poses), matrix @ poses, atol=1e-14)


@pytest.mark.parametrize("delta", [1, 3])
def test_rpe_of_a_constant_drift(delta):
    """Every frame adds 0.1 m and 2 deg in the camera's own axes: delta frames of it."""
    rng = np.random.default_rng(3)
    step = np.eye(4)
    step[:3, :3] = Rotation.from_euler("z", 2, degrees=True).as_matrix()
    step[:3, 3] = [0, 0, 0.1]
    ground_truth = np.tile(np.eye(4), (9, 1, 1))
    estimate = np.array([np.linalg.matrix_power(step, i) for i in range(9)])
    world = trajectory_error.align(random_similarity(rng, 1.0), estimate)
    result = trajectory_error.rpe(world, ground_truth, delta)
    assert result.translation_m.rmse == pytest.approx(0.1 * delta)
    assert result.rotation_deg.mean == pytest.approx(2 * delta)
    assert result.pairs == 9 - delta


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 0.01, 90.0, 179.99, 180 - 1e-6, 180.0])
def test_rotation_angle_is_accurate_at_both_ends(angle_deg):
    axis = np.array([0.36, -0.48, 0.8])
    start = Rotation.random(rng=np.random.default_rng(4))
    end = start * Rotation.from_rotvec(np.radians(angle_deg) * axis)
    assert np.degrees(rigid.rotation_angle(start.as_matrix(), end.as_matrix())) == pytest.approx(
        angle_deg, abs=1e-9
    )


@settings(deadline=None)
@given(SEEDS)
def test_nearest_rotation_is_the_polar_factor(seed):
    """The rotation of R . P with P symmetric positive definite is R; and never a reflection."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(5, rng=rng).as_matrix()
    A = rng.normal(size=(5, 3, 3))
    P = A @ A.swapaxes(1, 2) + 0.1 * np.eye(3)
    np.testing.assert_allclose(rigid.nearest_rotation(R @ P), R, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rigid.nearest_rotation(A)), 1)


def test_psnr():
    image = np.random.default_rng(5).uniform(size=(8, 9, 3))
    assert image_quality.psnr(image, image) == np.inf
    assert image_quality.psnr(image + 0.1, image) == pytest.approx(20)
    dark, light = np.full((4, 4), 10, np.uint8), np.full((4, 4), 20, np.uint8)
    assert image_quality.psnr(dark, light, peak=255.0) == pytest.approx(20 * np.log10(25.5))


# --- input that goes wrong ----------------------------------------------------------------------------------


def test_poses_with_nan_are_left_out_and_counted():
    rng = np.random.default_rng(6)
    ground_truth = random_poses(rng, 12)
    estimate = trajectory_error.align(random_similarity(rng), ground_truth) + 0.01 * rng.normal(
        size=(12, 4, 4)
    )
    broken_truth, broken_estimate = ground_truth.copy(), estimate.copy()
    broken_truth[2, 0, 0], broken_estimate[7] = np.inf, np.nan
    kept = np.setdiff1d(np.arange(12), [2, 7])
    result, clean = (
        trajectory_error.ate(broken_estimate, broken_truth),
        trajectory_error.ate(estimate[kept], ground_truth[kept]),
    )
    assert (result.rmse, result.frames, result.skipped) == (clean.rmse, 10, 2)
    assert list(np.flatnonzero(np.isnan(result.errors))) == [2, 7]
    relative = trajectory_error.rpe(broken_estimate, broken_truth)
    assert (relative.pairs, relative.skipped) == (7, 4)
    assert list(np.flatnonzero(np.isnan(relative.translation_errors_m))) == [1, 2, 6, 7]
    assert np.isfinite(relative.rotation_deg).all()


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_a_camera_on_a_line_is_aligned(alignment):
    """The error is well defined though the rotation about the line is not."""
    rng = np.random.default_rng(7)
    ground_truth = random_poses(rng, 10)
    ground_truth[:, :3, 3] = np.linspace(0, 1, 10)[:, None] * np.array([1.0, 2.0, -1.0]) + 5
    result = trajectory_error.ate(
        trajectory_error.align(random_similarity(rng, 1.0), ground_truth), ground_truth, alignment
    )
    assert result.max == pytest.approx(0, abs=1e-12)
    assert np.linalg.det(result.alignment.rotation) == pytest.approx(1)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_an_estimate_at_rest_misses_the_spread_of_the_truth(alignment):
    rng = np.random.default_rng(8)
    ground_truth = random_poses(rng, 7)
    estimate = np.tile(np.eye(4), (7, 1, 1))
    estimate[:, :3, 3] = [0.1, 0.7, 0.3]
    result = trajectory_error.ate(estimate, ground_truth, alignment)
    assert result.rmse == pytest.approx(np.sqrt(ground_truth[:, :3, 3].var(0).sum()))
    assert result.alignment.scale == 1
    np.testing.assert_array_equal(result.alignment.rotation, np.eye(3))


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda T: trajectory_error.ate(T[:2], T[:2]),
            "alignment se3: expected at least 3 pairs of finite poses, got 2",
        ),
        (
            lambda T: trajectory_error.ate(T[:2] * np.nan, T[:2], "none"),
            "at least 1 pairs of finite poses, got 0",
        ),
        (
            lambda T: trajectory_error.rpe(T, T, delta=9),
            "expected two finite poses 9 frames apart, got 4 poses",
        ),
        (
            lambda T: trajectory_error.umeyama(T[:, :3, 3] * np.nan, T[:, :3, 3], False),
            "expected finite points",
        ),
    ],
)
def test_too_little_input_is_refused(call, message):
    with pytest.raises(DataError, match=message):
        call(random_poses(np.random.default_rng(9), 4))


def test_two_poses_have_an_error_without_alignment():
    T = random_poses(np.random.default_rng(10), 2)
    moved = T.copy()
    moved[1, 0, 3] += 0.3
    assert trajectory_error.ate(moved, T, "none").max == pytest.approx(0.3)


def test_a_delta_of_nothing_is_refused():
    T = random_poses(np.random.default_rng(11), 4)
    with pytest.raises(ValueError, match="delta of at least 1"):
        trajectory_error.rpe(T, T, delta=0)


@settings(deadline=None)
@given(SEEDS, st.sampled_from([0.5, 1.0, 3.0]))
def test_pairs_are_the_nearest_within_a_tenth(seed, delta):
    """Against trying every pair; steps on a grid, so that stretches at rest and equal distances happen."""
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.0, 0.25, 0.26, 1.0], size=29)
    ground_truth = np.tile(np.eye(4), (30, 1, 1))
    ground_truth[1:, 0, 3] = np.cumsum(steps)
    along = trajectory_error.path_length(ground_truth)
    np.testing.assert_allclose(along, ground_truth[:, 0, 3], atol=1e-12)
    expected = []
    for i in range(30):
        off = np.abs(along[i + 1 :] - along[i] - delta)
        if len(off) and off.min() <= 0.1 * delta:
            expected.append((i, i + 1 + int(off.argmin())))
    estimate = ground_truth.copy()
    estimate[:, 0, 3] *= 1.1
    if expected:
        found = trajectory_error.rpe(estimate, ground_truth, delta, along=along)
        lengths = [0.1 * (ground_truth[j, 0, 3] - ground_truth[i, 0, 3]) for i, j in expected]
        np.testing.assert_allclose(found.translation_errors_m, lengths, atol=1e-12)
    else:
        with pytest.raises(DataError, match="apart"):
            trajectory_error.rpe(estimate, ground_truth, delta, along=along)


def test_a_path_is_not_cut_by_poses_that_are_missing():
    ground_truth = np.tile(np.eye(4), (5, 1, 1))
    ground_truth[:, 1, 3] = [0, 1, 3, 2, 4]
    ground_truth[[0, 2]] = np.nan
    np.testing.assert_array_equal(trajectory_error.path_length(ground_truth), [0, 0, 0, 1, 3])

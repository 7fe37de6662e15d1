"""`jaxpose eval`: its numbers are evo's, its output states their protocol, a wrong call costs one line."""

import copy
import json
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import refused
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxpose import fields
from jaxpose.cli import evaluate
from jaxpose.cli import main as main_command
from jaxpose.cli.evaluate import Config
from jaxpose.errors import DataError
from jaxpose.evaluation import trajectory_error
from jaxpose.fields import numpy_evaluator
from jaxpose.files import atomic, trajectories
from jaxpose.geometry import rigid


def paths(count=60, seed=0):
    """A smooth trajectory of 3 s, and an estimate of it: jittered, drifting, scaled, elsewhere, late."""
    rng = np.random.default_rng(seed)
    t = 1.6e9 + np.linspace(0, 3, count)
    s = t - t[0]
    ground_truth = np.tile(np.eye(4), (count, 1, 1))
    ground_truth[:, :3, :3] = Rotation.from_rotvec(np.stack([s, 0.5 * np.sin(s), 0.2 * s], -1)).as_matrix()
    ground_truth[:, :3, 3] = np.stack([2 * np.sin(s), np.cos(2 * s), 0.3 * s], -1)
    estimate = ground_truth.copy()
    turned = Rotation.from_rotvec(0.03 * rng.normal(size=(count, 3))).as_matrix()
    estimate[:, :3, :3] = ground_truth[:, :3, :3] @ turned
    estimate[:, :3, 3] += 0.02 * rng.normal(size=(count, 3)) + 0.02 * s[:, None]
    estimate = trajectory_error.align(rigid.Similarity(0.7, turned[0], np.array([3.0, 1, 2])), estimate)
    late = rng.uniform(-0.008, 0.008, count)
    return trajectories.Trajectory(t, ground_truth), trajectories.Trajectory(t + late, estimate)


@pytest.fixture
def files(tmp_path):
    """Ground truth, and an estimate that lacks some poses and has others of times long after."""
    ground_truth, estimate = paths()
    kept = np.setdiff1d(np.arange(60), [5, 6, 30])
    t = np.append(estimate.t[kept], estimate.t[-1] + [5, 6])
    T = np.concatenate([estimate.T[kept], estimate.T[:2]])
    trajectories.write_tum(tmp_path / "ground truth.txt", ground_truth)
    trajectories.write_tum(tmp_path / "estimate.txt", trajectories.Trajectory(t, T))
    return tmp_path / "estimate.txt", tmp_path / "ground truth.txt"


def assert_agrees_with_evo(estimate, reference, align, most, tolerance=1e-6):
    """Every number of every delta."""
    from evo.core import sync
    from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
    from evo.tools import file_interface

    config = Config(
        estimate, reference, align=align, max_difference_s=most, rpe_frames=(1, 10), rpe_metres=(0.5,)
    )
    ours = evaluate.run(config)
    ground_truth, found = (file_interface.read_tum_trajectory_file(file) for file in (reference, estimate))
    ground_truth, found = sync.associate_trajectories(ground_truth, found, max_diff=most)
    found = copy.deepcopy(found)
    if align != "none":
        found.align(ground_truth, correct_scale=align == "sim3")
    parts = {"m": PoseRelation.translation_part, "deg": PoseRelation.rotation_angle_deg}
    pairs = [(ours.ate_m, APE(parts["m"])), (ours.rotation_deg, APE(parts["deg"]))]
    units = {"frames": Unit.frames, "m": Unit.meters}
    for rpe in ours.rpe:
        if rpe.unit != "s":  # which evo does not have
            for part, statistics in (("m", rpe.translation_m), ("deg", rpe.rotation_deg)):
                pairs.append(
                    (
                        statistics,
                        RPE(parts[part], rpe.delta, units[rpe.unit], 0.1, True, pairs_from_reference=True),
                    )
                )
    assert len(pairs) == 8 and ours.pairs == ground_truth.num_poses
    for statistics, metric in pairs:
        metric.process_data((ground_truth, found))
        for name in trajectory_error.Statistics._fields:
            theirs = metric.get_statistic(StatisticsType[name])
            assert getattr(statistics, name) == pytest.approx(theirs, abs=tolerance), (metric, name)
    return ours


@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
def test_numbers_are_evos(files, align):
    ours = assert_agrees_with_evo(*files, align, 0.01)
    assert ours.pairs == 57
    assert ours.transform.scale == pytest.approx(1 / 0.7, rel=0.05) if align == "sim3" else 1


@pytest.mark.data
@pytest.mark.parametrize("align", ["none", "se3", "sim3"])
@pytest.mark.parametrize(
    "estimate, reference, pairs",
    [
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", 2174),
        ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", 785),
        ("freiburg1_xyz-rgbdslam_drift.txt", "freiburg1_xyz-groundtruth.txt", 785),
    ],
)
def test_numbers_on_real_trajectories_are_evos(data_dir, estimate, reference, pairs, align):
    folder = data_dir / "trajectories"
    # Exact ties of timestamps go to the earlier here, and where float64 seconds since 1970 round to in evo.
    tolerance = 2e-5 if estimate == "fr2_desk_ORB.txt" else 1e-6
    ours = assert_agrees_with_evo(folder / estimate, folder / reference, align, 0.01, tolerance)
    assert ours.pairs == pytest.approx(pairs, abs=5)


def test_rpe_over_seconds_is_that_over_as_many_frames(files):
    """At a steady rate, with a delta of which a tenth is less than a frame."""
    ground_truth, estimate = paths(61)
    for file, trajectory in zip(files, (estimate, ground_truth), strict=True):
        trajectories.write_tum(file, trajectories.Trajectory(ground_truth.t, trajectory.T))
    by_frames, by_time = evaluate.run(Config(*files, rpe_frames=(5,), rpe_seconds=(0.25,))).rpe
    np.testing.assert_allclose(by_time.translation_m, by_frames.translation_m, atol=1e-12)
    assert (by_time.unit, by_time.delta, by_time.pairs) == ("s", 0.25, by_frames.pairs)


def test_formats_do_not_change_the_numbers(files, tmp_path):
    ground_truth, estimate = paths()
    expected = trajectory_error.ate(estimate.T, ground_truth.T).rmse
    trajectories.write_euroc(tmp_path / "ground truth.csv", ground_truth)
    trajectories.write_euroc(tmp_path / "estimate.csv", estimate)
    trajectories.write_kitti(tmp_path / "kitti.txt", estimate.T)
    np.savetxt(tmp_path / "list.txt", ground_truth.T.reshape(-1, 4), fmt="%.17g")
    for pair, how, said in (
        (("estimate.csv", "ground truth.csv"), "nearest timestamps, at most 0.01 s apart", "EuRoC file"),
        (("kitti.txt", "ground truth.txt"), "row by row, as not both have timestamps", "KITTI file"),
        (("kitti.txt", "list.txt"), "row by row, as not both have timestamps", "no timestamps"),
    ):
        result = evaluate.run(Config(*(tmp_path / name for name in pair)))
        assert result.ate_m.rmse == pytest.approx(expected, abs=1e-9)
        text = evaluate.report(result)
        assert how in text and said in text and "SE(3)" in text
    assert result.notes == ("no timestamps, so no RPE over seconds",)
    assert [rpe.unit for rpe in result.rpe] == ["frames"]


def test_clocks_that_differ(files):
    estimate = trajectories.read_tum(files[0])
    trajectories.write_tum(files[0], estimate._replace(t=estimate.t - 1.6e9))
    with pytest.raises(DataError, match="expected timestamps within 0.01 s"):
        evaluate.run(Config(*files))
    found = evaluate.run(Config(*files, time_offset_s=1.6e9))
    trajectories.write_tum(files[0], estimate)
    # Timestamps since 1970 are rounded to 0.24 us, and at most that can pair others.
    assert found.ate_m == pytest.approx(evaluate.run(Config(*files)).ate_m)
    assert "the estimate's moved by 1.6e+09 s" in found.association


@pytest.fixture
def run_folder(tmp_path):
    """What a run leaves of its trajectory: frames at 10 Hz, and a spline that is asked between them."""
    folder = tmp_path / "run"
    folder.mkdir()
    span = (0.0, 3.0)
    rng = np.random.default_rng(0)
    points = np.cumsum(0.1 * rng.normal(size=(33, 7)), axis=0)
    fields.save(folder / "field.npz", fields.bspline(span, len(points) - 3), jnp.asarray(points))
    t = np.linspace(0, 3, 31)
    trajectories.write_tum(
        folder / "trajectory.txt", trajectories.Trajectory(t, numpy_evaluator.load(folder / "field.npz")(t))
    )
    atomic.write_json(folder / "results.json", {"experiment": "rgbd_slam"})
    return folder


def test_a_run_is_asked_at_the_references_own_stamps(run_folder, tmp_path):
    """Exact where the nearest frame is as far off as the camera moves in that time."""
    t = np.sort(np.random.default_rng(1).uniform(-0.2, 3.1, 100))
    trajectories.write_tum(
        tmp_path / "ground truth.txt",
        trajectories.Trajectory(t, numpy_evaluator.load(run_folder / "field.npz")(t)),
    )
    config = Config(run_folder, tmp_path / "ground truth.txt", align="none", max_difference_s=0.05)
    exact = evaluate.run(config)
    inside = int(((t >= 0) & (t <= 3)).sum())
    assert exact.pairs == inside < 100
    assert exact.ate_m.max < 1e-9 and exact.rotation_deg.max < 1e-5
    assert "exact: the continuous trajectory (field.npz) at the reference's timestamps" in exact.association
    assert f"; {100 - inside} timestamps of the reference beyond its ends are left out" in exact.association
    assert "rgbd_slam run, 31 poses" in exact.estimate
    nearest = evaluate.run(replace(config, match="nearest"))
    assert nearest.ate_m.max > 1e-3 and "nearest timestamps, at most 0.05 s" in nearest.association
    (run_folder / "field.npz").unlink()
    assert evaluate.run(config).ate_m == nearest.ate_m
    with pytest.raises(
        DataError, match="field.npz: expected the continuous trajectory of the run, got nothing"
    ):
        evaluate.run(replace(config, match="exact"))


def test_a_run_is_a_reference_too(run_folder):
    result = evaluate.run(Config(run_folder / "trajectory.txt", run_folder))
    assert result.ate_m.max < 1e-9 and result.pairs == 31


@pytest.fixture
def desk(tmp_path, walk, save):
    """A plain folder of six stamped frames, true poses for five of them."""
    poses = walk.T_world_cam.copy()
    poses[2] = np.nan
    for k in range(6):
        save(tmp_path / f"desk/color/{k}.png", walk.rgb[k])
        save(tmp_path / f"desk/depth/{k}.png", walk.counts[k])
    (tmp_path / "desk/camera-intrinsics.txt").write_text("30 0 15.5\n0 31 11.5\n0 0 1\n")
    np.savetxt(tmp_path / "desk/times.txt", 1.6e9 + np.arange(6) / 10, fmt="%.9f")
    np.savetxt(tmp_path / "desk/poses.txt", poses.reshape(6, 16))
    return tmp_path / "desk"


def test_a_recording_is_a_reference(desk, walk, tmp_path):
    """Its true poses are those of the file that states them."""
    estimate = walk.T_world_cam.copy()
    estimate[0, :3, 3] += [0.3, 0, 0]
    trajectories.write_tum(tmp_path / "e.txt", trajectories.Trajectory(1.6e9 + np.arange(6) / 10, estimate))
    result = evaluate.run(Config(tmp_path / "e.txt", desk, align="none"))
    assert result.pairs == 5 and "(1 frames without a true pose)" in result.reference
    assert result.ate_m.max == pytest.approx(0.3, abs=1e-6) and result.ate_m.median == pytest.approx(
        0, abs=1e-6
    )
    (desk / "poses.txt").unlink()
    with pytest.raises(
        DataError, match="desk: expected a recording with true poses, got a plain one without"
    ):
        evaluate.run(Config(tmp_path / "e.txt", desk))


def test_json_is_all_that_is_printed(files, capsys):
    main_command.main(["eval", *map(str, files), "--json", "--align", "sim3", "--rpe-frames", "1", "5"])
    said = capsys.readouterr()
    assert said.err == ""
    read, result = json.loads(said.out), evaluate.run(Config(*files, align="sim3", rpe_frames=(1, 5)))
    assert read["ate_m"]["rmse"] == result.ate_m.rmse and read["alignment"] == "sim3"
    assert [(rpe["delta"], rpe["unit"]) for rpe in read["rpe"]] == [(1, "frames"), (5, "frames"), (1, "s")]
    assert np.array(read["transform"]["rotation"]).shape == (3, 3)


def test_the_table(files, capsys, tmp_path, figures):
    plot = tmp_path / "errors.png"
    main_command.main(["eval", *map(str, files), "--rpe-metres", "0.5", "100", "--plot", str(plot)])
    text, result = capsys.readouterr().out, evaluate.run(Config(*files))
    values = result.ate_m
    cells = [line.split("|") for line in text.splitlines() if line.startswith("| ATE ")][0]
    expected = [values.rmse, values.mean, values.median, values.max]
    assert [float(cell) for cell in cells[3:7]] == pytest.approx(expected, abs=1e-6) and cells[
        2
    ].strip() == "m"
    assert "57 of 59 poses of the shorter one: nearest timestamps" in text and "TUM file, 59 poses" in text
    assert "SE(3)" in text and "RPE over 0.5 m" in text and "RPE over 1 frame " in text
    assert "RPE over 100 m: no two poses are that far apart, to a tenth" in text and str(plot) in text
    with Image.open(plot) as image:
        image.load()
    assert image.format == "PNG"
    (figure,) = figures
    drawn = {line.get_label(): line for axes in figure.axes for line in axes.lines}
    assert f"RMSE {100 * values.rmse:.3g} cm" in drawn and f"RMSE {result.rotation_deg.rmse:.3g} deg" in drawn
    errors = next(axes for axes in figure.axes if axes.get_ylabel() == "translation error [cm]").lines[0]
    assert np.sqrt(np.mean(errors.get_ydata() ** 2)) == pytest.approx(100 * values.rmse)
    assert len(errors.get_ydata()) == 57


complaint = partial(refused.complaint, main_command.main)


def test_wrong_calls_cost_one_line(files, tmp_path):
    estimate, file = files
    (tmp_path / "folder" / "none").mkdir(parents=True)
    trajectories.write_tum(tmp_path / "folder" / "none" / "trajectory.txt", paths()[0])
    trajectories.write_kitti(tmp_path / "kitti.txt", paths(10)[0].T)
    (tmp_path / "broken").mkdir()
    trajectories.write_tum(tmp_path / "broken" / "trajectory.txt", paths()[0])
    (tmp_path / "broken" / "results.json").write_text("{")
    for args, message in (
        ([], "jaxpose: expected one of .*eval, export.*got nothing"),
        (["evaluate"], "got evaluate; did you mean eval"),
        (["eval", file], "Missing from jaxpose eval: REFERENCE"),
        (["eval", file, file, "--aling", "se3"], "--align"),
        (["eval", file, file, "--align", "affine"], "expected one of"),
        (["eval", file, file, "--max-difference-s", "-1"], "--max-difference-s: expected at least 0, got -1"),
        (["eval", file, file, "--rpe-metres", "0"], "--rpe-metres: expected a positive number, got 0.0"),
        (["eval", file, tmp_path / "x"], "x: expected a trajectory file or a run folder, got nothing"),
        (["eval", tmp_path / "folder", file], "with trajectory.txt, got runs in it: none"),
        (["eval", tmp_path / "kitti.txt", file], "kitti.txt: expected 60 poses, as .*, got 10"),
        (["eval", file, file, "--match", "exact"], "expected a run folder with field.npz, got a TUM file"),
        (["eval", file, file, "--plot", tmp_path / "no" / "p.png"], "No such file or directory"),
        (["eval", file, file, "--plot", "p.jpg"], "--plot: expected a name that ends in .png, got p.jpg"),
        (["eval", tmp_path / "broken", file], "broken/results.json:1: expected the results of a run"),
    ):  # fmt: skip
        line = complaint(*args)
        assert line.startswith("jaxpose") and re.search(message, line, re.IGNORECASE), line


def test_help_is_quick_and_says_what_there_is():
    """Without loading JAX or drawing; as `python -m jaxpose` too."""
    code = (
        "import sys\nfrom jaxpose.cli.main import main\n"
        "try: main(['eval', '--help'])\nexcept SystemExit: pass\n"
        "print([name for name in ('jax', 'matplotlib', 'flax') if name in sys.modules])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.endswith("\n[]\n") and "usage: jaxpose eval" in said
    for word in (
        "ESTIMATE",
        "REFERENCE",
        "--align {none,se3,sim3}",
        "--max-difference-s",
        "--json",
        "--plot",
    ):
        assert word in said
    short = subprocess.run([sys.executable, "-m", "jaxpose", "--help"], capture_output=True, text=True)
    assert short.returncode == 0 and "eval" in short.stdout and "export" in short.stdout
    wrong = subprocess.run([sys.executable, "-m", "jaxpose", "eval", "a"], capture_output=True, text=True)
    assert (wrong.returncode, wrong.stdout, len(wrong.stderr.splitlines())) == (1, "", 1)


def test_utm_coordinates_change_no_number(tmp_path, files):
    """Both a world away: the same errors, and the same digits of time."""
    away = np.array([453_217.125, 5_411_932.875, 312.5])
    near = evaluate.run(Config(*files))
    for file in files:
        read = trajectories.read_tum(file)
        T = read.T.copy()
        T[:, :3, 3] += away
        trajectories.write_tum(file, read._replace(T=T))
    far = evaluate.run(Config(*files))
    assert far.ate_m.rmse == pytest.approx(near.ate_m.rmse, abs=1e-8)
    assert far.rotation_deg.rmse == pytest.approx(near.rotation_deg.rmse, abs=1e-6)
    for ours, theirs in zip(far.rpe, near.rpe, strict=True):
        assert ours.translation_m.rmse == pytest.approx(theirs.translation_m.rmse, abs=1e-8)


@pytest.mark.parametrize("wiggle", [0.0, 1e-3])
def test_a_straight_path_leaves_a_rotation_free(tmp_path, capsys, wiggle):
    """Turned about the path by 177 degrees, the positions are the same but for noise."""
    ground_truth, _ = paths()
    rng = np.random.default_rng(1)
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:, :3, 3] = np.outer(np.linspace(0, 5, 60), [0.6, 0.8, 0.0]) + wiggle * rng.normal(size=(60, 3))
    estimate = T.copy()
    turn = Rotation.from_rotvec(np.radians(177) * np.array([0.6, 0.8, 0.0])).as_matrix()
    estimate[:, :3, :3], estimate[:, :3, 3] = turn, T[:, :3, 3] + 3 * wiggle * rng.normal(size=(60, 3))
    for name, poses in (("a.txt", estimate), ("b.txt", T)):
        trajectories.write_tum(tmp_path / name, ground_truth._replace(T=poses))
    result = evaluate.run(Config(tmp_path / "a.txt", tmp_path / "b.txt"))
    assert np.isnan(result.rotation_deg.rmse) and "the path is straight" in result.notes[-1]
    main_command.main(["eval", str(tmp_path / "a.txt"), str(tmp_path / "b.txt")])
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| rotation")]
    assert "free" in row and "177" not in row
    as_they_are = evaluate.run(Config(tmp_path / "a.txt", tmp_path / "b.txt", align="none"))
    assert as_they_are.rotation_deg.rmse == pytest.approx(177, abs=0.1)


def test_what_does_not_match_in_time_names_the_files_and_the_nearest(files):
    read = trajectories.read_tum(files[0])
    trajectories.write_tum(files[0], read._replace(t=read.t + 0.025 + 10))
    line = refused.complaint(main_command.main, "eval", *files)
    assert str(files[0]) in line and str(files[1]) in line and "--max-difference-s" in line
    assert re.search(
        r"1600000000\.000 to 1600000003\.000 s, got 16000000\d\d\.\d+ to .*: nearest timestamps", line
    )

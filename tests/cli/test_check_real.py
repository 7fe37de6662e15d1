"""`jaxpose check` on real data: no fault found, and those put in are named."""

import os

import numpy as np
import pytest
from helpers.checks import checked, faults, flipped, inverted, named_tests


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("7scenes_redkitchen", "sevenscenes"),
        ("euroc_V1_02_medium", "EuRoC"),
        ("euroc_V1_01_easy", "EuRoC"),
        ("nerf_synthetic_lego", "Blender"),
        ("llff_fern", "LLFF"),
        ("ecd_slider_depth", "DAVIS"),
        ("trajectories", "folder of trajectories"),
        ("trajectories/euroc/V1_03_difficult.csv", "EuRoC trajectory"),
        ("trajectories/tum_vi", "folder of trajectories"),
    ],
)
def test_real_data_have_no_fault(data_dir, name, form):
    result = checked(data_dir / name)
    assert form in result.format and faults(result) == ""


@pytest.mark.data
@pytest.mark.parametrize(
    ("change", "scale", "words"),
    [
        (inverted, 1.0, "world-to-camera poses, OpenCV axes"),
        (flipped, 1.0, "camera-to-world poses, OpenGL axes"),
        (lambda T: T, 5.0, "5 times too large"),
        (lambda T: T, 0.2, "multiply the depth by 5"),
    ],
)
def test_faults_put_into_a_real_clip_are_named(data_dir, tmp_path, save, change, scale, words):
    from jaxpose.datasets.images import open_image

    folder = data_dir / "7scenes_redkitchen" / "seq-01"
    os.symlink(data_dir / "7scenes_redkitchen" / "camera-intrinsics.txt", tmp_path / "camera-intrinsics.txt")
    for file in sorted(folder.glob("*0.color.jpg")):
        stem = file.name.split(".")[0]
        os.symlink(file, tmp_path / file.name)
        counts = open_image(folder / f"{stem}.depth.png", np.asarray)
        if scale == 1:
            os.symlink(folder / f"{stem}.depth.png", tmp_path / f"{stem}.depth.png")
        else:
            counts = np.where(counts == 65535, 0, np.minimum(counts * scale, 65534)).astype(np.uint16)
            save(tmp_path / f"{stem}.depth.png", counts)
        T = np.loadtxt(folder / f"{stem}.pose.txt")
        np.savetxt(tmp_path / f"{stem}.pose.txt", change(T))
    result = checked(tmp_path)
    assert named_tests(result) == ["poses and depth"] and words in faults(result)


@pytest.mark.data
@pytest.mark.parametrize(
    "name",
    ["fr2_desk_ORB.txt", "freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt", "tum_vi", "euroc"],
)
def test_real_quaternions_in_the_other_order_are_named(data_dir, tmp_path, name):
    source = data_dir / "trajectories" / name
    lines = (next(source.iterdir()) if source.is_dir() else source).read_text().splitlines()
    rows = [line.replace(",", " ").split() for line in lines if not line.startswith("#")]
    if source.is_dir():  # wxyz to xyzw
        text = "\n".join(",".join([*row[:4], *row[5:8], row[4], *row[8:]]) for row in rows)
    else:
        text = "\n".join(" ".join([*row[:4], row[7], *row[4:7]]) for row in rows)
    (tmp_path / "t.txt").write_text(text)
    assert named_tests(checked(tmp_path / "t.txt")) == ["quaternion order"]


@pytest.mark.data
@pytest.mark.parametrize(("frames", "words"), [(0, ""), (2, "the poses of 70 ms earlier")])
def test_poses_of_another_clock_are_named(data_dir, tmp_path, frames, words):
    folder = data_dir / "7scenes_redkitchen" / "seq-01"
    os.symlink(data_dir / "7scenes_redkitchen" / "camera-intrinsics.txt", tmp_path / "camera-intrinsics.txt")
    for i in range(240):
        for kind, j in (("color.jpg", i), ("depth.png", i), ("pose.txt", i + frames)):
            os.symlink(folder / f"frame-{j:06d}.{kind}", tmp_path / f"frame-{i:06d}.{kind}")
    result = checked(tmp_path)
    assert named_tests(result) == (["clock of poses"] if frames else []) and words in faults(result)


@pytest.mark.data
@pytest.mark.parametrize(
    ("fault", "test", "words"),
    [("degrees", "gyroscope unit", "degrees/s"), ("late", "clock offset", "ms late"), ("order", "", "xyzw")],
)
def test_faults_put_into_real_readings_are_named(data_dir, tmp_path, fault, test, words):
    source = data_dir / "euroc_V1_02_medium" / "mav0"
    for name in ("imu0", "state_groundtruth_estimate0"):
        rows = [line.split(",") for line in (source / name / "data.csv").read_text().splitlines()[1:9000]]
        for row in rows:
            if fault == "degrees" and name == "imu0":
                row[1:4] = [repr(float(x) * 180 / np.pi) for x in row[1:4]]
            if fault == "late" and name == "imu0":
                row[0] = str(int(row[0]) + 50_000_000)
            if fault == "order" and name != "imu0":
                row[4:8] = [*row[5:8], row[4]]
        (tmp_path / "mav0" / name).mkdir(parents=True)
        (tmp_path / "mav0" / name / "data.csv").write_text("\n".join(map(",".join, rows)))
    (tmp_path / "mav0/imu0/sensor.yaml").write_text((source / "imu0/sensor.yaml").read_text())
    result = checked(tmp_path)
    if fault == "order":  # by the signs, and by the gyroscope
        assert named_tests(result) == ["quaternion order", "quaternion order"]
    else:
        assert named_tests(result) == [test]
    assert words in faults(result)

"""Layouts of other programs, bytes as they write them: columns, units, gaps, what may be read in two ways."""

from decimal import Decimal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.errors import DataError
from jaxpose.files.timestamps import whole_ns
from jaxpose.files.trajectories import read_trajectory, write_csv, write_euroc, write_tum

COUNT, START_NS = 12, 1_403_715_523_912_143_104
RNG = np.random.default_rng(4)
NS = [START_NS + 50_000_000 * k + int(RNG.integers(1, 1000)) for k in range(COUNT)]
XYZW = Rotation.random(COUNT, rng=RNG).as_quat(canonical=True)
POSITION = RNG.normal(size=(COUNT, 3))


def seconds(ns):
    return str(Decimal(ns) / 10**9)


def csv(path, times, order, head="", extra="", mark=",", end=""):
    """Rows of time, position, quaternion, and what follows them."""
    rows = [
        mark.join([str(t), *(f"{x:.9f}" for x in (*p, *q[list(order)]))]) + extra + end
        for t, p, q in zip(times, POSITION, XYZW, strict=True)
    ]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


WXYZ, SAME = (3, 0, 1, 2), (0, 1, 2, 3)
FLOAT_NS = [f"{float(seconds(ns)) * 1e9:.0f}" for ns in NS]  # as toSec() * 1e9 makes them
LAYOUTS = {
    "TUM": ([seconds(ns) for ns in NS], SAME, {"mark": " "}, "TUM"),
    "tabs, byte order mark": ([seconds(ns) for ns in NS], SAME, {"mark": "\t", "head": "\ufeff"}, "TUM"),
    "EuRoC": (NS, WXYZ, {"head": "#timestamp, p_RS_R_x [m], ...\n", "extra": ",0" * 9}, "EuRoC"),
    "TUM-VI": (NS, WXYZ, {}, "EuRoC"),
    "VINS-Mono": (FLOAT_NS, WXYZ, {"extra": ",0.1,0.2,0.3", "end": ","}, "EuRoC"),
    "VINS-Mono with loops": (FLOAT_NS, WXYZ, {"end": ","}, "EuRoC"),
    "ORB-SLAM3 in EuRoC's mode": ([f"{ns}.000000" for ns in NS], SAME, {"mark": " "}, "TUM"),
    "csv without header": ([seconds(ns) for ns in NS], SAME, {}, "CSV"),
    "cnspy": ([seconds(ns) for ns in NS], SAME, {"head": "#t,tx,ty,tz,qx,qy,qz,qw\n"}, "CSV"),
    "cnspy with covariance": (
        [seconds(ns) for ns in NS],
        SAME,
        {"head": "t,tx,ty,tz,qx,qy,qz,qw,pxx,pxy,pxz,pyy\n", "extra": ",1,0,0,1"},
        "CSV",
    ),
    "rostopic": (
        NS,
        SAME,
        {
            "head": "%time," + ",".join(f"field.pose.position.{a}" for a in "xyz") + ","
            + ",".join(f"field.pose.orientation.{a}" for a in "xyzw") + ",field.header.frame_id\n",
            "extra": ",world",
        },
        "CSV",
    ),
    "semicolons": ([seconds(ns) for ns in NS], SAME, {"mark": ";"}, "CSV"),
    "microseconds by the header": (
        [ns // 1000 for ns in NS],
        WXYZ,
        {"head": "time (us), x, y, z, qw, qx, qy, qz\n"},
        "CSV",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_other_programs(tmp_path, name):
    times, order, options, form = LAYOUTS[name]
    found = read_trajectory(csv(tmp_path / "file", times, order, **options))
    assert found.format == form
    ns = [Decimal(str(t)) for t in times]
    expected = [round(t * 10**9) if t < 2e9 else int(t) * (1000 if t < 2e15 else 1) for t in ns]
    assert whole_ns(found.trajectory.t, found.trajectory.t0_ns) == expected
    np.testing.assert_allclose(found.trajectory.T[:, :3, 3], POSITION, atol=1e-9)
    np.testing.assert_allclose(found.trajectory.T[:, :3, :3], Rotation.from_quat(XYZW).as_matrix(), atol=1e-8)
    assert bool(found.notes) == (name in ("ORB-SLAM3 in EuRoC's mode", "rostopic"))


def test_trajectopys_own_layout(tmp_path):
    """As `Trajectory.to_file` of trajectopy 5.1 writes it: path lengths and velocities around the pose."""
    head = "#epsg 0\n#name x\n#nframe enu\n#sorting chrono\n#fields t,l,px,py,pz,qx,qy,qz,qw,vx,vy,vz\n"
    rows = np.column_stack([np.zeros(COUNT), POSITION, XYZW, np.zeros((COUNT, 3))])
    lines = [",".join([seconds(ns), *(f"{x:.9f}" for x in row)]) for ns, row in zip(NS, rows, strict=True)]
    (tmp_path / "t.traj").write_text(head + "\n".join(lines) + "\n")
    found = read_trajectory(tmp_path / "t.traj")
    assert found.format == "CSV" and whole_ns(found.trajectory.t, found.trajectory.t0_ns) == NS
    np.testing.assert_allclose(found.trajectory.T[:, :3, 3], POSITION, atol=1e-9)


def test_the_clock_in_two_columns(tmp_path):
    file = tmp_path / "gt.csv"
    times = [f"{ns // 10**9},{ns % 10**9}" for ns in NS]
    found = read_trajectory(csv(file, times, SAME, head="#sec,nsec,x,y,z,qx,qy,qz,qw\n"))
    assert whole_ns(found.trajectory.t, found.trajectory.t0_ns) == NS


def test_open3ds_first_pose_stands_behind_its_header(tmp_path):
    head = "# TUM trajectory, format: <t> <x> <y> <z> <qx> <qy> <qz> <qw>"
    found = read_trajectory(csv(tmp_path / "o3d.txt", range(COUNT), SAME, head=head, mark=" "))
    assert len(found.trajectory.t) == COUNT and found.trajectory.t.tolist() == list(range(COUNT))
    np.testing.assert_allclose(found.trajectory.T[0, :3, 3], POSITION[0], atol=1e-9)
    assert found.notes == ("the first pose stands behind # in line 1, as Open3D writes it: read",)
    rows = (tmp_path / "o3d.txt").read_text().removeprefix(head).splitlines()
    (tmp_path / "hidden.txt").write_text("\n".join(["# " + rows[0], *rows[1:5], "# " + rows[5], *rows[6:]]))
    found = read_trajectory(tmp_path / "hidden.txt")
    assert len(found.trajectory.t) == COUNT - 2
    assert found.notes == ("lines left out: 2 with the numbers of a pose behind #",)


@pytest.mark.parametrize(
    ("times", "order", "options", "message"),
    [
        ([ns // 1000 for ns in NS], SAME, {}, "got timestamps in us, .*: say which, --columns"),
        ([60 * k for k in range(COUNT)], SAME, {"mark": " "}, "0 to 660 in 12 lines, which may be s or ms"),
        ([seconds(ns) for ns in NS], WXYZ, {"extra": ",0,0,0"}, "in ns, as csv of 11 columns .* got s: say"),
    ],
)  # fmt: skip
def test_what_may_be_two_things_is_refused_and_an_option_decides(tmp_path, times, order, options, message):
    file = csv(tmp_path / "file", times, order, **options)
    with pytest.raises(DataError, match=message) as error:
        read_trajectory(file)
    assert "\n" not in str(error.value)
    unit = {str: "s", int: "us" if times[0] else "s"}[type(times[0])]
    quaternion = "qx qy qz qw" if order == SAME else "qw qx qy qz"
    rest = " - - -" if "extra" in options else ""
    found = read_trajectory(file, f"t[{unit}] tx ty tz {quaternion}{rest}")
    assert (found.unit, found.order) == (unit, "xyzw" if order == SAME else "wxyz")
    np.testing.assert_allclose(found.trajectory.T[:, :3, 3], POSITION, atol=1e-9)
    with pytest.raises(
        DataError, match="expected --columns with .* names, t tx ty tz qx qy qz qw among them"
    ):
        read_trajectory(file, "t x y z")


@pytest.mark.parametrize(("order", "names"), [(SAME, "qx qy qz qw"), (WXYZ, "qw qx qy qz")])
def test_quaternions_that_are_none_are_refused(tmp_path, order, names):
    rows = [[seconds(ns), *q[list(order)], *p] for ns, p, q in zip(NS, POSITION, XYZW, strict=True)]
    (tmp_path / "tqp.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    with pytest.raises(
        DataError, match=r"tqp.txt:\d+: expected a unit quaternion .*; columns 2 to 5 are of unit"
    ):
        read_trajectory(tmp_path / "tqp.txt")
    found = read_trajectory(tmp_path / "tqp.txt", f"t {names} x y z")
    np.testing.assert_allclose(found.trajectory.T[:, :3, :3], Rotation.from_quat(XYZW).as_matrix(), atol=1e-9)


def test_gaps_are_left_out_and_counted_in_every_format(tmp_path):
    gone = {2: "nan", 5: "inf", 7: ""}
    for name, times, order, mark in (("tum", [*map(seconds, NS)], SAME, " "), ("euroc", NS, WXYZ, ",")):
        lines = csv(tmp_path / name, times, order, mark=mark).read_text().splitlines()
        for row, word in gone.items():
            words = lines[row].split(mark)
            words[3] = word or ("NaN" if mark == " " else "")
            lines[row] = mark.join(words)
        lines[9] = mark.join([*lines[9].split(mark)[:4], "0", "0", "0", "0"])
        (tmp_path / name).write_text("\n".join([*lines, lines[-1]]))
        found = read_trajectory(tmp_path / name)
        kept = np.setdiff1d(np.arange(COUNT), [*gone, 9])
        assert (found.missing, found.repeated, found.count) == (4, 1, COUNT + 1)
        np.testing.assert_allclose(found.trajectory.T[:, :3, 3], POSITION[kept], atol=1e-9)
        assert found.notes == (
            f"{name}: lines left out: 4 hold NaN, infinity or nothing (line 3), "
            "1 repeat the timestamp before (line 13)",
        )
    T = np.tile(np.eye(4), (4, 1, 1))
    T[2] = -np.inf
    np.savetxt(tmp_path / "4x4", T.reshape(-1, 16))
    np.savetxt(tmp_path / "kitti", T[:, :3].reshape(-1, 12), delimiter=",")
    for name in ("4x4", "kitti"):
        found = read_trajectory(tmp_path / name)
        assert found.trajectory.t.tolist() == [0, 1, 3] and (found.missing, found.count) == (1, 4)
        assert found.notes == (f"{name}: poses left out: 1 with NaN or infinity",)
    (tmp_path / "none").write_text("1 nan nan nan nan nan nan nan\n" * 2)
    with pytest.raises(DataError, match="none: expected lines of 8 numbers .* got NaN or infinity in all 2"):
        read_trajectory(tmp_path / "none")


@pytest.mark.parametrize("name", ["TUM", "TUM-VI", "csv without header"])
def test_an_identity_conversion_keeps_every_digit(tmp_path, name):
    """Timestamps to the ns, positions and quaternions as they stand, rounded to 5 digits by their writer."""
    times, order, options, form = LAYOUTS[name]
    mark = options.get("mark", ",")
    digits = [[str(round(x, 5)) for x in (*p, *q[list(order)])] for p, q in zip(POSITION, XYZW, strict=True)]
    rows = [[str(t), *row] for t, row in zip(times, digits, strict=True)]
    (tmp_path / "file").write_text("\n".join(map(mark.join, rows)))
    found = read_trajectory(tmp_path / "file")
    write = {"TUM": write_tum, "EuRoC": write_euroc, "CSV": write_csv}[form]
    write(tmp_path / "out", found.trajectory, found.quaternion_xyzw)
    assert [line.split(mark) for line in (tmp_path / "out").read_text().splitlines()[1:]] == rows


def test_evo_reads_what_is_written(tmp_path):
    from evo.tools import file_interface

    found = read_trajectory(csv(tmp_path / "vins", FLOAT_NS, WXYZ, extra=",0.1,0.2,0.3", end=","))
    write_tum(tmp_path / "out", found.trajectory, found.quaternion_xyzw)
    theirs = file_interface.read_tum_trajectory_file(tmp_path / "out")
    np.testing.assert_allclose(np.array(theirs.poses_se3)[:, :3, :], found.trajectory.T[:, :3, :], atol=1e-8)
    np.testing.assert_allclose(theirs.timestamps * 1e9, [float(ns) for ns in FLOAT_NS], rtol=0, atol=300)


SECONDS = [k / 10 for k in range(COUNT)]
HEAD = "t,x,y,z,qx,qy,qz,qw\n"


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n0.3,", " # lost\n0.3,"),
        lambda text: text.replace(",", ";").replace(".", ","),  # a spreadsheet's in Europe
        lambda text: text.replace(",", ";"),
    ],
)
def test_what_people_do_to_tables(tmp_path, change):
    file = csv(tmp_path / "a.csv", SECONDS, SAME, head=HEAD)
    file.write_text(change(file.read_text()))
    found = read_trajectory(file)
    np.testing.assert_allclose(found.trajectory.t, SECONDS)
    np.testing.assert_allclose(found.trajectory.T[:, :3, 3], POSITION, atol=1e-9)


def test_empty_cells_at_the_end_of_a_row_are_a_gap(tmp_path):
    file = csv(tmp_path / "a.csv", SECONDS, SAME, head=HEAD)
    lines = file.read_text().splitlines()
    lines[4] = "0.3" + "," * 7
    file.write_text("\n".join(lines))
    found = read_trajectory(file)
    assert found.missing == 1 and len(found.trajectory.t) == COUNT - 1


@pytest.mark.parametrize("unit, metres", [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0)])
def test_units_of_the_position_are_those_of_the_header(tmp_path, unit, metres):
    head = f"t [s],x [{unit}],y [{unit}],z [{unit}],qx,qy,qz,qw\n"
    found = read_trajectory(csv(tmp_path / "a.csv", SECONDS, SAME, head=head))
    np.testing.assert_allclose(found.trajectory.T[:, :3, 3], metres * POSITION, atol=1e-9)
    assert bool(found.notes) == (unit != "m")
    csv(tmp_path / "a.csv", SECONDS, SAME, head=head.replace(f"[{unit}]", "[px]"))
    with pytest.raises(DataError, match="expected a position in m, mm, .*, got px"):
        read_trajectory(tmp_path / "a.csv")


def test_ns_from_0_are_no_seconds_of_many_years(tmp_path):
    """Two seconds of ns end where a date of seconds could be."""
    found = read_trajectory(csv(tmp_path / "a.txt", [2 * k * 10**8 for k in range(COUNT)], SAME, mark=" "))
    assert found.unit == "ns"
    np.testing.assert_allclose(found.trajectory.t, 0.2 * np.arange(COUNT))


def test_what_a_header_lacks_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n1,0,0,0,0,0,0\n")
    with pytest.raises(DataError, match="got a header without qx qy qz qw$"):
        read_trajectory(tmp_path / "a.csv")

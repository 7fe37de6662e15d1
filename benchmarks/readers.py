"""Process time of every reader: of this tree, and beside it of another one's.

    python benchmarks/readers.py --against OTHER/src --data "$JAXPOSE_DATA"

Files of realistic size are made first, with fixed numbers. Each tree runs in processes of its own, which take
turns; of each case the median over all of them is printed. Readers are found by the name that they have now,
else by the one they had before modules became packages (commit 92f55ee).
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SIZE = (240, 180)
BEFORE = {
    "datasets.rgbd.registry:load_recording": "data.recordings:load",
    "datasets.rgbd.euroc:load_imu": "data.euroc:load_imu",
    "datasets.rgbd.euroc:load_truth": "data.euroc:load_truth",
    "datasets.rgbd.tum:read_list": "data.tum:read_list",
    "datasets.rgbd.imu_csv:read_imu": "data.imu_file:read_imu",
    "datasets.photos.llff:load": "data.llff:load",
    "datasets.photos.blender:load": "data.blender:load",
    "datasets.events.davis:load": "data.davis:load",
    "datasets.events.npz:load": "data.event_npz:load",
    "datasets.events.hdf5:load": "data.event_hdf5:load",
    "datasets.images:read_color": "data.images:read_color",
    "datasets.images:read_depth": "data.images:read_depth",
    "files.trajectories:read_trajectory": "io_trajectory:read_trajectory",
    "files.trajectories:read_tum": "io:read_tum",
    "files.trajectories:read_euroc": "io:read_euroc",
    "files.trajectories:read_kitti": "io:read_kitti",
    "files.trajectories:read_timestamps": "io_trajectory:read_stamps",
    "files.ply:read_points": "io_ply:read_points",
    "files.checkpoint:load": "io_checkpoint:load",
}
TREE = {"weights": np.zeros((4000, 9, 9, 9, 4), np.float32), "step": np.asarray(4)}
NS = 1403636580838555648


def reader(name: str) -> Callable[..., Any]:
    """A function of the package that is first on the path, by its name now."""
    for place in (name, BEFORE[name]):
        module, function = place.split(":")
        try:
            return getattr(importlib.import_module(f"jaxpose.{module}"), function)
        except ModuleNotFoundError:
            pass
    raise SystemExit(f"jaxpose has no {name}")


def of_frames(folder: Path) -> Callable[[], Any]:
    """Open a recording and read its first frame."""
    return lambda: reader("datasets.rgbd.registry:load_recording")(folder).read(0)


def cases(made: Path, data: Path | None, events: int) -> dict[str, Callable[[], Any]]:
    """What is timed, by its name."""

    def of(name: str, file: Path | str, *args: Any, **options: Any) -> Callable[[], Any]:
        return lambda: reader(name)(made / file, *args, **options)

    found = {
        "EuRoC IMU, 2e5 readings": of("datasets.rgbd.euroc:load_imu", "euroc"),
        "EuRoC ground truth, 1e5 rows": of("datasets.rgbd.euroc:load_truth", "euroc"),
        "IMU in text, 1e5 readings": of("datasets.rgbd.imu_csv:read_imu", "imu.txt"),
        "TUM trajectory, 1e5 poses": of("files.trajectories:read_tum", "poses.txt"),
        "any trajectory, 1e5 poses": of("files.trajectories:read_trajectory", "poses.txt"),
        "EuRoC trajectory, 1e5 poses": of(
            "files.trajectories:read_euroc", "euroc/mav0/state_groundtruth_estimate0/data.csv"
        ),
        "KITTI trajectory, 1e5 poses": of("files.trajectories:read_kitti", "kitti.txt"),
        "timestamps, 1e5 lines": of("files.trajectories:read_timestamps", "poses.txt"),
        "TUM list, 1e5 images": of("datasets.rgbd.tum:read_list", "list/rgb.txt"),
        "PLY binary, 1e6 points": of("files.ply:read_points", "binary.ply"),
        "PLY text, 1e5 points": of("files.ply:read_points", "text.ply"),
        "checkpoint, 47 MB": of("files.checkpoint:load", "checkpoint.npz", TREE),
        f"events in text, {events // 10:.0e}": of("datasets.events.davis:load", "text", size=SIZE),
        f"events in npz, {events:.0e}": of("datasets.events.npz:load", "events.npz", size=SIZE),
        f"events in HDF5, {events:.0e}": of("datasets.events.hdf5:load", "events.h5", size=SIZE),
    }
    if data is None:
        return found
    rgb, depth = (min((data / "tum_fr1_rpy_first8s" / kind).iterdir()) for kind in ("rgb", "depth"))
    return found | {
        **{
            f"{name}, frame 0": of_frames(data / name)
            for name in ("tum_fr1_rpy_first8s", "icl_nuim_kt3", "7scenes_redkitchen", "hololens_walk")
        },
        "EuRoC V1_01 IMU": of("datasets.rgbd.euroc:load_imu", data / "euroc_V1_01_easy"),
        "EuRoC V1_02 ground truth": of("datasets.rgbd.euroc:load_truth", data / "euroc_V1_02_medium"),
        "TUM fr2_desk ground truth": of(
            "files.trajectories:read_trajectory", data / "trajectories/fr2_desk_groundtruth.txt"
        ),
        "slider_depth, DAVIS text": of("datasets.events.davis:load", data / "ecd_slider_depth"),
        "fern": of("datasets.photos.llff:load", data / "llff_fern"),
        "lego": of("datasets.photos.blender:load", data / "nerf_synthetic_lego"),
        "colour image": of("datasets.images:read_color", rgb),
        "depth image": of("datasets.images:read_depth", depth, 5000.0),
    }


def make(made: Path, events: int) -> None:
    """Write the files that the cases read."""
    import h5py

    from jaxpose.files import checkpoint, ply

    random = np.random.default_rng(0)
    table = lambda file, rows, **options: np.savetxt(made / file, rows, **options)
    imu0, truth = made / "euroc/mav0/imu0", made / "euroc/mav0/state_groundtruth_estimate0"
    for folder in (imu0, truth, made / "list/rgb", made / "text"):
        folder.mkdir(parents=True)
    noise = ("gyroscope_noise_density", "gyroscope_random_walk")
    noise += ("accelerometer_noise_density", "accelerometer_random_walk")
    sheet = "".join(f"{name}: 1.0e-3\n" for name in noise)
    (imu0 / "sensor.yaml").write_text(f"T_BS:\n  data: {np.eye(4).ravel().tolist()}\n{sheet}")
    for folder, count, columns in ((imu0, 200_000, 6), (truth, 100_000, 16)):
        values = random.normal(size=(count, columns)).round(6).tolist()
        for row in values if columns == 16 else []:
            row[3:7] = [1.0, 0.0, 0.0, 0.0]
        lines = (f"{NS + 5_000_000 * k},{','.join(map(str, row))}\n" for k, row in enumerate(values))
        (folder / "data.csv").write_text("#timestamp [ns],columns\n" + "".join(lines))
    t = 1.4e9 + np.arange(100_000) / 200
    turns = random.normal(size=(len(t), 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    table("poses.txt", np.column_stack([t, random.normal(size=(len(t), 3)), turns]), fmt="%.9f")
    table("kitti.txt", np.tile(np.eye(4)[:3].ravel(), (len(t), 1)), fmt="%.6e")
    table("imu.txt", np.column_stack([t, random.normal(size=(len(t), 6))]), fmt="%.9f")
    for k in range(100):
        (made / f"list/rgb/{k}.png").touch()
    (made / "list/rgb.txt").write_text("".join(f"{s:.6f} rgb/{k % 100}.png\n" for k, s in enumerate(t)))
    points = random.normal(size=(10**6, 3))
    ply.write_ply(made / "binary.ply", points, np.zeros((10**6, 3), np.uint8))
    head = "ply\nformat ascii 1.0\nelement vertex 100000\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header"
    table("text.ply", points[:100_000], header=head, comments="", fmt="%.6f")
    checkpoint.save(made / "checkpoint.npz", TREE)
    k = np.arange(events)
    columns = {"t": 2 * k, "x": (k % 240).astype(np.uint16), "y": (k // 7 % 180).astype(np.uint16)}
    columns["p"] = (k % 2).astype(np.int8)
    np.savez(made / "events.npz", **columns)
    with h5py.File(made / "events.h5", "w") as content:
        for name, values in columns.items():
            content[f"events/{name}"] = values
    rows = np.column_stack([values[: events // 10] for values in columns.values()]) * [1e-6, 1, 1, 1]
    table("text/events.txt", rows, fmt=["%.6f", "%d", "%d", "%d"])


def timed(run: Callable[[], Any]) -> float:
    """Process time [s] of a call."""
    began = time.process_time()
    run()
    return time.process_time() - began


def work(made: Path, data: Path | None, events: int, repeats: int, only: str) -> None:
    """Print process time [s] of each case, after a call that warms up, as JSON; none of what is not read."""
    from jaxpose.errors import DataError

    times = {}
    for name, run in cases(made, data, events).items():
        if only not in name:
            continue
        try:
            times[name] = [timed(run) for _ in range(1 + repeats)][1:]
        except DataError as error:
            print(error, file=sys.stderr)
    print(json.dumps(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--against", type=Path, help="src of another tree")
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--events", type=int, default=10**7)
    parser.add_argument("--rounds", type=int, default=3, help="processes of each tree")
    parser.add_argument("--repeats", type=int, default=3, help="calls in each process")
    parser.add_argument("--only", default="", help="cases that have this in their names")
    parser.add_argument("--made", type=Path, help="keep the files here, or take those that are here")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        return work(args.made, args.data, args.events, args.repeats, args.only)
    with tempfile.TemporaryDirectory() as temporary:
        made = args.made or Path(temporary)
        if not (made / "events.npz").exists():
            make(made, args.events)
        trees = {"here": Path(importlib.import_module("jaxpose").__path__[0]).parent}
        trees |= {"there": args.against} if args.against else {}
        command = [sys.executable, __file__, "--worker", "--made", made, "--events", args.events]
        command += ["--repeats", args.repeats, "--only", args.only]
        command += ["--data", args.data] if args.data else []
        times: dict[str, dict[str, list[float]]] = {tree: {} for tree in trees}
        for _ in range(args.rounds):
            for tree, source in trees.items():
                run = subprocess.run(
                    [str(word) for word in command],
                    env=os.environ | {"PYTHONPATH": str(source.resolve())},
                    check=True,
                    stdout=subprocess.PIPE,
                )
                for name, taken in json.loads(run.stdout).items():
                    times[tree].setdefault(name, []).extend(taken)
    print(f"{'medians of process time [s]':36}" + "".join(f"{tree:>9}" for tree in trees) + "    ratio")
    for name in times["here"]:
        medians = [float(np.median(times[tree].get(name, np.nan))) for tree in trees]
        ratio = f"{medians[0] / medians[1]:9.2f}" if len(medians) > 1 else ""
        print(f"{name:36}" + "".join(f"{median:9.4f}" for median in medians) + ratio)


if __name__ == "__main__":
    main()

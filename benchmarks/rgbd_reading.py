"""Frames a second that recordings with depth are read at, 640x480, in a thread as SLAM reads them.

    python benchmarks/rgbd_reading.py --data "$JAXPOSE_DATA"

The frames are those of TUM's fr1/rpy: in its folder of PNGs, and written as a bag of ROS 1 (raw, and
compressed), an MCAP and a recording of Stray Scanner (H.264). Each is read from its first frame to its last
in a process of its own, by the thread that `prefetch` has; whoever takes the frames does nothing. Next to
the time on the clock is the time of the processor, as other jobs may share the machine.
"""

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.ros_bags import Maker, Message

WANTED, K, SIZE = 60, (525.0, 525.0, 319.5, 239.5), (640, 480)  # frames a second


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def bag(folder: Path, frames: list, kind: str, compressed: bool) -> Path:
    """Colour and depth as the usual drivers publish them."""
    make, rows = Maker(kind), []
    for k, (rgb, counts) in enumerate(frames):
        ns = 10**18 + k * 10**9 // 30
        if compressed:
            stream = io.BytesIO()
            Image.fromarray(rgb).save(stream, "jpeg", quality=90)
            color = make.compressed(ns, "cam", "rgb8; jpeg compressed bgr8", stream.getvalue())
            depth = make.compressed(ns, "cam", "16UC1; compressedDepth", bytes(12) + png(counts))
        else:
            color, depth = make.image(ns, "cam", "rgb8", rgb), make.image(ns, "cam", "16UC1", counts)
        message = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
        suffix = ("/compressed", "/compressedDepth") if compressed else ("", "")
        rows.append(Message(f"/rgb/image{suffix[0]}", message, ns, color))
        rows.append(Message(f"/depth/image{suffix[1]}", message, ns, depth))
    info = make.camera_info(10**18, "cam", K, SIZE)
    rows.append(Message("/rgb/camera_info", "sensor_msgs/msg/CameraInfo", 10**18, info))
    return make.write(folder, rows)


def stray_scanner(folder: Path, frames: list) -> Path:
    import av

    (folder / "depth").mkdir()
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    with av.open(str(folder / "rgb.mp4"), "w") as container:
        track = container.add_stream("libx264", rate=30, options={"crf": "20"})
        (track.width, track.height), track.pix_fmt = SIZE, "yuv420p"
        for k, (rgb, counts) in enumerate(frames):
            container.mux(track.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
            Image.fromarray(counts).save(folder / f"depth/{k:06d}.png")
            rows.append(f"{1000 + k / 30:.6f}, {k:06d}, 0, 0, 0, 0, 0, 0, 1")
        container.mux(track.encode(None))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera_matrix.csv").write_text(f"{K[0]}, 0, {K[2]}\n0, {K[1]}, {K[3]}\n0, 0, 1\n")
    return folder


def tum(folder: Path, frames: list) -> Path:
    for kind, of in (("rgb", 0), ("depth", 1)):
        (folder / kind).mkdir()
        names = [f"{kind}/{1 + k / 30:.6f}.png" for k in range(len(frames))]
        for name, frame in zip(names, frames, strict=True):
            Image.fromarray(frame[of]).save(folder / name)
        lines = (f"{1 + k / 30:.6f} {name}\n" for k, name in enumerate(names))
        (folder / f"{kind}.txt").write_text("".join(lines))
    return folder


KINDS = {
    "folder of PNGs": tum,
    "bag of ROS 1": lambda folder, frames: bag(folder, frames, "ros1", False),
    "bag of ROS 1, compressed": lambda folder, frames: bag(folder, frames, "ros1", True),
    "MCAP": lambda folder, frames: bag(folder, frames, "mcap", False),
    "mp4 (Stray Scanner)": stray_scanner,
}


def read(path: Path) -> dict[str, float]:
    """Times [s] of all frames, after one that warms up."""
    from jaxpose.datasets.rgbd import registry
    from jaxpose.datasets.types import prefetch

    registry.load_recording(path).read(0)
    recording = prefetch(registry.load_recording(path))
    began, spent = time.perf_counter(), time.process_time()
    for i in range(len(recording.t)):
        assert recording.read(i).depth.shape == SIZE[::-1]
    took = time.perf_counter() - began, time.process_time() - spent
    return {"frames": len(recording.t), "wall_s": took[0], "process_s": took[1]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of real recordings")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--only", default="", help="kinds that have this in their names")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        print(json.dumps(read(args.worker)))
        return
    if args.data is None:
        parser.error("expected --data DIR with tum_fr1_rpy_first8s")
    from jaxpose.datasets.rgbd import tum as loader

    source = loader.load(args.data / "tum_fr1_rpy_first8s")
    found = [source.read(i) for i in range(min(args.frames, len(source.t)))]
    frames = [(rgb, np.rint(5000 * depth).astype(np.uint16)) for rgb, depth in found]
    with tempfile.TemporaryDirectory() as temporary:
        for k, (name, write) in enumerate(KINDS.items()):
            if args.only not in name:
                continue
            folder = Path(temporary) / f"{k}"
            folder.mkdir()
            path = write(folder, frames)
            command = [sys.executable, __file__, "--worker", str(path)]
            result = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            took = json.loads(result)
            rates = (took["frames"] / took[key] for key in ("wall_s", "process_s"))
            wall, process = (f"{rate:5.0f}" for rate in rates)
            print(
                f"{name:26}{wall} frames/s on the clock, {process} by process time (wanted {WANTED}), "
                f"load {os.getloadavg()[0]:.1f}"
            )


if __name__ == "__main__":
    main()

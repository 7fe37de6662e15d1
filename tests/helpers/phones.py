"""Recordings of phones in the layouts of their apps, from frames, poses and readings that are known."""

import io
import json
import zipfile

import av
import lzfse
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

CONFIDENT = 2
FLIP = np.diag([1.0, -1, -1, 1])  # OpenCV's camera to ARKit's


def confidence(k):
    """Confidence of 24 x 32 pixels, 0 in one corner."""
    values = np.full((24, 32), 1 + k % 2, np.uint8)
    values[-4:, -4:] = 0
    return values


def large(rgb):
    """Colour of twice the size of depth."""
    return np.repeat(np.repeat(rgb, 2, axis=0), 2, axis=1)


def small(rgb):
    """Colour of twice the size, as Pillow brings it back to that of depth."""
    return np.asarray(Image.fromarray(large(rgb)).resize(rgb.shape[1::-1], Image.Resampling.BILINEAR))


def png(pixels):
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def stray_scanner(folder, walk, save, *, force=(0.0, 0.0, -1.0), per_frame=False):
    """docs.strayrobots.io, "Data Specification": poses OpenCV's, accelerometer raw in g."""
    with (folder / "rgb.mp4").open("wb") as stream, av.open(stream, "w", format="mp4") as container:
        track = container.add_stream("libx264", rate=60, options={"crf": "1"})
        track.width, track.height, track.pix_fmt = 64, 48, "yuv444p"
        for rgb in walk.rgb:
            container.mux(track.encode(av.VideoFrame.from_ndarray(large(rgb), format="rgb24")))
        container.mux(track.encode(None))
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if per_frame else "")]
    for k, T in enumerate(walk.T_world_cam):
        save(folder / f"depth/{k:06d}.png", walk.counts[k])
        save(folder / f"confidence/{k:06d}.png", confidence(k))
        row = [2000.5 + k / 60, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        row += [60 + k, 62, 30.5, 22.5] if per_frame else []
        rows.append(", ".join([f"{row[0]:.9f}", f"{k:06d}", *(f"{x:.12g}" for x in row[1:])]))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera_matrix.csv").write_text("60.0, 0.0, 30.5\n0.0, 62.0, 22.5\n0.0, 0.0, 1.0")
    readings = [f"{2000.45 + j / 100:.6f}, {', '.join(map(str, force))}, 0.1, 0.2, {j}" for j in range(30)]
    (folder / "imu.csv").write_text(
        "\n".join(["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", *readings])
    )
    return folder


def record3d(path, walk, *, compress=lzfse.compress, metadata=None, drop=()):
    """record3d.app: K column by column, poses qx qy qz qw x y z of an OpenGL camera, depth float32."""
    poses = [[*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]] for T in walk.T_world_cam @ FLIP]
    content = {
        "w": 64, "h": 48, "dw": 32, "dh": 24, "fps": 60, "K": [60, 0, 0, 0, 62, 0, 30.5, 22.5, 1],
        "poses": poses, "frameTimestamps": [5.25 + k / 60 for k in range(len(poses))],
    } | (metadata or {})  # fmt: skip
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(content))
        for k, rgb in enumerate(walk.rgb):
            depth = walk.counts[k].astype(np.float32) / 1000
            depth[0, 1] = np.nan
            entries = {
                "jpg": png(large(rgb)),
                "depth": compress(depth.tobytes()),
                "conf": compress(confidence(k).tobytes()),
            }
            for kind, data in entries.items():
                if f"{k}.{kind}" not in drop:
                    archive.writestr(f"rgbd/{k}.{kind}", data)
    return path


def arkitscenes(folder, walk, save):
    """github.com/apple/ARKitScenes, DATA.md: names with timestamps, world-to-camera poses."""
    root = folder / "47331606_frames"
    lines = []
    for k, T in enumerate(walk.T_world_cam):
        name = f"47331606_{1000.123 + k / 10:.3f}"
        save(root / f"lowres_wide/{name}.png", walk.rgb[k])
        save(root / f"lowres_depth/47331606_{1000.124 + k / 10:.3f}.png", walk.counts[k])
        save(root / f"confidence/47331606_{1000.124 + k / 10:.3f}.png", confidence(k))
        (root / "lowres_wide_intrinsics").mkdir(exist_ok=True)
        (root / f"lowres_wide_intrinsics/{name}.pincam").write_text("32 24 30 31 15 11")
        inverse = np.linalg.inv(T)
        vector = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        lines.append(
            " ".join([f"{1000.123 + k / 10:.3f}", *(f"{x:.12g}" for x in (*vector, *inverse[:3, 3]))])
        )
    (root / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return folder


def polycam(folder, walk, save, *, step=50_000):
    """learn.poly.cam, "raw data": t_rc of an OpenGL camera, y up."""
    for k, T in enumerate(walk.T_world_cam @ FLIP):
        name = 15_741_398 + k * step
        save(folder / f"keyframes/images/{name}.jpg", large(walk.rgb[k]))
        save(folder / f"keyframes/depth/{name}.png", walk.counts[k])
        save(folder / f"keyframes/confidence/{name}.png", confidence(k) * 127)
        camera = {"fx": 60 + k, "fy": 62, "cx": 30.5, "cy": 22.5, "width": 64, "height": 48, "blur_score": 9}
        camera |= {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        (folder / "keyframes/cameras").mkdir(exist_ok=True)
        (folder / f"keyframes/cameras/{name}.json").write_text(json.dumps(camera))
    return folder

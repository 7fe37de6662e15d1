"""Recordings of phones in the layouts of their apps, from frames, poses and readings that are known."""

import io
import json
import zipfile

import av
import lzfse
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

K = (30.0, 31.0, 15.0, 11.0)  # of depth; colour is twice as large
FLIP = np.diag([1.0, -1, -1, 1])  # OpenCV's camera to ARKit's


def confidence(k, shape=(24, 32)):
    """Confidence of every pixel, 0 in one corner."""
    values = np.full(shape, 1 + k % 2, np.uint8)
    values[-4:, -4:] = 0
    return values


def large(rgb):
    """Colour of twice the size of depth."""
    return np.repeat(np.repeat(rgb, 2, axis=0), 2, axis=1)


def small(rgb):
    """Colour of twice the size, as Pillow brings it back to that of depth."""
    return np.asarray(Image.fromarray(large(rgb)).resize(rgb.shape[1::-1], Image.Resampling.BILINEAR))


def doubled(intrinsics):
    """fx fy cx cy of an image of twice the size, by its outer edge."""
    fx, fy, cx, cy = intrinsics
    return 2 * fx, 2 * fy, 2 * cx + 0.5, 2 * cy + 0.5


def png(pixels):
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def stray_scanner(folder, walk, save, *, force=(0.0, 0.0, -1.0), per_frame=False, K=K):
    """docs.strayrobots.io, "Data Specification": poses OpenCV's, accelerometer raw in g."""
    with (folder / "rgb.mp4").open("wb") as stream, av.open(stream, "w", format="mp4") as container:
        track = container.add_stream("libx264", rate=60, options={"crf": "1"})
        track.height, track.width = large(walk.rgb[0]).shape[:2]
        track.pix_fmt = "yuv444p"
        for rgb in walk.rgb:
            container.mux(track.encode(av.VideoFrame.from_ndarray(large(rgb), format="rgb24")))
        container.mux(track.encode(None))
    fx, fy, cx, cy = doubled(K)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + (", fx, fy, cx, cy" if per_frame else "")]
    for k, T in enumerate(walk.T_world_cam):
        save(folder / f"depth/{k:06d}.png", walk.counts[k])
        save(folder / f"confidence/{k:06d}.png", confidence(k, walk.counts[k].shape))
        row = [2000.5 + k / 60, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        row += [fx + k, fy, cx, cy] if per_frame else []
        rows.append(", ".join([f"{row[0]:.9f}", f"{k:06d}", *(f"{x:.12g}" for x in row[1:])]))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")
    readings = [f"{2000.45 + j / 100:.6f}, {', '.join(map(str, force))}, 0.1, 0.2, {j}" for j in range(30)]
    (folder / "imu.csv").write_text(
        "\n".join(["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z", *readings])
    )
    return folder


def record3d(path, walk, *, compress=lzfse.compress, metadata=None, drop=(), K=K):
    """record3d.app: K column by column, poses qx qy qz qw x y z of an OpenGL camera, depth float32."""
    poses = [[*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]] for T in walk.T_world_cam @ FLIP]
    (height, width), (fx, fy, cx, cy) = walk.counts[0].shape, doubled(K)
    content = {
        "w": 2 * width, "h": 2 * height, "dw": width, "dh": height, "fps": 60,
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
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
                "conf": compress(confidence(k, (height, width)).tobytes()),
            }
            for kind, data in entries.items():
                if f"{k}.{kind}" not in drop:
                    archive.writestr(f"rgbd/{k}.{kind}", data)
    return path


def arkitscenes(folder, walk, save, *, K=K):
    """github.com/apple/ARKitScenes, DATA.md: names with timestamps, world-to-camera poses."""
    root, (height, width) = folder / "47331606_frames", walk.counts[0].shape
    lines = []
    for k, T in enumerate(walk.T_world_cam):
        name = f"47331606_{1000.123 + k / 10:.3f}"
        save(root / f"lowres_wide/{name}.png", walk.rgb[k])
        save(root / f"lowres_depth/47331606_{1000.124 + k / 10:.3f}.png", walk.counts[k])
        save(root / f"confidence/47331606_{1000.124 + k / 10:.3f}.png", confidence(k, walk.counts[k].shape))
        (root / "lowres_wide_intrinsics").mkdir(exist_ok=True)
        (root / f"lowres_wide_intrinsics/{name}.pincam").write_text(" ".join(map(str, (width, height, *K))))
        inverse = np.linalg.inv(T)
        vector = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        lines.append(
            " ".join([f"{1000.123 + k / 10:.3f}", *(f"{x:.12g}" for x in (*vector, *inverse[:3, 3]))])
        )
    (root / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return folder


def polycam(folder, walk, save, *, step=50_000, K=K):
    """learn.poly.cam, "raw data": t_rc of an OpenGL camera, y up."""
    (height, width), (fx, fy, cx, cy) = walk.counts[0].shape, doubled(K)
    for k, T in enumerate(walk.T_world_cam @ FLIP):
        name = 15_741_398 + k * step
        save(folder / f"keyframes/images/{name}.jpg", large(walk.rgb[k]))
        save(folder / f"keyframes/depth/{name}.png", walk.counts[k])
        save(folder / f"keyframes/confidence/{name}.png", confidence(k, (height, width)) * 127)
        camera = {"fx": fx + k, "fy": fy, "cx": cx, "cy": cy, "width": 2 * width, "height": 2 * height}
        camera |= {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        (folder / "keyframes/cameras").mkdir(exist_ok=True)
        (folder / f"keyframes/cameras/{name}.json").write_text(json.dumps(camera))
    return folder

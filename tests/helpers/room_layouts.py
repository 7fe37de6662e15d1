"""The room of `rooms` in every layout that is read: each by another library, or as its maker documents it.

A writer takes a folder and returns what a command is given as --data.
"""

import csv
import json

import av
import cv2
import dv_processing as dv
import h5py
import numpy as np
import pycolmap
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from helpers import azure_kinect, phones, rooms
from helpers.asl import SENSOR
from helpers.rooms import COUNT, SIZE, STEP_S, UP, K
from helpers.ros_bags import Maker, Message, event_bag

T0_NS = 1_548_339_828_000_000_000
WALK = rooms.walk()
PHOTOGRAPHS = rooms.walk(12)
K_TEXT = f"{K[0]} 0 {K[2]}\n0 {K[1]} {K[3]}\n0 0 1\n"
R_BODY_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of the IMU's axes: x forward, z up


def save(file, pixels, **options):
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file, **options)


def images(color, depth, per_mm=1):
    """Write all frames; both are what `str.format` makes a path of, by the number of the frame."""
    for k in range(COUNT):
        save(color(k), WALK.rgb[k])
        save(depth(k), per_mm * WALK.counts[k])


def tum_rows(T, t):
    """Lines `t tx ty tz qx qy qz qw`."""
    xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return [
        " ".join([at, *(f"{x:.12f}" for x in (*p, *q))])
        for at, p, q in zip(t, T[:, :3, 3], xyzw, strict=True)
    ]


def upright(T):
    """Poses in a world whose z is up."""
    turn = np.eye(4)
    turn[:3, :3] = UP
    return turn @ T


# --- recordings with depth -------------------------------------------------------------------------------


def ros(folder, kind="ros1"):
    make, rows = Maker(kind), []
    for k in range(COUNT):
        ns, frame = T0_NS + k * 10**8, "camera"
        contents = {
            "/color": ("sensor_msgs/msg/Image", make.image(ns, frame, "bgr8", WALK.rgb[k][..., ::-1])),
            "/depth": ("sensor_msgs/msg/Image", make.image(ns, frame, "16UC1", WALK.counts[k])),
            "/camera_info": ("sensor_msgs/msg/CameraInfo", make.camera_info(ns, frame, K, SIZE)),
            "/pose": (
                "geometry_msgs/msg/PoseStamped",
                make.pose_stamped(ns, "world", WALK.T_world_cam[k]),
            ),
        }
        rows += [Message(topic, *content[:1], ns, content[1]) for topic, content in contents.items()]
    return make.write(folder, rows)


def azure(folder):
    """Both cameras look through lenses with k1 to k6; undone by OpenCV."""
    k1, k2, k3, k4, k5, k6 = azure_kinect.LENS
    lens = np.array([k1, k2, -1e-4, 2e-4, k3, k4, k5, k6])
    T_color_depth = np.eye(4)
    T_color_depth[:3, :3] = Rotation.from_rotvec([0.1, 0.02, -0.01]).as_matrix()
    T_color_depth[:3, 3] = [-0.032, -0.002, 0.004]

    def rays(fx, fy, cx, cy, size):
        v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float64)
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        xy = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), matrix, lens, criteria=stop)
        return np.concatenate([xy.reshape(*u.shape, 2), np.ones((*u.shape, 1))], axis=-1)

    color = rays(0.47 * 640, 0.63 * 480, 0.49 * 640 - 0.5, 0.52 * 480 - 60 - 0.5, azure_kinect.COLOR)
    depth = rays(0.49 * 512, 0.49 * 512, 0.5 * 512 - 96.5, 0.51 * 512 - 90.5, azure_kinect.DEPTH)
    T = rooms.poses(np.arange(COUNT) / 30)
    rgb = [(255 * rooms.look(pose, color)[0]).astype(np.uint8) for pose in T]
    counts = [np.rint(1000 * rooms.look(pose @ T_color_depth, depth)[1]).astype(np.uint16) for pose in T]
    stated = azure_kinect.calibration(T_color_depth, np.eye(4))
    readings = [(10_000 * j, (0.0, -9.8, 0.0), tuple(rooms.TURN)) for j in range(25)]
    return azure_kinect.write(folder / "walk.mkv", rgb, counts, readings, stated)


def nerfstudio(folder):
    frames = []
    images(lambda k: folder / f"images/{k}.png", lambda k: folder / f"depth/{k}.png")
    for k, T in enumerate(WALK.T_world_cam @ phones.FLIP):
        names = {"file_path": f"images/{k}", "depth_file_path": f"depth/{k}.png"}
        frames.append({**names, "transform_matrix": T.tolist()})
    camera = {"fl_x": K[0], "fl_y": K[1], "cx": K[2] + 0.5, "cy": K[3] + 0.5}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return folder


def sevenscenes(folder):
    sequence = folder / "kitchen/seq-01"
    stem = lambda k: sequence / f"frame-{k:06d}"
    images(lambda k: stem(k).with_suffix(".color.png"), lambda k: stem(k).with_suffix(".depth.png"))
    for k, T in enumerate(WALK.T_world_cam):
        np.savetxt(stem(k).with_suffix(".pose.txt"), T, delimiter="\t", fmt="%.7e")
    (sequence.parent / "camera-intrinsics.txt").write_text(K_TEXT)
    return sequence


def tum(folder):
    """As ETH3D SLAM has it, in names of another system."""
    t = [f"{1548339828 + k / 10:.4f}" for k in range(COUNT)]
    images(lambda k: folder / f"rgb/{t[k]}.png", lambda k: folder / f"depth/{t[k]}.png", per_mm=5)
    lists = {
        "rgb": [f"{at} rgb\\{at}.PNG" for at in t],
        "depth": [f"{at} ./depth/{at}.png" for at in t],
        "groundtruth": tum_rows(WALK.T_world_cam, t),
    }
    for name, rows in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(rows) + "\n")
    (folder / "calibration.txt").write_text(" ".join(map(str, K)))
    return folder


def replica(folder):
    room = folder / "Replica/room0"
    at = lambda name: lambda k: room / f"results/{name}{k:06d}.png"
    images(at("frame"), at("depth"), per_mm=5)
    np.savetxt(room / "traj.txt", WALK.T_world_cam.reshape(COUNT, 16))
    camera = dict(zip(("fx", "fy", "cx", "cy", "w", "h"), (*K, *SIZE), strict=True))
    (room.parent / "cam_params.json").write_text(json.dumps({"camera": {**camera, "scale": 5000.0}}))
    return room


def scannet(folder):
    images(lambda k: folder / f"color/{k}.png", lambda k: folder / f"depth/{k}.png")
    (folder / "intrinsic").mkdir()
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = K
    np.savetxt(folder / "intrinsic/intrinsic_depth.txt", matrix)
    (folder / "pose").mkdir()
    for k, T in enumerate(WALK.T_world_cam):
        np.savetxt(folder / f"pose/{k}.txt", T)
    return folder


def euroc(folder):
    """The ASL layout, on an IMU whose axes are other than the camera's, in a world whose z is up."""
    mav0, T_body_cam = folder / "mav0", np.eye(4)
    T_body_cam[:3, :3] = R_BODY_CAM
    ns = [T0_NS + k * 10**8 for k in range(COUNT)]
    images(*(lambda k, name=name: mav0 / f"{name}/data/{ns[k]}.png" for name in ("cam0", "depth0")))
    for name in ("cam0", "depth0"):
        lines = ["#timestamp [ns],filename", *(f"{at},{at}.png" for at in ns)]
        (mav0 / name / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    pose = ", ".join(map(str, T_body_cam.ravel()))
    (mav0 / "cam0/sensor.yaml").write_text(
        f"%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{pose}]\nrate_hz: 10\n"
        f"resolution: {list(SIZE)}\ncamera_model: pinhole\nintrinsics: {list(K)}\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
    )
    for name in ("imu0", "state_groundtruth_estimate0"):
        (mav0 / name).mkdir()
    identity = ", ".join(map(str, np.eye(4).ravel()))
    head, tail = SENSOR[: SENSOR.rindex("data:")], SENSOR[SENSOR.index("rate_hz") :]
    (mav0 / "imu0/sensor.yaml").write_text(f"{head}data: [{identity}]\n{tail}")
    t = np.arange(-0.1, 0.9, 0.005)
    write_readings(mav0 / "imu0/data.csv", "#timestamp [ns],w x,w y,w z,a x,a y,a z", t, 1e9, T0_NS)
    rows = ["#timestamp, p x, p y, p z, q w, q x, q y, q z"]
    for at, T in zip(t, upright(rooms.poses(t)) @ np.linalg.inv(T_body_cam), strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        rows.append(",".join(map(str, [T0_NS + round(1e9 * at), *T[:3, 3], w, x, y, z, *[0] * 9])))
    (mav0 / "state_groundtruth_estimate0/data.csv").write_text("\n".join(rows) + "\n")
    return folder


def write_readings(file, header, t, per_second, origin=0):
    """The IMU's readings as a table."""
    rate, force = rooms.readings(t, R_BODY_CAM)
    with file.open("w", newline="") as stream:
        stream.write(header + "\n")
        for at, row in zip(t, np.hstack([rate, force]).tolist(), strict=True):
            csv.writer(stream).writerow([origin + round(per_second * at), *row])


def icl_nuim(folder):
    """True poses in a world and a camera whose y points up, from the second frame on."""
    images(lambda k: folder / f"rgb/{k}.png", lambda k: folder / f"depth/{k}.png", per_mm=5)
    lines = [f"{k} depth/{k}.png {k} rgb/{k}.png" for k in range(COUNT)]
    (folder / "associations.txt").write_text("\n".join(lines) + "\n")
    mirror = np.diag([1.0, -1, 1, 1])
    rows = tum_rows(mirror @ WALK.T_world_cam @ mirror, map(str, range(COUNT)))
    (folder / "livingRoom2.gt.freiburg").write_text("\n".join(rows[1:]) + "\n")
    (folder / "camera-intrinsics.txt").write_text(K_TEXT)
    return folder


def sun3d(folder):
    """Depth's bits turned by three."""
    name = lambda k: f"{k:07d}-{100_000 * k:012d}.png"
    images(lambda k: folder / f"image/{name(k)}", lambda k: folder / f"depth/{name(k)}")
    for k, counts in enumerate(WALK.counts):
        save(folder / f"depth/{name(k)}", (counts << 3) | (counts >> 13))
    (folder / "intrinsics.txt").write_text(K_TEXT)
    (folder / "extrinsics").mkdir()
    np.savetxt(folder / "extrinsics/1.txt", WALK.T_world_cam[:, :3].reshape(3 * COUNT, 4))
    return folder


def plain(folder):
    """As Open3D captures, with times, in a world whose z is up."""
    images(lambda k: folder / f"rgb/{k:04d}.png", lambda k: folder / f"depth/{k}.png")
    matrix = [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]
    text = json.dumps({"width": SIZE[0], "height": SIZE[1], "intrinsic_matrix": matrix})
    (folder / "camera_intrinsic.json").write_text(text)
    (folder / "times.txt").write_text("".join(f"{STEP_S * k:.1f}\n" for k in range(COUNT)))
    np.savetxt(folder / "poses.txt", upright(WALK.T_world_cam).reshape(COUNT, 16))
    return folder


RECORDINGS = {
    "ros": ros,
    "azure_kinect": azure,
    "record3d": lambda folder: phones.record3d(folder / "a.r3d", WALK, K=K),
    "stray_scanner": lambda folder: phones.stray_scanner(folder, WALK, save, K=K),
    "arkitscenes": lambda folder: phones.arkitscenes(folder, WALK, save, K=K),
    "polycam": lambda folder: phones.polycam(folder, WALK, save, K=K),
    "nerfstudio": nerfstudio,
    "sevenscenes": sevenscenes,
    "tum": tum,
    "replica": replica,
    "scannet": scannet,
    "euroc": euroc,
    "icl_nuim": icl_nuim,
    "sun3d": sun3d,
    "plain": plain,
}


# --- photographs -----------------------------------------------------------------------------------------


def photographs(folder, suffix=".png", **options):
    """The images alone; names sort as they were taken."""
    names = [f"IMG_{k:04d}{suffix}" for k in range(len(PHOTOGRAPHS.rgb))]
    for name, rgb in zip(names, PHOTOGRAPHS.rgb, strict=True):
        save(folder / name, rgb, **options)
    return names


def llff(folder):
    """Columns down, right, back, centre, size; then the range of depths."""
    photographs(folder / "images")
    rows = []
    for T in PHOTOGRAPHS.T_world_cam:
        size = [SIZE[1], SIZE[0], K[0]]
        matrix = np.stack([T[:3, 1], T[:3, 0], -T[:3, 2], T[:3, 3], size], axis=-1)
        rows.append([*matrix.ravel(), 1.5, 4.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def transforms(folder):
    names = photographs(folder / "images")
    frames = [
        {"file_path": f"./images/{name}", "transform_matrix": (T @ phones.FLIP).tolist()}
        for name, T in zip(names, PHOTOGRAPHS.T_world_cam, strict=True)
    ]
    camera = {"fl_x": K[0], "fl_y": K[1], "cx": K[2] + 0.5, "cy": K[3] + 0.5, "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return folder


def colmap(folder):
    """A model by pycolmap, with some points of the walls."""
    names = photographs(folder / "images")
    scene = pycolmap.Reconstruction()
    center = [K[2] + 0.5, K[3] + 0.5]
    camera = pycolmap.Camera(
        model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[*K[:2], *center], camera_id=1
    )
    scene.add_camera_with_trivial_rig(camera)
    rays = rooms.pinhole()[::6, ::8].reshape(-1, 3)
    depth = PHOTOGRAPHS.counts[0][::6, ::8].reshape(-1, 1) / 1000
    points = rays * depth  # the first camera's axes are the world's
    for number, (name, T) in enumerate(zip(names, PHOTOGRAPHS.T_world_cam, strict=True), start=1):
        inverse = np.linalg.inv(T)
        seen = points @ inverse[:3, :3].T + inverse[:3, 3]
        pixels = seen[:, :2] / seen[:, 2:] * K[:2] + center
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, keypoints=pixels)
        turn = pycolmap.Rotation3d(inverse[:3, :3])
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, inverse[:3, 3]))
    for k, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(n + 1, k) for n in range(len(names))])
        scene.add_point3D(point, track, np.array([200, 100, 50], np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    scene.write(folder / "sparse/0")
    return folder


def photographs_alone(folder):
    """JPEGs as a phone writes them: the focal length of a film of 36 mm."""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(36 * K[0] / SIZE[0])
    photographs(folder, ".JPG", exif=exif, quality=95)
    return folder


def video(folder):
    """A film, and its gyroscope in degrees."""
    with av.open(str(folder / "clip.mp4"), "w") as container:
        track = container.add_stream("libx264", rate=10, options={"crf": "4"})
        (track.width, track.height), track.pix_fmt = SIZE, "yuv420p"
        for rgb in PHOTOGRAPHS.rgb[:8]:
            container.mux(track.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(track.encode(None))
    t = np.arange(-0.1, 1.0, 0.01)
    rate = np.degrees(rooms.readings(t, R_BODY_CAM)[0]).tolist()
    rows = [",".join(map(str, [round(1e6 * at), *row])) for at, row in zip(t, rate, strict=True)]
    (folder / "clip.csv").write_text("\n".join(["t [us],gyro_x,gyro_y,gyro_z", *rows]) + "\n")
    return folder / "clip.mp4"


PHOTOS = {
    "llff": llff,
    "transforms": transforms,
    "colmap": colmap,
    "plain": photographs_alone,
    "video": video,
}


# --- events ----------------------------------------------------------------------------------------------

EVENTS = rooms.events()
POSES_S = np.linspace(0, 0.7, 15)  # on the clock of the events
CALIB = " ".join(map(str, (*K, 0, 0, 0, 0, 0)))


def beside(folder, name="poses.txt"):
    """Poses and camera as text."""
    (folder / "calib.txt").write_text(CALIB + "\n")
    rows = tum_rows(rooms.poses(POSES_S), [f"{at:.6f}" for at in POSES_S])
    (folder / name).write_text("\n".join(rows) + "\n")


def eventnerf(folder):
    """Views evenly spaced until the last event."""
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = [K[0], K[1], K[2] + 0.5, K[3] + 0.5]
    for kind in ("pose", "intrinsics", "events"):
        (folder / kind).mkdir()
    for k, T in enumerate(rooms.poses(np.linspace(0, EVENTS[-1, 0] / 1e6, 15))):
        (folder / f"pose/r_{k:05d}.txt").write_text(" ".join(map(str, T.ravel())))
        (folder / f"intrinsics/r_{k:05d}.txt").write_text(" ".join(map(str, matrix.ravel())))
        save(folder / f"rgb/r_{k:05d}.png", np.zeros((*SIZE[::-1], 3), np.uint8))
    t, x, y, p = EVENTS.T
    np.savez(folder / "events/room.npz", t=t, x=x, y=y, p=2 * p - 1)
    return folder


def davis(folder):
    (folder / "events.txt").write_text("".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in EVENTS))
    beside(folder, "groundtruth.txt")
    return folder


def event_hdf5(folder):
    with h5py.File(folder / "events.h5", "w") as file:
        for name, column in zip(("ts", "xs", "ys", "ps"), EVENTS.T, strict=True):
            file[f"events/{name}"] = column
    beside(folder)
    return folder


def event_npz(folder):
    np.savez(folder / "events.npz", **dict(zip("txyp", EVENTS.T, strict=True)))
    beside(folder)
    return folder / "events.npz"


def aedat4(folder):
    file = folder / "room.aedat4"
    writer = dv.io.MonoCameraWriter(str(file), dv.io.MonoCameraWriter.EventOnlyConfig("DAVIS", SIZE))
    store = dv.EventStore()
    for t, x, y, p in EVENTS.tolist():
        store.push_back(t, x, y, bool(p))
    writer.writeEvents(store)
    del writer
    beside(folder)
    return file


def event_ros(folder):
    columns = (T0_NS + 1000 * EVENTS[:, 0], *EVENTS[:, 1:].T)
    times = [T0_NS + round(1e9 * at) for at in POSES_S]
    return event_bag(folder, "mcap", columns, SIZE, K, times, rooms.poses(POSES_S))


EVENT_FILES = {
    "eventnerf": eventnerf,
    "davis": davis,
    "hdf5": event_hdf5,
    "npz": event_npz,
    "file": aedat4,
    "ros": event_ros,
}

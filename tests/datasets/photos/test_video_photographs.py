"""A film of a made room by PyAV, and what a gyroscope in another unit, on another clock and axes wrote."""

import av
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxpose.datasets.photos import registry
from jaxpose.datasets.rgbd import registry as rgbd_registry
from jaxpose.errors import DataError

COUNT, RATE, SIZE, FOCAL = 60, 30, (160, 120), 130.0
R_CAM_PHONE = Rotation.from_matrix([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])  # sensors' axes of a phone
START_S = 0.73  # of the first frame after the first reading


def attitude(t):
    """Camera to world: a hand that shakes about three axes."""
    t = np.asarray(t)
    waves = [0.15 * np.sin(5 * t), 0.2 * np.sin(3.1 * t + 1), 0.1 * np.sin(4.3 * t + 2)]
    return Rotation.from_rotvec(np.stack(waves, axis=-1))


def frames():
    """A wall of blobs far away, seen by a camera that also moves a little."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-6, 6, (900, 2)), np.full(900, 6.0)])
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    for k in range(COUNT):
        seen = attitude(k / RATE).inv().apply(points - [0.05 * k / RATE, 0, 0])
        pixels = seen[:, :2] / seen[:, 2:] * FOCAL + (np.array(SIZE) - 1) / 2
        image = np.zeros(SIZE[::-1])
        for x, y in pixels[(seen[:, 2] > 0) & (np.abs(pixels - 70) < 100).all(1)]:
            near = (slice(max(int(y) - 4, 0), int(y) + 5), slice(max(int(x) - 4, 0), int(x) + 5))
            image[near] += np.exp(-((u[near] - x) ** 2 + (v[near] - y) ** 2) / 3)
        yield np.repeat((255 * np.clip(image, 0, 1)).astype(np.uint8)[..., None], 3, axis=-1)


def film(folder, turned=False):
    file = folder / "clip.mp4"
    with av.open(str(file), "w") as container:
        track = container.add_stream("libx264", rate=RATE, options={"crf": "12"})
        (track.width, track.height), track.pix_fmt = SIZE, "yuv420p"
        for pixels in frames():
            container.mux(track.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(track.encode(None))
    if turned:  # ISO/IEC 14496-12, tkhd: 16.16 numbers a b u c d v x y w; as a phone held upright has it
        number = lambda *values: b"".join(x.to_bytes(4, "big", signed=True) for x in values)
        one = 1 << 16
        content = file.read_bytes()
        at = content.index(number(one, 0, 0, 0, one, 0, 0, 0, 1 << 30), content.index(b"tkhd"))
        matrix = number(0, one, 0, -one, 0, 0, SIZE[1] * one, 0, 1 << 30)
        file.write_bytes(content[:at] + matrix + content[at + 36 :])
    return file


def gyroscope(file, head="timestamp [ns],gyro_x,gyro_y,gyro_z", scale=180 / np.pi, rate=attitude):
    """Readings at 200 Hz in a phone's axes and degrees, on the clock since it was switched on."""
    t = np.arange(-START_S, COUNT / RATE + 0.5, 0.005)
    step = 1e-4
    omega = (rate(t - step).inv() * rate(t + step)).as_rotvec() / (2 * step)
    rows = scale * R_CAM_PHONE.inv().apply(omega) + 0.002
    lines = [
        f"{5_000_000_000_123 + round(1e9 * a)},{x},{y},{z}" for a, (x, y, z) in zip(t, rows, strict=True)
    ]
    file.write_text("\n".join([head, *lines]) + "\n")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"))


@pytest.mark.parametrize("head, scale, name", [
    ("timestamp [ns],gyro_x,gyro_y,gyro_z", 180 / np.pi, "clip_imu.csv"),
    ("time,x,y,z", 1.0, "Gyroscope.csv"),
    ("t [ns],wx [deg/s],wy [deg/s],wz [deg/s]", 180 / np.pi, "other.csv"),
])  # fmt: skip
def test_rotations_are_found_in_any_unit_clock_and_axes(clip, head, scale, name):
    gyroscope(clip.parent / name, head, scale)
    try:
        train, held_out = registry.load_photographs(clip, focal_px=FOCAL)
    finally:
        (clip.parent / name).unlink()
    assert (len(train.t), len(held_out.t), train.rgb.shape) == (COUNT, 0, (COUNT, 120, 160, 3))
    np.testing.assert_allclose(train.t, np.arange(COUNT) / RATE, atol=1e-6)
    assert np.isnan(train.T_world_cam).all() and train.camera[:4] == (FOCAL, FOCAL, 79.5, 59.5)
    wanted = attitude(0).inv() * attitude(train.t)
    off = (wanted.inv() * Rotation.from_matrix(train.turns)).magnitude()
    assert np.degrees(off.max()) < 1.0
    (note,) = (note for note in train.notes if name in note)
    unit = "rad/s" if scale == 1 else "deg/s"
    assert f"{name}: {unit}, first frame 0.7" in note


def test_a_gyroscope_of_another_film_is_not_used(clip):
    file = clip.parent / "gyro.csv"
    gyroscope(file, rate=lambda t: Rotation.from_rotvec(np.outer(np.sin(9 * t), [0.1, 0.3, -0.2])))
    train, _ = registry.load_photographs(clip.parent, focal_px=FOCAL)
    file.unlink()
    assert train.turns is None and any("gyro.csv is not used: it does not turn" in n for n in train.notes)


def test_a_film_of_an_upright_phone(tmp_path):
    file = film(tmp_path, turned=True)
    gyroscope(tmp_path / "clip.csv")
    stored = next(iter(frames()))
    train, _ = registry.load_photographs(file, focal_px=FOCAL)
    assert train.rgb.shape == (COUNT, 160, 120, 3)
    shown = np.rot90(stored, -1).astype(float)  # to the right, as such phones are held
    assert np.corrcoef(train.rgb[0].ravel(), shown.ravel())[0, 1] > 0.97
    small, _ = registry.load_photographs(file, focal_px=FOCAL, width=60)
    assert small.rgb.shape == (COUNT, 80, 60, 3) and small.camera.fx == FOCAL / 2
    turn = Rotation.from_rotvec([0, 0, np.pi / 2])  # x of the shown camera is -y of the stored
    wanted = turn * attitude(0).inv() * attitude(train.t) * turn.inv()
    off = (wanted.inv() * Rotation.from_matrix(train.turns)).magnitude()
    assert np.degrees(off.max()) < 1.0


def test_what_is_lacking_is_named(clip, tmp_path):
    assert registry.find_format(clip) == registry.find_format(clip.parent) == "video"
    with pytest.raises(DataError, match="clip.mp4: expected a focal length, .*: --focal-px says it"):
        registry.load_photographs(clip)
    with pytest.raises(DataError, match="clip.mp4: expected an image at least 200 wide, got 160"):
        registry.load_photographs(clip, focal_px=FOCAL, width=200)
    (tmp_path / "a.mp4").write_bytes(b"no film")
    with pytest.raises(DataError, match="a.mp4: expected a video, got"):
        registry.load_photographs(tmp_path / "a.mp4", focal_px=FOCAL)
    with pytest.raises(DataError, match="got a video without depth, of which .nerf. takes photographs"):
        rgbd_registry.find_format(clip)

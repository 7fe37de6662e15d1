"""`jaxpose view`: what a scene holds, what a saved page plays, wrong calls."""

import base64
import io as std_io
import re
import socket
import sys
import threading
import time
from functools import partial

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
import trimesh
import zstandard
from helpers import refused
from helpers.blocks import filled
from PIL import Image

from jaxpose import fields
from jaxpose.cli import main as main_command
from jaxpose.cli.view import command as view
from jaxpose.cli.view import page as view_page
from jaxpose.cli.view.command import Config
from jaxpose.cli.view.scene import read_scene, up_direction
from jaxpose.cli.view.types import WIDTH
from jaxpose.errors import DataError
from jaxpose.experiments.slam.map_file import read_map, write_map
from jaxpose.files import atomic, trajectories
from jaxpose.files.camera_json import write_camera
from jaxpose.files.ply import write_ply
from jaxpose.geometry.camera import Camera
from jaxpose.scenes.voxel_blocks import BlockConfig
from jaxpose.slam import SavedMap
from jaxpose.slam.map.texture import Texture
from jaxpose.slam.tracking.features import Features

COUNT, LAST, FIRST, SPEED = 9, 2.0, 5.0, 0.3  # frames, span [s], first timestamp [s], along x [m/s]
CAMERA = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
WALL = 1.5  # [m] along z; red where x < 0.1, blue beyond
RED, BLUE = (255, 0, 0), (0, 0, 255)


def poses_at(t):
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3] = SPEED * np.asarray(t)
    return T


def red_and_blue_wall(points):
    """Distance and colour of a wall, red to the left of x = 0 and blue from 0.1 on."""
    values = np.zeros((*points.shape[:-1], 4))
    values[..., 0] = np.clip(WALL - points[..., 2], -0.3, 0.3)
    left = points[..., 0] < 0.05
    values[..., 1], values[..., 3] = left, ~left
    return values


@pytest.fixture
def run(tmp_path):
    """What a SLAM run leaves: a camera that slides along a wall of two colours, timestamps from 5 s on."""
    folder = tmp_path / "run"
    folder.mkdir()
    span, intervals = (FIRST, FIRST + LAST), 4
    points = np.zeros((intervals + 3, 7))
    points[:, 0] = SPEED * (np.arange(intervals + 3) - 1) * LAST / intervals
    fields.save(folder / "field.npz", fields.bspline(span, len(points) - 3), jnp.asarray(points))
    t = np.linspace(0, LAST, COUNT)
    trajectories.write_tum(folder / "trajectory.txt", trajectories.Trajectory(FIRST + t, poses_at(t)))
    ground_truth = poses_at(t)
    ground_truth[:, 1, 3] = 0.01
    trajectories.write_tum(folder / "reference.txt", trajectories.Trajectory(FIRST + t, ground_truth))
    names = tuple(f"{k}.png" for k in range(COUNT))
    for k, name in enumerate(names):
        Image.new("RGB", (320, 240), (k, 0, 0)).save(folder / name)
    write_camera(folder / "camera.json", CAMERA, names, ".")
    config = BlockConfig(0.1, 0.3)
    blocks = filled(config, (-2.0, -2.0, -0.4), (2.4, 2.0, 2.0), red_and_blue_wall)
    untextured = Texture(np.zeros(blocks.coords.shape[0], np.int32), np.zeros((1, 17, 17, 17, 4), np.uint8))
    kept, few = (
        np.array([0, 4]),
        Features(np.ones((2, 3)), np.ones(2), np.ones(2), np.zeros((2, 32), np.uint8)),
    )
    saved = SavedMap(config, blocks, untextured, kept, poses_at(t)[kept], (few, few), (1.0, 0.02))
    write_map(folder / "map.npz", saved)
    corners = np.array([[-1, -1, WALL], [1, -1, WALL], [1, 1, WALL]])
    write_ply(folder / "mesh.ply", corners, np.full((3, 3), 200, np.uint8), np.array([[0, 2, 1]]))
    atomic.write_json(folder / "results.json", {"experiment": "rgbd_slam"})
    return folder


def test_what_a_scene_holds(run):
    scene = read_scene(run, 5)
    assert scene.notes == () and "rgbd_slam run, 9 poses" in scene.name
    np.testing.assert_allclose(scene.t, np.linspace(0, LAST, COUNT), atol=1e-9)
    steps = np.linspace(0, LAST, len(scene.path))
    np.testing.assert_allclose(scene.path, poses_at(steps)[:, :3, 3], atol=1e-6)
    assert len(scene.path) > 5 * COUNT  # the field's, not a polygon of the frames
    np.testing.assert_allclose(scene.reference[:, :2], np.stack([SPEED * scene.t, np.full(9, 0.01)], 1))
    np.testing.assert_allclose(scene.keyframes, poses_at(scene.t[[0, 4]])[:, :3, 3], atol=1e-9)
    assert [shot.t for shot in scene.shots] == pytest.approx([0, 0.5, 1, 1.5, 2])
    for k, shot in zip((0, 2, 4, 6, 8), scene.shots, strict=True):  # each image holds its number
        assert shot.rgb.shape == (120, WIDTH, 3) and (shot.rgb == (k, 0, 0)).all()
        np.testing.assert_allclose(shot.T_world_cam, poses_at([shot.t])[0], atol=1e-9)
    assert scene.surface == run / "mesh.ply" and scene.camera == CAMERA
    np.testing.assert_array_equal(scene.up, [0, -1, 0])


@pytest.mark.parametrize("t", [0.0, 0.77, 2.0])
def test_a_render_is_what_the_camera_sees_at_that_time(run, t):
    picture = read_scene(run, 0).render(t, WIDTH)
    assert picture.shape == (120, 160, 3)
    # Colours of the grid pass from the node at x = 0 to that at 0.1: half of either at 0.05.
    border = CAMERA.cx + CAMERA.fx * (0.05 - SPEED * t) / WALL
    columns = np.arange(160)
    assert border > 20
    assert np.abs(picture[:, columns < border - 10].astype(int) - RED).max() < 3
    assert np.abs(picture[:, columns > border + 10].astype(int) - BLUE).max() < 3
    row = picture[60].astype(int)
    assert np.argmax(row[:, 2] > row[:, 0]) == pytest.approx(border, abs=1)


def test_what_is_not_there_is_noted(run):
    (run / "3.png").unlink()
    scene = read_scene(run, 2)
    assert [shot.rgb.shape for shot in scene.shots] == [(60, 80, 3)] * 2  # renders
    assert "not all images" in scene.notes[0] and "frustums show renders" in scene.notes[1]
    for name in ("map.npz", "mesh.ply", "reference.txt"):
        (run / name).unlink()
    scene = read_scene(run, 2)
    assert scene.render is None and scene.shots[0].rgb is None and scene.surface is None
    assert len(scene.keyframes) == 0 and scene.reference is None
    assert "no renders" in scene.notes[1]
    (run / "field.npz").unlink()
    (run / "camera.json").unlink()
    scene = read_scene(run, 2)
    assert "no field.npz" in scene.notes[0] and "no camera.json" in scene.notes[1]
    np.testing.assert_allclose(scene.poses(np.array([0.9, 1.1])), poses_at([1, 1]))  # 0.75, 1, 1.25, 2


def test_a_trajectory_file(run):
    scene = read_scene(run / "trajectory.txt", 3)
    assert len(scene.path) == COUNT and len(scene.shots) == 3 and scene.render is None


def test_a_truth_in_a_world_of_its_own(run):
    """It begins after the run: the run could not start from it."""
    t = np.linspace(0, LAST, COUNT)[2:]
    T = np.diag([-1.0, -1.0, 1.0, 1.0]) @ poses_at(t) + 0.0
    T[:, 1, 3] = 7 + 0.1 * t**2
    moved = poses_at(t)
    moved[:, 1, 3] = -0.1 * t**2
    trajectories.write_tum(run / "reference.txt", trajectories.Trajectory(FIRST + t, T))
    scene = read_scene(run, 0)
    assert "moved onto the estimate" in " ".join(scene.notes)
    distance = np.linalg.norm(np.diff(scene.reference, axis=0), axis=1)
    np.testing.assert_allclose(distance, np.linalg.norm(np.diff(moved[:, :3, 3], axis=0), axis=1), atol=1e-9)
    assert np.abs(scene.reference - poses_at(t)[:, :3, 3]).max() < 0.2


def test_the_overview_has_the_path_before_it(run):
    scene = read_scene(run, 0)
    wall = np.random.default_rng(0).uniform([-1, -1, WALL], [1, 1, WALL], (500, 3))
    eye, centre, size = view_page.overview(scene, wall)
    assert eye[2] < 0 and eye[1] < centre[1]  # behind the cameras, which look along z, and above: up is -y
    forward = (centre - eye) / np.linalg.norm(centre - eye)
    away = np.concatenate([scene.path, wall]) - eye
    angle = np.arccos(away @ forward / np.linalg.norm(away, axis=1))
    assert np.degrees(angle).max() < 75 / 2  # half of viser's field of view


def test_up_is_where_upright_cameras_say():
    down = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # x right, image down is -z: z is up
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3] = down
    np.testing.assert_array_equal(up_direction(T), [0, 0, 1])
    T[:, :3, :3] = trimesh.transformations.rotation_matrix(0.7, [1, 0, 0])[:3, :3] @ down
    np.testing.assert_allclose(up_direction(T), [0, -np.sin(0.7), np.cos(0.7)])


def played(file):
    """Seconds and messages of a saved page, as viser's own client would read them."""
    page = file.read_text()
    data = base64.b64decode(re.search(r'window.__VISER_EMBED_DATA__="([^"]*)"', page)[1])
    content = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    size = int.from_bytes(content[:8], "little")
    told = msgspec.msgpack.decode(content[8 : 8 + size])
    return page, told["durationSeconds"], told["messages"]


@pytest.mark.slow
def test_a_saved_page_plays_the_way_of_the_camera(run, tmp_path, capsys):
    out = tmp_path / "new" / "page.html"
    main_command.main(["view", str(run), "--save", str(out), "--frustums", "4"])
    told = capsys.readouterr()
    assert str(out) in told.out and "opens in any browser" in told.out
    assert "rendering  0/" in told.err
    page, duration, messages = played(out)
    assert not re.search(r'<(script|link)[^>]*(src|href)="http', page)
    assert duration == pytest.approx(LAST)
    made = {
        message["name"]
        for _, message in messages
        if message["type"].endswith("Message") and "name" in message
    }
    assert {"/estimate", "/ground truth", "/keyframes", "/camera", "/map"} <= made
    assert sum(name.startswith("/frames/") for name in made) == 4
    told = [(t, message) for t, message in messages if message.get("name") == "/camera"]
    way = np.array([(t, *message["position"]) for t, message in told if "position" in message])
    assert len(way) >= 30 and way[-1, 0] == pytest.approx(LAST)
    np.testing.assert_allclose(way[:, 1:], poses_at(way[:, 0])[:, :3, 3], atol=1e-5)
    pictures = [(t, message["updates"]["_image_data"]) for t, message in told if "updates" in message]
    for t, data in (pictures[0], pictures[len(pictures) // 2], pictures[-1]):
        np.testing.assert_array_equal(Image.open(std_io.BytesIO(data)), read_scene(run, 0).render(t, WIDTH))


def test_the_last_value_asked_for_is_worked_on():
    begun, go, done = threading.Event(), threading.Event(), []

    def work(value):
        begun.set()
        go.wait(10)
        done.append(value)

    ask, stop = view_page.latest(work, lambda error: None)
    ask(1.0)
    assert begun.wait(10)
    for value in (2.0, 3.0, 4.0):
        ask(value)
    go.set()
    for _ in range(1000):
        if len(done) == 2:
            break
        time.sleep(0.01)
    stop()
    assert done == [1.0, 4.0]


def test_a_port_that_is_taken(run):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        shown = view.run(Config(run, port=port, frustums=0))
        try:
            url = shown.url
            assert url.startswith("http://localhost:") and not url.endswith(f":{port}")
            assert f"port {port} is taken" in view.report(shown)
            with socket.create_connection(("127.0.0.1", int(url.split(":")[-1])), timeout=10):
                pass
        finally:
            shown.close()


complaint = partial(refused.complaint, lambda args: main_command.main(["view", *args]))


def test_wrong_calls_cost_one_line(run, tmp_path):
    (tmp_path / "empty").mkdir()
    assert complaint(tmp_path / "empty").startswith("jaxpose view: ")
    assert "expected a run folder with trajectory.txt" in complaint(tmp_path / "empty")
    assert "runs in it: run" in complaint(tmp_path)
    assert "got nothing" in complaint(tmp_path / "none")
    assert "--save: expected a name that ends in .html or .gif" in complaint(run, "--save", "x.viser")
    assert "--port: expected" in complaint(run, "--port", "65536")
    assert "--frustums: expected" in complaint(run, "--frustums", "-1")
    (run / "mesh.ply").write_text("no mesh")
    assert "mesh.ply: expected a PLY" in complaint(run, "--frustums", "0")
    (run / "map.npz").write_text("no map")
    assert "map.npz: expected a map" in complaint(run)


def test_a_map_of_another_kind(run):
    with np.load(run / "map.npz") as file:
        content = dict(file)
    np.savez(run / "map.npz", **(content | {"version": 1}))
    with pytest.raises(DataError, match="map.npz: expected a map of version 4, got 1"):
        read_scene(run, 0)
    np.savez(run / "map.npz", **(content | {"keyframes": np.array([0, 9])}))
    with pytest.raises(DataError, match="map.npz: expected keyframes below 9, got 9"):
        read_scene(run, 0)
    count = len(content["coords"])
    for change, words in (
        ({"voxel": -0.1}, "voxel: expected a finite number above 0 up to 10000, got -0.1"),
        (
            {"values": np.full_like(content["values"], np.nan)},
            "values: expected .* finite numbers .*, got nan",
        ),
        ({"values": content["values"][:-1]}, "values: expected .*, got shape"),
        ({"coords": np.zeros((count, 3), int)}, "coords: expected blocks beside each other"),
        ({"coords": content["coords"] * 10**6}, "coords: expected blocks beside each other"),
        ({"texture_slot": np.full(count, 5)}, "texture_slot: expected .* from 0 to 0, got 5"),
        ({"texture_tiles": np.zeros((1, 17, 17, 17, 4))}, "texture_tiles: expected uint8 .* got float64"),
        ({"keyframes": np.array([-1])}, "keyframes: expected n whole numbers of at least 0, got -1"),
        (
            {"fusion": content["fusion"].astype(float)},
            "fusion: expected int16 of 4 for each node, got float64",
        ),
        ({"keyframe_T_world_cam": np.zeros((2, 4, 4))}, "keyframe_T_world_cam: expected rigid transforms"),
        ({"keyframe_T_world_cam": np.zeros((3, 4))}, "keyframe_T_world_cam: expected .*, got float64"),
        ({"keyframe_T_world_cam": np.eye(4)[None]}, "feature_count: expected 1 that sum up to 4, got 2 to 4"),
        ({"usual": np.array([1.0, -1.0])}, "usual: expected 2 finite numbers from 0 .*, got -1"),
        ({"feature_count": np.array([2, 3])}, "feature_count: expected 2 that sum up to 4, got 2 to 5"),
        ({"feature_count": np.array([4])}, "feature_count: expected 2 that sum up to 4, got 1 to 4"),
        ({"feature_depth": np.full(4, np.nan)}, "feature_depth: expected .* finite .*, got nan"),
        ({"feature_scale": np.zeros(4)}, "feature_scale: expected .* above 0 .*, got 0"),
        ({"feature_descriptor": np.zeros((4, 8))}, "feature_descriptor: expected uint8 .*, got float64"),
    ):
        np.savez(run / "map.npz", **(content | {name: np.asarray(value) for name, value in change.items()}))
        with pytest.raises(DataError, match=f"map.npz: {words}"):
            read_map(run / "map.npz")


def test_without_the_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "jaxpose.cli.view.page")
    monkeypatch.delattr("jaxpose.cli.view.page")
    assert complaint(run) == 'jaxpose view: expected viser, got none: pip install -e ".[viewer]"'


def test_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main_command.main(["view", "--help"])
    assert not stop.value.code
    told = capsys.readouterr().out
    for word in ("RUN", "--port", "--save", "--frustums", "slider"):
        assert word in told

"""The page of a run: what `scene` found, drawn with viser, with a slider for time, or in a file."""

import html
import io
import queue
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import viser
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxpose._terminal import printable
from jaxpose.cli.view.access import Access, guarding
from jaxpose.cli.view.types import WIDTH, Picture, Scene
from jaxpose.errors import DataError
from jaxpose.experiments.progress import OnUpdate, Update, silent
from jaxpose.files.atomic import atomic
from jaxpose.geometry.camera import angle_of_view

_SAVED_FRAMES = 100  # of the camera on its way in a saved file, at most
_ESTIMATE, _TRUTH, _KEYFRAME, _CAMERA = (31, 119, 180), (214, 39, 40), (255, 127, 14), (44, 160, 44)


def serve(scene: Scene, allowed: Access, port: int) -> tuple[int, Callable[[], None]]:
    """Show the scene at a port, or at the next free one, which is returned with what ends it."""
    with guarding(allowed):
        server = _server(allowed.host, port)
    try:
        picture = None if scene.render is None else scene.render(0.0, WIDTH)
        stop = _panel(server, scene, _draw(server, scene, picture), picture)
    except BaseException:
        _stop(server)
        raise

    def close() -> None:
        stop()
        _stop(server)

    return server.get_port(), close


def save(scene: Scene, file: Path, on_update: OnUpdate = silent) -> None:
    """Write the scene as one HTML file that plays the camera's motion, as fast as it was."""
    server = _server("127.0.0.1", 0)
    try:
        camera = _draw(server, scene, None)
        recording = server.get_scene_serializer()
        last = float(scene.t[-1])
        count = min(_SAVED_FRAMES, max(2, round(30 * last)))
        for k, t in enumerate(np.linspace(0, last, count)):
            on_update(Update("rendering", k, count, "frames"))
            if k:
                recording.insert_sleep(last / (count - 1))
            _move(camera, scene, float(t))
            if scene.render is not None:
                camera.image = scene.render(float(t), WIDTH)
        on_update(Update(f"writing {file}"))
        page = recording.as_html()
    finally:
        _stop(server)
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic(file) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _server(host: str, port: int) -> viser.ViserServer:
    with redirect_stdout(io.StringIO()):
        return viser.ViserServer(host, port, verbose=False)


def _stop(server: viser.ViserServer) -> None:
    with redirect_stdout(io.StringIO()):  # it says goodbye
        server.stop()


def _draw(server: viser.ViserServer, scene: Scene, picture: Picture | None) -> Any:
    """Everything that stands still, and the camera that the slider moves, which is returned."""
    path, add = scene.path, server.scene
    add.set_up_direction(tuple(scene.up))
    surface = path[:0] if scene.surface is None else _surface(add, scene.surface)
    eye, centre, size_of_all = overview(scene, surface)
    server.initial_camera.position, server.initial_camera.look_at = eye, centre
    size = float(np.linalg.norm(np.ptp(path, axis=0)))
    frustum = max(0.035 * size, 0.012 * size_of_all)
    thickness = 0.0015 * size_of_all
    _line(add, "/estimate", path, _ESTIMATE, thickness)
    if scene.reference is not None:
        _line(add, "/ground truth", scene.reference, _TRUTH, thickness)
    if len(scene.keyframes):
        add.add_point_cloud(
            "/keyframes",
            scene.keyframes.astype(np.float32),
            _KEYFRAME,
            point_size=2.5 * thickness,
            point_shape="circle",
            precision="float32",
        )
    fov = angle_of_view(scene.camera)[1]
    aspect = scene.camera.width / scene.camera.height
    add.add_frame("/frames", show_axes=False)
    for number, shot in enumerate(scene.shots):
        add.add_camera_frustum(
            f"/frames/{number:04d}", fov, aspect, scale=frustum, thickness=0.5 * thickness, color=_ESTIMATE,
            image=shot.rgb, **_placed(shot.T_world_cam),
        )  # fmt: skip
    first = scene.poses(np.zeros(1))[0]
    return add.add_camera_frustum(
        "/camera", fov, aspect, scale=2.5 * frustum, thickness=thickness, color=_CAMERA, format="png",
        image=picture, **_placed(first),
    )  # fmt: skip


def overview(
    scene: Scene, surface: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Where to look from, the middle of the path and most of the surface, and their diagonal.

    The look is from above, and from behind the cameras if these look to one side.
    """
    corners = [scene.path.min(axis=0), scene.path.max(axis=0)]
    if len(surface):
        corners += [*np.percentile(surface, [2, 98], axis=0)]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
    up, behind = scene.up, -scene.poses(scene.t)[:, :3, 2].mean(axis=0)
    behind -= (behind @ up) * up
    if np.linalg.norm(behind) < 0.3:
        behind = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return centre + size * (0.52 * behind / np.linalg.norm(behind) + 0.6 * up), centre, size


def _move(camera: Any, scene: Scene, t: float) -> None:
    """The camera to where it is at a time [s]."""
    for name, value in _placed(scene.poses(np.array([t]))[0]).items():
        setattr(camera, name, value)


def _placed(T_world_cam: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    wxyz = Rotation.from_matrix(T_world_cam[:3, :3]).as_quat(scalar_first=True)
    return {"wxyz": wxyz, "position": T_world_cam[:3, 3]}


def _line(add: Any, name: str, points: Float[np.ndarray, "n 3"], colour, thickness: float) -> None:
    pieces = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
    add.add_line_segments(name, pieces, colour, thickness=thickness)


def _surface(add: Any, file: Path) -> Float[np.ndarray, "n 3"]:
    """The map; returns its points."""
    try:
        shape: Any = trimesh.load(file, process=False)
        points = np.asarray(shape.vertices, np.float32)
        if isinstance(shape, trimesh.PointCloud):
            spacing = float(np.linalg.norm(np.ptp(points, axis=0))) / 400
            add.add_point_cloud("/map", points, np.asarray(shape.colors)[:, :3], point_size=spacing)
        elif len(points):
            add.add_mesh_trimesh("/map", shape)
    except Exception as error:  # trimesh raises many kinds on damaged files
        raise DataError(f"{file}: expected a PLY, got {' '.join(str(error).split())}") from None
    return points


def _panel(
    server: viser.ViserServer, scene: Scene, camera: Any, picture: Picture | None
) -> Callable[[], None]:
    """The panel: time, the picture at it, what is shown; returns what ends its work."""
    gui, last = server.gui, float(scene.t[-1])
    gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    gui.set_panel_label("jaxpose")
    step = 10.0 ** np.floor(np.log10(last / 200)) if last else 1.0
    time = gui.add_slider("time [s]", 0.0, float(max(1, np.ceil(last / step)) * step), float(step), 0.0)
    shows = None
    if picture is not None:
        shows = gui.add_image(picture, label="render at this time", format="png")

    def render(t: float) -> None:
        assert scene.render is not None and shows is not None
        shows.image = camera.image = scene.render(min(t, last), WIDTH)

    said = gui.add_html("", visible=False)

    def show(error: Exception | None) -> None:
        said.content = "" if error is None else paragraphs(f"at this time: {error or type(error).__name__}")
        said.visible = error is not None

    ask, stop = latest(render, show)

    @time.on_update
    async def _(event) -> None:  # on the server's own thread, so one after the other
        try:
            with server.atomic():
                _move(camera, scene, min(time.value, last))
        except Exception as error:  # it is shown, and the page lives on
            return show(error)
        if scene.render is not None:
            ask(time.value)

    for name, label in (
        ("/estimate", "estimate (blue)"),
        ("/ground truth", "ground truth (red)"),
        ("/keyframes", "keyframes (orange)"),
        ("/frames", "frames"),
        ("/camera", "camera (green)"),
        ("/map", "map"),
    ):
        node = server.scene.get_handle_by_name(name)
        if node is not None:
            _switch(gui, node, label)
    gui.add_html(paragraphs(scene.name, *scene.notes))
    return stop


def paragraphs(*texts: str) -> str:
    """Texts as HTML that shows them letter by letter: names in a run folder may be anybody's."""
    return "".join(f"<p>{html.escape(printable(text))}</p>" for text in texts)


def _switch(gui: Any, node: Any, label: str) -> None:
    box = gui.add_checkbox(label, True)

    @box.on_update
    def _(event) -> None:
        node.visible = box.value


def latest(
    work: Callable[[float], None], show: Callable[[Exception | None], None]
) -> tuple[Callable[[float], None], Callable[[], None]]:
    """Ask for a value to be worked on, one at a time and the last one first: those it overtakes are dropped.

    The second function ends the work. `show` is called with what went wrong, or None, after each.
    """
    asked: queue.SimpleQueue[float | None] = queue.SimpleQueue()

    def loop() -> None:
        while True:
            value = asked.get()
            while not asked.empty() and value is not None:
                value = asked.get()
            if value is None:
                return
            try:
                work(value)
            except Exception as error:  # the next value may do
                show(error)
            else:
                show(None)

    threading.Thread(target=loop, daemon=True).start()
    return asked.put, lambda: asked.put(None)

"""The front door: what `import jaxpose` and its rooms give, and what a user makes of these names alone."""

import importlib.metadata
import os
import pkgutil
import subprocess
import sys
import types
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxpose

ROOMS = (
    "jaxpose datasets datasets.events datasets.photos datasets.rgbd datasets.synthetic evaluation events"
    " fields files geometry imu plots scenes slam training"
).split()
PACKAGES = [name if name == "jaxpose" else f"jaxpose.{name}" for name in ROOMS]


def python(code: str, **environment: str) -> str:
    """What a new interpreter prints."""
    found = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | environment,
    )
    return found.stdout.strip()


@pytest.mark.parametrize(
    "imported, others",
    [
        ("import jaxpose; jaxpose.__version__; jaxpose.__all__; dir(jaxpose)", {"lazy_loader"}),
        ("from jaxpose.errors import DataError", {"lazy_loader"}),
        ("from jaxpose.fields.numpy_evaluator import load", {"lazy_loader", "numpy"}),
    ],
)
def test_an_import_brings_what_it_needs_only(imported, others):
    code = f"import sys; before = set(sys.modules); {imported}; print(*(set(sys.modules) - before))"
    brought = {name.split(".")[0] for name in python(code).split()}
    assert brought - sys.stdlib_module_names <= {"jaxpose", *others}


@pytest.mark.parametrize("name", PACKAGES)
def test_every_name_of_a_room_is_there(name):
    package = importlib.import_module(name)
    assert package.__all__ and len(set(package.__all__)) == len(package.__all__)
    assert set(package.__all__) <= set(dir(package))
    for public in package.__all__:
        assert not public.startswith("_")
        assert getattr(package, public) is not None
    with pytest.raises(AttributeError, match="nonesuch"):
        package.nonesuch  # noqa: B018 - it is the access that fails


@pytest.mark.parametrize("name", PACKAGES)
def test_no_module_is_shadowed_by_a_name(name):
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(package.__path__):
        found = getattr(package, module.name, None) if module.name in package.__all__ else None
        assert found is None or isinstance(found, types.ModuleType), f"{name}.{module.name}"


def test_the_names_resolve_all_at_once():
    # Resolves every name while its package is still being imported, which a circle would not survive.
    assert "render_ray" in python("import jaxpose; print(dir(jaxpose))", EAGER_IMPORT="1")


def test_the_version_is_that_of_the_distribution():
    assert importlib.metadata.version("jaxpose") == jaxpose.__version__


# What users make of the public names, fifteen lines each at most.

TURNING = jnp.array([0.3, 0.0, 0.1, 0.0, 0.0, 0.4])  # a twist: 0.4 rad/s about z


def test_a_trajectory_is_fitted_and_asked_a_thousand_times():
    times = jnp.linspace(0.0, 2.0, 41)
    poses = jaxpose.se3.exp(jnp.outer(times, TURNING))
    field = jaxpose.bspline((0.0, 2.0), intervals=8)
    params = jaxpose.fit(field, times, poses).params
    ask = jax.jit(jax.vmap(lambda params, t: jaxpose.motion(partial(field.pose, params), t), (None, 0)))
    found = ask(params, jnp.linspace(0.0, 2.0, 1000))
    expected = jaxpose.se3.exp(jnp.outer(jnp.linspace(0.0, 2.0, 1000), TURNING))
    assert np.abs(found.pose - expected).max() < 1e-5
    assert np.abs(found.omega_body - TURNING[None, 3:]).max() < 1e-4


def test_a_gyroscope_loss_of_ones_own_with_optax():
    times, rate = jnp.linspace(0.0, 2.0, 50), lambda t: jnp.stack([0 * t, 0 * t, jnp.sin(3 * t)])
    field = jaxpose.bspline((0.0, 2.0), intervals=12)

    def loss(params, step):
        omega = jax.vmap(lambda t: jaxpose.motion(partial(field.pose, params), t).omega_body)(times)
        return jnp.mean((omega - jax.vmap(rate)(times)) ** 2)

    tx = optax.adam(optax.exponential_decay(0.05, 500, 0.01))
    params = jax.jit(lambda p: jaxpose.optim.minimize(loss, p, tx, 500).params)(field.init(jax.random.key(0)))
    turn = field.pose(params, jnp.float32(0))[:3, :3].T @ field.pose(params, jnp.float32(2))[:3, :3]
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx((1 - np.cos(6)) / 3, abs=5e-3)


def test_a_ray_through_a_density_of_ones_own():
    fog = lambda point, direction: (jnp.where(point[2] > 1, 2.0, 0.0), jnp.array([1.0, 0.5, 0.0]))
    camera = jaxpose.Camera(50.0, 50.0, 15.5, 11.5, 32, 24)
    ray = jaxpose.pixel_ray(camera, jnp.eye(4), jnp.array([15.5, 11.5]))
    seen = jaxpose.render_ray(fog, ray, jnp.linspace(0.0, 6.0, 2001), weights=jaxpose.density_weights)
    assert seen.depth == pytest.approx(1 + 1 / 2, abs=5e-3)  # Beer's law
    assert np.allclose(seen.rgb, [1.0, 0.5, 0.0], atol=1e-3)


@pytest.fixture(scope="module")
def walk():
    """Frames as arrays, on the clock of 2023, with their ground truth."""
    room = jaxpose.datasets.synthetic.room(
        jaxpose.datasets.synthetic.RoomConfig(duration_s=1.0, width=80, height=60)
    )
    rgb, depth = (np.stack(images) for images in zip(*(room.read(i) for i in range(6)), strict=True))
    return room.camera, 1.7e9 + room.t[:6], rgb, depth, room.T_world_cam[:6]


@pytest.fixture(scope="module")
def tracked(walk):
    camera, t, rgb, depth, _ = walk
    recording = jaxpose.datasets.from_arrays(camera, t, rgb, depth)
    return jaxpose.slam.run(recording, jaxpose.slam.SlamConfig(voxel=0.05))


@pytest.mark.slow
def test_slam_from_arrays(walk, tracked):
    """Poses since the first one, and a continuous trajectory through them."""
    *_, T_true = walk
    moved = np.linalg.inv(T_true[0]) @ T_true[5]
    found = np.linalg.inv(tracked.T_world_cam[0]) @ tracked.T_world_cam[5]
    assert np.linalg.norm(found[:3, 3] - moved[:3, 3]) < 0.1 * np.linalg.norm(moved[:3, 3])
    assert np.abs(found[:3, :3] - moved[:3, :3]).max() < 0.03
    between = tracked.field.pose(tracked.field_params, jnp.float32(walk[1][5] - walk[1][0]))
    assert np.abs(between - tracked.T_world_cam[5]).max() < 0.01


@pytest.mark.slow
def test_slam_on_frames_that_come_one_by_one(walk, tracked):
    camera, times, colours, depths, _ = walk
    state = jaxpose.slam.init(camera, jaxpose.slam.SlamConfig(voxel=0.05))
    for t, rgb, depth in zip(times, colours, depths, strict=True):
        state = jaxpose.slam.step(state, rgb, depth, t)
    result = jaxpose.slam.finish(state)
    assert np.abs(result.T_world_cam - tracked.T_world_cam).max() < 1e-4
    assert result.field_rmse_m < 0.01


def test_a_rolling_shutter_along_a_run(walk, tracked, tmp_path):
    """Each row is seen from the pose at its own time, by the trajectory that a run leaves."""
    jaxpose.fields.save(tmp_path / "field.npz", tracked.field, tracked.field_params)
    field, params = jaxpose.fields.load(tmp_path / "field.npz")
    depths, query = jnp.linspace(0.2, 5.0, 200), partial(tracked.scene.query, tracked.scene_params)

    def see(column, row, t):
        ray = jaxpose.pixel_ray(walk[0], field.pose(params, t), jnp.stack([column, row]))
        return jaxpose.render_ray(query, ray, depths, weights=jaxpose.surface_weights(0.03)).depth

    image = jax.jit(jax.vmap(jax.vmap(see, (0, None, None)), (None, 0, 0)))
    columns, rows = jnp.arange(0.0, 80, 8), jnp.arange(0.0, 60, 6)
    rolling, still = (image(columns, rows, rows * line_s) for line_s in (5e-4, 0))
    assert np.median(np.abs(still - walk[3][0, ::6, ::8])) < 0.05
    assert 1e-4 < np.median(np.abs(rolling - still)[1:]) < 0.05 and np.array_equal(rolling[0], still[0])


LINE = np.tile(np.eye(4), (5, 1, 1))
TIMES = np.arange(5.0)
CAMERA = jaxpose.Camera(50.0, 50.0, 15.5, 11.5, 32, 24)
RGB, DEPTH = np.zeros((5, 24, 32, 3), np.uint8), np.ones((5, 24, 32), np.float32)
SPLINE = jaxpose.bspline((0.0, 4.0), 2)
from_arrays = partial(jaxpose.datasets.from_arrays, CAMERA)
pixel_ray = partial(jaxpose.pixel_ray, CAMERA)


@pytest.mark.parametrize(
    "call, names",
    [
        (lambda: jaxpose.bspline((1.0, 0.0), 3), "first < last .*got span"),
        (lambda: jaxpose.posenet(jaxpose.PoseNetConfig(layers=0)), "layers >= 1 .*got"),
        (lambda: jaxpose.per_frame_poses(np.zeros(2)), "times: expected .*"),
        (lambda: jaxpose.piecewise_geodesic(TIMES, LINE[:4]), r"poses: .*got \(4, 4, 4\)"),
        (lambda: jaxpose.fit(SPLINE, TIMES[::-1], LINE), "times: expected .*got"),
        (lambda: jaxpose.fit(SPLINE, TIMES, LINE * np.nan), "poses: expected .*got"),
        (lambda: SPLINE.pose(jnp.zeros((5, 7)), TIMES), r"t: expected .*got .*\(5,\)"),
        (lambda: jaxpose.project(CAMERA, jnp.zeros(2)), "point_cam: expected .*got"),
        (lambda: jaxpose.unproject(CAMERA, jnp.zeros(3)), "pixel: expected .*got"),
        (lambda: pixel_ray(jnp.eye(4), jnp.zeros((7, 2))), r"pixel: expected .*got \(7, 2\)"),
        (lambda: pixel_ray(jnp.eye(3), jnp.zeros(2)), r"T_world_cam: expected .*got \(3, 3\)"),
        (lambda: jaxpose.se3.apply(jnp.eye(4), jnp.zeros(4)), "expected .*got"),
        (lambda: jaxpose.load_recording("nowhere"), "nowhere: expected .*got"),
        (lambda: jaxpose.fields.load(__file__), "test_public_api.py: expected a trajectory, got"),
        (lambda: from_arrays(TIMES, RGB, DEPTH.astype(np.uint16)), "depth: .*got uint16"),
        (lambda: from_arrays(TIMES, RGB / 255, DEPTH), "rgb: expected .*uint8, got .*float64"),
        (lambda: from_arrays(TIMES, RGB[:, 1:], DEPTH), r"rgb: .*got \(5, 23, 32, 3\)"),
        (lambda: from_arrays(TIMES[::-1], RGB, DEPTH), "t: expected .*got"),
        (lambda: jaxpose.scenes.nerf(jaxpose.scenes.NerfConfig(width=0)), "sizes >= 1 .*got"),
        (lambda: jaxpose.scenes.image(jaxpose.scenes.ImageConfig(octaves=-1)), "octaves >= 0.*got"),
        (lambda: jaxpose.scenes.bounding_grid(np.zeros((5, 2))), r"points: expected .*got \(5, 2\)"),
        (lambda: jaxpose.scenes.GridConfig(voxel=0.0), "voxel > 0 .*got"),
        (lambda: jaxpose.training.TrainConfig(rays=0), "rays.* >= 1, got"),
        (lambda: jaxpose.training.Decay(0.0, 1e-3).schedule(10), "Decay: expected first, last > 0 .*got"),
        (lambda: jaxpose.training.joint(None, None, None, optax.sgd(1.0), 0), "steps: expected .*got 0"),
        (lambda: jaxpose.training.microbatched_sum(lambda params, x: x, 0), "chunk: expected .*got 0"),
    ],
)  # fmt: skip
def test_input_that_means_nothing_is_named(call, names, unchecked):
    """Name of the argument, what was expected, what was found; the renderer's are in test_render."""
    with pytest.raises((ValueError, jaxpose.DataError), match=names):
        call()

"""Rolling shutter and blur in closed form: a painted plane before a camera that slides along x."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

from jaxpose import fields, training
from jaxpose.datasets.synthetic import orbit
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import SceneField
from jaxpose.training import photometric
from jaxpose.training.shutter import Shutter, exposure_times, shutter_of, with_shutter

SPEED, DEPTH, SIZE, COUNT = 1.5, 2.0, 12, 4  # [units/s], [units], [px], photographs a second apart
CAMERA = Camera(8.0, 8.0, 5.5, 5.5, SIZE, SIZE)
TRUE = Shutter(0.02, 0.8, 3)
STILL = fields.constant(jnp.eye(4))


def plane():
    """The colour is quadratic in x; all samples of a ray are at the plane."""
    paint = lambda x: jnp.clip(0.2 + 0.05 * x + 0.01 * x**2, 0, 1)
    query = lambda params, point, direction: (jnp.ones(()), jnp.tile(paint(point[0]), 3))
    return SceneField(lambda key: {}, query)


def sliding():
    times = np.array([-10.0, 10.0])
    poses = se3.exp(jnp.asarray([[SPEED * t, 0, 0, 0, 0, 0] for t in times], jnp.float32))
    still = fields.posenet(fields.PoseNetConfig(span=(-10.0, 10.0), layers=2, width=4))
    return fields.right_correction(still, fields.piecewise_geodesic(times, poses))


def photographs(shutter):
    """Colours by hand: a row's x is that of its own time, and the mean of x^2 over k instants is more."""
    line, exposure, k = shutter
    row, column = np.mgrid[:SIZE, :SIZE]
    t = np.arange(COUNT)[:, None, None]
    x = SPEED * (t + line * (row - 5.5)) + DEPTH * (column - 5.5) / 8.0
    spread = (SPEED * exposure) ** 2 * (1 - 1 / k**2) / 12
    return 0.2 + 0.05 * x + 0.01 * (x**2 + spread)


def loss(assumed):
    """Mean squared error at the true poses, of photographs taken with the true shutter."""
    rgb = np.repeat(np.round(255 * photographs(TRUE))[..., None], 3, axis=-1).astype(np.uint8)
    views = training.Views(jnp.arange(float(COUNT)), jnp.asarray(rgb))
    settings = training.TrainConfig(steps=1, rays=512, samples=2, chunk=512)
    depths = training.Depths(DEPTH - 1e-5, DEPTH)
    trainer = photometric.trainer(
        plane(), sliding(), CAMERA, depths, optax.sgd(0.0), settings, assumed and (lambda params: assumed)
    )
    return float(trainer.advance(trainer.start(jax.random.key(0)), views, 1)[1][0])


def test_a_pixel_is_the_mean_over_its_own_rows_exposure():
    rounding = 1 / (12 * 255**2)
    assert loss(TRUE) < 2 * rounding
    # Without the delay x is off by speed * delay * (row - 5.5), without the exposure the square is too small.
    assert loss(None) > 50 * rounding
    assert loss(TRUE._replace(line_delay=0.0)) > 20 * rounding
    assert loss(TRUE._replace(exposure=0.0)) > 1.4 * loss(TRUE)


def test_instants_are_about_the_middle_row():
    times = exposure_times(Shutter(1e-3, 0.01, 5), jnp.float32(2), jnp.float32(0), 11)
    assert_allclose(times, 2 - 5e-3 + 0.01 * np.array([-0.4, -0.2, 0, 0.2, 0.4]), rtol=1e-6)


def test_line_delay_and_exposure_are_found():
    """By gradient, from no delay and half of the exposure; the field's poses are left as they are."""
    field = with_shutter(STILL, Shutter(0.0, 0.4), units=(0.01, 0.3))
    target = jnp.asarray(photographs(TRUE), jnp.float32)
    across = DEPTH * jnp.asarray(np.mgrid[:SIZE, :SIZE][1] - 5.5, jnp.float32) / 8.0

    def error(params):
        found = shutter_of(field, params, TRUE.instants)
        of_row = jax.vmap(lambda t, row: exposure_times(found, t, row, SIZE), (None, 0))
        times = jax.vmap(of_row, (0, None))(jnp.arange(float(COUNT)), jnp.arange(float(SIZE)))
        x = SPEED * times[:, :, None, :] + across[None, :, :, None]
        return 1e4 * jnp.mean((jnp.mean(0.2 + 0.05 * x + 0.01 * x**2, axis=-1) - target) ** 2)

    params, optimizer = field.init(jax.random.key(0)), optax.adam(0.05)

    def improve(carry, _):
        params, state = carry
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimizer.update(jax.grad(error)(params), state)
            return (optax.apply_updates(params, updates), state), ()

    (params, _), _ = jax.jit(lambda c: jax.lax.scan(improve, c, length=600))((params, optimizer.init(params)))
    found = shutter_of(field, params, TRUE.instants)
    assert found.line_delay == pytest.approx(TRUE.line_delay, rel=0.02)
    assert abs(found.exposure) == pytest.approx(TRUE.exposure, rel=0.02)
    assert_allclose(field.pose(params, 0.3), np.eye(4))


def test_a_row_of_the_orbit_is_the_photograph_from_its_own_pose():
    """Against whole images with one pose each."""
    lens, paint = orbit.camera(10), orbit.paint(0)
    T = jnp.asarray(orbit.orbit_poses(np.linspace(0, 0.4, 20)).reshape(10, 2, 4, 4), jnp.float32)
    whole = jax.jit(jax.vmap(jax.vmap(lambda T: orbit.image(lens, T, paint))))(T)
    rows = jax.jit(lambda T: orbit.exposed_rows(lens, T, paint))(T)
    expected = np.stack([np.asarray(whole)[row].mean(0)[row] for row in range(10)])
    assert_allclose(rows, expected, atol=2e-3)
    assert np.abs(np.asarray(whole)[0, 0] - expected).max() > 0.05

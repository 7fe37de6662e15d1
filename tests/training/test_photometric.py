"""Joint training: renders against plain numpy, the loss, rates by group, poses found again."""

from functools import cache, partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose import fields, scenes
from jaxpose.geometry import rigid, se3
from jaxpose.geometry.camera import Camera
from jaxpose.render import Ray
from jaxpose.scenes import NerfConfig
from jaxpose.training import photometric
from jaxpose.training.photometric import Depths, TrainConfig, Views
from jaxpose.training.steps import Decay, adam

CAMERA = Camera(20.0, 22.0, 7.5, 5.5, 16, 12)
DEPTHS = Depths(1.0, 5.0)
T = jnp.linspace(-1.0, 1.0, 5)


def soft_ball(params, point, direction):
    """A coloured ball of fog about a centre that is its only parameter; seen alike from everywhere."""
    offset = point - params["centre"]
    density = 20 * jnp.exp(-4 * jnp.sum(offset**2))
    return density, 0.5 + 0.4 * jnp.sin(6 * offset + jnp.asarray([0.0, 1.0, 2.0], point.dtype))


def ball_scene(centre=(0.0, 0.0, 0.0)):
    return scenes.SceneField(lambda key: {"centre": jnp.asarray(centre, jnp.zeros(()).dtype)}, soft_ball)


@jax.jit
def around(t):
    """Camera-to-world poses on an arc, 3 from the origin, looking at it."""
    turn = se3.exp(jnp.stack([0 * t, 0 * t, 0 * t, 0.2 * t, 0.6 * t, 0.1 * t], axis=-1))
    return se3.compose(turn, jnp.eye(4).at[2, 3].set(-3.0)[None])


def photographs(T_world_cam, samples=64):
    look = photometric.viewer(ball_scene(), CAMERA, DEPTHS, TrainConfig(samples=samples)).image
    return np.stack([np.asarray(look({"centre": jnp.zeros(3)}, pose)[0]) for pose in T_world_cam])


@cache
def views():
    return Views(T, jnp.asarray(np.round(255 * photographs(around(T))), jnp.uint8))


def test_a_view_is_the_sum_along_every_ray():
    """Against numpy: pinhole rays, middles of equal parts, weights of fog, the last one without end."""
    pose = np.asarray(around(T)[1], np.float64)
    rgb, depth = photometric.viewer(ball_scene(), CAMERA, DEPTHS, TrainConfig(samples=9, chunk=7)).image(
        {"centre": jnp.asarray([0.1, 0.0, -0.2])}, jnp.asarray(pose, jnp.float32)
    )
    x, y = np.meshgrid(np.arange(16), np.arange(12))
    direction = np.stack([(x - 7.5) / 20, (y - 5.5) / 22, np.ones_like(x)], -1) @ pose[:3, :3].T
    at = 1 + 4 * (np.arange(9) + 0.5) / 9
    offset = pose[:3, 3] + at[:, None] * direction[:, :, None] - [0.1, 0.0, -0.2]
    tau = 20 * np.exp(-4 * (offset**2).sum(-1)) * np.linalg.norm(direction, axis=-1)[..., None]
    tau *= np.append(np.diff(at), 1e10)
    weights = (1 - np.exp(-tau)) * np.exp(tau - np.cumsum(tau, -1))
    weights /= weights.sum(-1, keepdims=True)
    colours = 0.5 + 0.4 * np.sin(6 * offset + [0, 1, 2])
    assert_allclose(rgb, (weights[..., None] * colours).sum(-2), atol=1e-4)
    assert_allclose(depth, (weights * at).sum(-1), atol=1e-3)


@pytest.mark.slow
def test_noisy_poses_are_found_again():
    """The scene known, poses off by 0.1 and 6 degrees: PoseNet brings them back, on either side."""
    ground_truth = np.asarray(around(T), np.float64)
    off = np.asarray(se3.exp(jnp.stack([0.1 * jnp.cos(3 * T), 0.1 * T, 0 * T, 0.1 * T, 0 * T, 0.1 * T], -1)))
    sides = ((fields.left_correction, off @ ground_truth), (fields.right_correction, ground_truth @ off))
    for side, start in sides:
        net = fields.posenet(fields.PoseNetConfig(octaves=2, layers=3, width=32))
        field = side(net, fields.piecewise_geodesic(T, jnp.asarray(start, jnp.float32)))
        optimizer = adam({"scene": 0.0, "pose": Decay(1e-3, 1e-4)}, 400)
        config = TrainConfig(steps=400, rays=128, samples=48, chunk=64)
        trainer = photometric.trainer(ball_scene(), field, CAMERA, DEPTHS, optimizer, config)
        state, losses = trainer.advance(trainer.start(jax.random.key(0)), views(), 400)
        found = np.asarray(jax.vmap(field.pose, (None, 0))(state.pose, T), np.float64)
        before = np.linalg.norm(start[:, :3, 3] - ground_truth[:, :3, 3], axis=-1).mean()
        after = np.linalg.norm(found[:, :3, 3] - ground_truth[:, :3, 3], axis=-1).mean()
        angles = np.degrees(rigid.rotation_angle(found[:, :3, :3], ground_truth[:, :3, :3]))
        assert before > 0.09 and after < 0.5 * before and angles.mean() < 1.2, (side, before, after, angles)
        assert losses[-30:].mean() < 0.2 * losses[:30].mean()
        assert int(state.step) == 400


def test_the_loss_is_the_mean_squared_colour_error():
    """Every ray of a one-pixel camera is the same ray, so the loss of a step is known without its draws."""
    pixel = Camera(20.0, 20.0, 0.0, 0.0, 1, 1)
    field = fields.right_correction(fields.per_frame_poses(T), fields.piecewise_geodesic(T, around(T)))
    config = TrainConfig(steps=10, rays=6, samples=400, chunk=4)
    trainer = photometric.trainer(ball_scene(), field, pixel, DEPTHS, optax.set_to_zero(), config)
    grey = Views(T, jnp.full((5, 1, 1, 3), 51, jnp.uint8))
    _, losses = trainer.advance(trainer.start(jax.random.key(0)), grey, 4)
    look = photometric.viewer(ball_scene(), pixel, DEPTHS, TrainConfig(samples=400)).image
    colours = np.stack([np.asarray(look({"centre": jnp.zeros(3)}, pose)[0]) for pose in around(T)])
    errors = ((colours - 0.2) ** 2).mean((1, 2, 3))
    assert errors.min() - 1e-3 < losses.min() and losses.max() < errors.max() + 1e-3


def test_rates_decay_and_groups_wait():
    """Adam's first step has the length of its rate, whatever the gradient; a waiting group does not move."""
    field = fields.right_correction(fields.per_frame_poses(T), fields.piecewise_geodesic(T, around(T)))
    shift, turn = Decay(1e-2, 1e-4).schedule(4), Decay(1e-2, 1e-4, start=0.5).schedule(4)
    columns = jnp.arange(6)[None] < 3
    optimizer = adam({"scene": 1e-3, "pose": lambda step: jnp.where(columns, shift(step), turn(step))}, 4)
    config = TrainConfig(steps=4, rays=64, samples=8, chunk=64)
    trainer = photometric.trainer(ball_scene((0.1, 0.1, 0.1)), field, CAMERA, DEPTHS, optimizer, config)
    states = [trainer.start(jax.random.key(0))]
    for _ in range(4):
        states.append(trainer.advance(states[-1], views(), 1)[0])
    moves = np.abs(np.diff([np.asarray(state.pose) for state in states], axis=0))
    assert_allclose(moves[0, :, :3], 1e-2, rtol=0.02)
    assert_array_equal(moves[:2, :, 3:], 0)
    assert (moves[2:, :, 3:] > 0).all()
    assert moves[3].max() < 1e-2 * 1e-2 ** (3 / 4) * 4, "rates decay to a hundredth"
    centres = np.diff([np.asarray(state.scene["centre"]) for state in states], axis=0)
    assert_allclose(np.abs(centres[0]), 1e-3, rtol=0.02)


@pytest.mark.parametrize("start", [0.0, 0.03, 0.06, 0.3, 1.0])
def test_a_decay_is_a_power_of_the_share_of_the_training(start, dtype):
    steps = np.arange(5000)
    share = steps / 5000
    expected = np.where(share >= start, 3e-4 * (2e-5 / 3e-4) ** share, 0)
    with jax.numpy_dtype_promotion("standard"):
        found = jax.vmap(Decay(3e-4, 2e-5, start).schedule(5000))(jnp.asarray(steps))
    assert_allclose(found, expected, rtol=1e-5 if dtype == jnp.float32 else 1e-12)


def test_parts_have_optimizers_of_their_own():
    """Any optax transformation: plain descent moves by rate times gradient, and a frozen part not at all."""
    field = fields.right_correction(fields.per_frame_poses(T), fields.piecewise_geodesic(T, around(T)))
    parts = {"scene": optax.sgd(1e-2), "pose": optax.set_to_zero()}
    optimizer = optax.partition(parts, {"scene": "scene", "pose": "pose"})
    config = TrainConfig(steps=1, rays=64, samples=8, chunk=64)
    trainer = photometric.trainer(ball_scene((0.1, 0.1, 0.1)), field, CAMERA, DEPTHS, optimizer, config)
    start = trainer.start(jax.random.key(0))
    after, (loss,) = trainer.advance(start, views(), 1)
    moved = np.asarray(after.scene["centre"] - start.scene["centre"])
    assert_array_equal(after.pose, start.pose)
    # Downhill, by the rate times the slope: the same draws again, from further along.
    again = trainer.start(jax.random.key(0))
    again = again._replace(scene={"centre": start.scene["centre"] + 1e-2 * moved})
    slope = float(trainer.advance(again, views(), 1)[1][0] - loss) / (1e-2 * np.linalg.norm(moved))
    assert_allclose(-1e-2 * slope, np.linalg.norm(moved), rtol=0.05)


def test_windows_follow_the_steps():
    scene = scenes.nerf(
        NerfConfig(layers=2, width=8, skip=None, colour_width=4, octaves=2, window=(0.0, 1.0))
    )
    field = fields.posenet(fields.PoseNetConfig(octaves=2, layers=2, width=8, window=(0.0, 1.0)))
    config = TrainConfig(steps=4, rays=8, samples=4, chunk=8)
    trainer = photometric.trainer(scene, field, CAMERA, DEPTHS, optax.adam(1e-3), config)
    state, _ = trainer.advance(trainer.start(jax.random.key(0)), views(), 3)
    # That of the last step, 2 of 4; Adam has not moved what has no gradient.
    assert float(state.scene["progress"]) == 0.5 and float(state.pose["progress"]) == 0.5


def test_steps_are_the_same_in_one_call_or_many_and_never_recompile():
    chex.clear_trace_counter()
    field = fields.right_correction(fields.per_frame_poses(T), fields.piecewise_geodesic(T, around(T)))
    counted = field._replace(pose=chex.assert_max_traces(lambda params, t: field.pose(params, t), n=4))
    config = TrainConfig(steps=8, rays=16, samples=8, chunk=16)
    trainer = photometric.trainer(ball_scene((0.1, 0, 0)), counted, CAMERA, DEPTHS, optax.adam(1e-3), config)
    data = views()
    once, all_losses = trainer.advance(trainer.start(jax.random.key(3)), data, 8)
    again = trainer.start(jax.random.key(3))
    for k in range(0, 8, 2):
        again, losses = trainer.advance(again, data, 2)
        assert_allclose(losses, all_losses[k : k + 2], rtol=1e-5)
    assert_allclose(once.pose, again.pose, atol=1e-7)


def test_a_held_out_pose_is_refined():
    config = TrainConfig(rays=128, samples=32, chunk=64)
    look = photometric.viewer(ball_scene(), CAMERA, DEPTHS, config, refine_optimizer=optax.adam(3e-3))
    ground_truth = around(T)[2]
    rgb = jnp.asarray(np.round(255 * photographs(ground_truth[None])[0]), jnp.uint8)
    start = se3.compose(se3.exp(jnp.asarray([0.05, -0.05, 0.0, 0.03, 0.0, 0.02])), ground_truth)
    moved = look.refine_pose({"centre": jnp.zeros(3)}, start, rgb, jax.random.key(0))
    off = lambda pose: float(jnp.linalg.norm(se3.log(se3.compose(se3.inverse(ground_truth), pose))))
    assert off(moved) < 0.5 * off(start)


@pytest.mark.parametrize("setting", ["steps", "rays", "samples", "chunk"])
def test_sizes_that_mean_nothing(setting):
    with pytest.raises(ValueError, match="steps, rays, samples and chunk >= 1"):
        TrainConfig(**{setting: 0})


def test_refinement_on_either_side():
    field = fields.per_frame_poses(T)
    params = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6)), jnp.float32)
    initial = fields.piecewise_geodesic(T, around(T))
    poses = (partial(field.pose, params), partial(initial.pose, {}))
    moves, starts = (np.asarray(jax.jit(jax.vmap(pose))(T)) for pose in poses)
    right, left = fields.right_correction, fields.left_correction
    for side, expected in ((right, starts @ moves), (left, moves @ starts)):
        refined = side(field, initial)
        assert_allclose(jax.jit(jax.vmap(partial(refined.pose, params)))(T), expected, atol=1e-5)


@pytest.mark.parametrize("spacing", ["depth", "disparity"])
def test_samples_go_where_something_may_be(spacing):
    """A slab between 2.6 and 2.9 of a ray from 1 to 5: most samples, and the whole ray in their intervals."""
    slab = lambda params, point: jnp.where((point[2] > 2.6) & (point[2] < 2.9), 50.0, 0.0)
    sampler = photometric.importance(Depths(1.0, 5.0, spacing), slab, 40)
    ray = Ray(jnp.zeros(3), jnp.array([0.0, 0.0, 1.0]))
    assert_allclose(sampler((), ray, None).depth, sampler((), ray, None).depth)  # the same at any time
    for key in jax.random.split(jax.random.key(0), 5):
        depth, interval = (np.asarray(x, np.float64) for x in sampler((), ray, key))
        assert depth.shape == interval.shape == (41,)
        assert (np.diff(depth) > 0).all() and depth[0] > 1 and depth[-1] == 5
        assert 0.5 < np.mean((depth > 2.5) & (depth < 3.0)) < 0.95
        # Each sample is the middle of its interval, which begins where the one before ends.
        begins, ends = depth - interval / 2, depth + interval / 2
        assert_allclose(begins[1:-1], ends[:-2], atol=1e-5)
        assert interval[-1] > 1e9


def test_a_scene_seen_by_importance_is_that_seen_finely():
    """The ball's colour and depth by 48 samples where it is, against 400 everywhere."""
    params = {"centre": jnp.zeros(3)}
    near = lambda params, point: jnp.where(jnp.sum(point**2) < 2.5, 100.0, 0.0)
    sampler = photometric.importance(DEPTHS, near, 48)
    pose = around(T)[1]
    few = photometric.viewer(ball_scene(), CAMERA, DEPTHS, TrainConfig(), sampler=sampler).image(params, pose)
    many = photometric.viewer(ball_scene(), CAMERA, DEPTHS, TrainConfig(samples=400)).image(params, pose)
    assert_allclose(few[0], many[0], atol=0.02)

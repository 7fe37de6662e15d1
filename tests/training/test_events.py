"""Training on events: which pixels and instants are compared, the loss, poses found again."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jaxpose import fields, scenes
from jaxpose.events import Events, PixelIndex, index_by_pixel, log_intensity, mosaic_mask, simulate
from jaxpose.fields import PoseField
from jaxpose.geometry import se3
from jaxpose.geometry.camera import Camera
from jaxpose.scenes import NerfConfig, SceneField
from jaxpose.training import events as event_training
from jaxpose.training import photometric
from jaxpose.training.events import EventData, EventTrainConfig, asynchronous_pairs, trainer, window_pairs
from jaxpose.training.photometric import Depths, TrainConfig
from jaxpose.training.steps import Decay, adam

HEIGHT, WIDTH = 6, 8
CAMERA = Camera(10.0, 10.0, 3.5, 2.5, WIDTH, HEIGHT)
SPAN = (0.0, 3.0)


@pytest.fixture(scope="module")
def events() -> Events:
    """Of pixels that go up and down at random, but for the last, which sees nothing happen."""
    generator = np.random.default_rng(0)
    values = np.cumsum(generator.normal(0, 0.3, (31, HEIGHT, WIDTH)), axis=0)
    values[:, -1, -1] = 0
    return simulate(zip(0.1 * np.arange(31), values, strict=True), 0.2)


def on_device(streams: PixelIndex) -> PixelIndex:
    return PixelIndex(*(jnp.asarray(x, jnp.float32 if x.dtype == float else jnp.int32) for x in streams))


def counted(events: Events, pixel, after, until):
    """Sum of polarities in (after, until], pixel by pixel, counted one by one."""
    where = events.y.astype(int) * WIDTH + events.x
    t = np.asarray(events.t, np.float32)
    return [
        int(events.polarity[(where == p) & (t > a) & (t <= b)].sum())
        for p, a, b in zip(pixel, after, until, strict=True)
    ]


def test_a_window_compares_changed_pixels_and_some_of_all_at_the_same_two_instants(events):
    config = EventTrainConfig(events=200, negatives=0.25, longest_s=0.4)
    streams = on_device(index_by_pixel(events, HEIGHT, WIDTH))
    draw = jax.jit(partial(window_pairs, span=SPAN, config=config))
    lengths = []
    for seed in range(5):
        pairs = jax.device_get(draw(jax.random.key(seed), streams))
        assert len(set(pairs.t_now.tolist())) == len(set(pairs.t_before.tolist())) == 1
        assert_array_equal(pairs.change, counted(events, pairs.pixel, pairs.t_before, pairs.t_now))
        assert (pairs.change[:150] != 0).all()
        lengths.append(pairs.t_now[0] - pairs.t_before[0])
        assert 0 <= pairs.t_before[0] and pairs.t_now[0] <= 3 and 0 < lengths[-1] <= 0.4
        everywhere = np.unique(np.flatnonzero(np.array(counted(
            events, range(HEIGHT * WIDTH), *np.broadcast_arrays(
                *np.float32([pairs.t_before[0], pairs.t_now[0]])[:, None], np.zeros(HEIGHT * WIDTH)
            )[:2]))))  # fmt: skip
        assert set(pairs.pixel[:150]) <= set(everywhere)
    assert len(set(lengths)) == 5


def test_asynchronous_pairs_are_events_of_one_pixel_at_their_own_times(events):
    config = EventTrainConfig(events=1000, negatives=0.25, longest_s=0.5, back=3)
    streams = index_by_pixel(events, HEIGHT, WIDTH)
    draw = jax.jit(partial(asynchronous_pairs, span=SPAN, config=config))
    pairs = jax.device_get(draw(jax.random.key(0), on_device(streams)))
    assert_array_equal(pairs.change, counted(events, pairs.pixel, pairs.t_before, pairs.t_now))
    positive = jax.tree.map(lambda x: x[:750], pairs)
    timestamps = {(int(p), float(np.float32(t))) for p, t in zip(streams.pixel, streams.t, strict=True)}
    used = positive.weight > 0
    assert used.mean() > 0.8
    for pixel, now, before in zip(positive.pixel, positive.t_now, positive.t_before, strict=True):
        assert (int(pixel), float(now)) in timestamps and (int(pixel), float(before)) in timestamps
    between = [
        ((streams.pixel == p) & (np.float32(streams.t) > a) & (np.float32(streams.t) <= b)).sum()
        for p, a, b in zip(positive.pixel, positive.t_before, positive.t_now, strict=True)
    ]
    assert set(np.array(between)[used]) == {1, 2, 3}
    longer = positive.t_now - positive.t_before > 0.5
    assert_array_equal(used, ~longer & (np.array(between) > 0))
    assert (pairs.weight[750:] == 1).all()
    assert HEIGHT * WIDTH - 1 in pairs.pixel[750:]  # the pixel that never fires is asked too


def ball() -> SceneField:
    """A shining ball, brighter on one side, whose brightness is all that is trained."""

    def query(params, point, direction):
        del direction
        distance = jnp.linalg.norm(point - jnp.asarray([0.0, 0.0, 3.0]))
        density = 40 * jax.nn.sigmoid((0.8 - distance) / 0.05)
        return density, params * (0.5 + 0.25 * jnp.sin(2 * point + jnp.asarray([0.0, 1.0, 2.0])))

    return SceneField(lambda key: jnp.ones(()), query)


def path(t):
    """A camera that slides and turns, camera-to-world."""
    return se3.exp(jnp.stack([0.3 * t, 0.1 * t, 0 * t, 0 * t, 0.05 * t, 0 * t]))


@pytest.fixture(scope="module")
def seen():
    """The events of the ball from the path, its renders as a renderer of this package makes them."""
    depths, background = Depths(2.0, 4.0), 0.4
    scene = ball()
    view = photometric.viewer(scene, CAMERA, depths, TrainConfig(samples=64, chunk=16), background=background)
    mask = mosaic_mask("rggb", HEIGHT, WIDTH)

    def images():
        for t in np.linspace(0, 1, 41):
            rgb, _ = view.image(jnp.ones(()), path(jnp.float32(t)))
            yield t, log_intensity((np.asarray(rgb, np.float64) * mask).sum(-1))

    events = simulate(images(), 0.02)
    data = EventData(on_device(index_by_pixel(events, HEIGHT, WIDTH)), jnp.asarray(mask.reshape(-1, 3)))
    return scene, depths, data, background


@pytest.mark.parametrize("loss", ["window", "asynchronous"])
def test_the_loss_is_small_for_the_true_scene_and_path_and_grows_with_either_wrong(seen, loss):
    scene, depths, data, background = seen
    config = EventTrainConfig(
        steps=100, events=256, samples=64, loss=loss, threshold=0.02, longest_s=0.5, background=background
    )
    field = PoseField(lambda key: jnp.ones(()), lambda speed, t: path(speed * t))
    trained = trainer(scene, field, CAMERA, depths, (0.0, 1.0), optax.set_to_zero(), config)

    def measured(speed, brightness=1.0):
        start = trained.start(jax.random.key(0))
        state = start._replace(scene=jnp.float32(brightness), pose=jnp.float32(speed))
        return float(trained.advance(state, data, 4)[1].mean())

    right = measured(1.0)
    # A third of the colours are seen; a pixel's level is off by less than a threshold.
    assert right < 0.02**2 / 3
    assert measured(0.7) > 4 * right
    assert measured(-1.0) > 20 * right
    assert measured(1.0, brightness=0.5) > 4 * right


@pytest.mark.parametrize("loss", ["window", "asynchronous"])
def test_a_path_is_found_from_events(seen, loss):
    scene, depths, data, background = seen
    config = EventTrainConfig(
        steps=200, events=64, samples=32, loss=loss, threshold=0.02, longest_s=0.5, background=background
    )

    def pose(params, t):
        return se3.exp(jnp.concatenate([params * t, jnp.stack([0 * t, 0.05 * t, 0 * t])]))

    field = PoseField(lambda key: jnp.zeros(3), pose)
    optimizer = adam({"scene": 0.0, "pose": Decay(1e-2, 1e-3)}, config.steps)
    trained = trainer(scene, field, CAMERA, depths, (0.0, 1.0), optimizer, config)
    state, losses = trained.advance(trained.start(jax.random.key(0)), data, 200)
    assert_allclose(state.pose, [0.3, 0.1, 0.0], atol=0.05)
    assert losses[-20:].mean() < 0.2 * losses[:5].mean()


def test_settings_that_mean_nothing_are_refused():
    for settings in ({"steps": 0}, {"threshold": 0.0}, {"negatives": 1.0}, {"back": 0}):
        with pytest.raises(ValueError, match="expected"):
            EventTrainConfig(**settings)


@pytest.mark.slow
def test_a_posenet_and_a_radiance_field_train_on_events_without_a_nan(seen):
    _, depths, data, background = seen
    config = EventTrainConfig(steps=4, events=16, samples=8, chunk=8, background=background)
    scene = scenes.nerf(NerfConfig(layers=2, width=16, skip=None, colour_width=8, octaves=3))
    net = fields.posenet(fields.PoseNetConfig(span=(0.0, 1.0), layers=2, width=16))
    trained = event_training.trainer(
        scene, net, CAMERA, depths, (0.0, 1.0), optax.adam(1e-3), config
    )  # fmt: skip
    state, losses = trained.advance(trained.start(jax.random.key(1)), data, 4)
    assert np.isfinite(losses).all()
    start = trained.start(jax.random.key(1))
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), state.pose, start.pose)
    assert all(jax.tree.leaves(moved))

"""A radiance field and a trajectory optimised together from events (Ma et al. 2024, section 4.2).

What is compared is the change of a pixel's log intensity between two instants: rendered, and reported by its
events. `window` takes all pixels between the same two instants (EventNeRF, Rudnev et al. 2023);
`asynchronous` takes pairs of events of one pixel, each rendered from the pose at its own time.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxpose.events import PixelIndex, change_residual, cumulative_polarity
from jaxpose.fields import PoseField
from jaxpose.geometry.camera import Camera
from jaxpose.render import pixel_ray
from jaxpose.scenes import SceneField
from jaxpose.training.photometric import Depths, draw_samples, ray_colour, stratified
from jaxpose.training.steps import Trainer, joint, microbatched_sum

Loss = Literal["window", "asynchronous"]


@dataclass(frozen=True)
class EventTrainConfig:
    """How long and on what; thresholds and shares are EventNeRF's for its synthetic scenes."""

    steps: int = 200_000
    events: int = 1024  # pixels compared in a step
    samples: int = 128  # along each ray, stratified
    chunk: int = 32  # pixels computed at a time: what is stored between the two passes
    loss: Loss = "asynchronous"
    threshold: float = 0.25  # change of log intensity per event
    offset: float = 0.1  # intensity added before the logarithm
    negatives: float = 0.1  # share of pixels drawn from all, most of which report no change
    longest_s: float = 0.5  # between the two instants
    back: int = 10  # events of a pixel from the earlier instant to the later at most
    background: float | None = None  # known colour behind the scene in [0, 1]

    def __post_init__(self):
        if min(self.steps, self.events, self.samples, self.chunk, self.back) < 1:
            raise ValueError(f"EventTrainConfig: expected whole numbers >= 1, got {self}")
        if min(self.threshold, self.longest_s, self.offset) <= 0 or not 0 <= self.negatives < 1:
            raise ValueError(f"expected threshold, longest_s, offset > 0 and negatives in [0, 1), got {self}")


class EventData(NamedTuple):
    """Events by pixel, timestamps in float32 [s] from the recording's start.

    And the colours each pixel sees.
    """

    streams: PixelIndex
    mask: Float[Array, "pixels 3"]


class Compared(NamedTuple):
    """Pixels, two instants [s] of each, the sum of polarities between, and 0 where nothing is compared."""

    pixel: Int[Array, " n"]
    t_now: Float[Array, " n"]
    t_before: Float[Array, " n"]
    change: Int[Array, " n"]
    weight: Float[Array, " n"]


def trainer(
    scene: SceneField,
    field: PoseField,
    camera: Camera,
    depths: Depths,
    span: tuple[float, float],
    optimizer: optax.GradientTransformation,
    config: EventTrainConfig = EventTrainConfig(),  # noqa: B008 - frozen
) -> Trainer:
    """Minimise the squared difference of rendered and reported changes, jointly over scene and poses.

    Both instants of a pixel are sampled at the same depths, drawn anew in every step.

    Args:
        scene: A scene whose geometry is a volume density.
        field: Camera-to-world poses, asked at the instants that are compared.
        camera: Intrinsics of the event camera.
        depths: Where samples lie along the optical axis.
        span: The first and the last instant [s] with events.
        optimizer: As `joint` takes it.
        config: How many steps, pixels and samples, the loss and its settings.

    Returns:
        A trainer whose data are `EventData`.
    """

    def error(scene_params, item):
        now, before, samples, change, mask = item
        colour = lambda ray: ray_colour(scene, scene_params, ray, samples, config.background)[0]
        residual = change_residual(colour(now), colour(before), change, mask, offset=config.offset)
        return jnp.sum(residual**2)

    total = microbatched_sum(error, min(config.chunk, config.events))
    sample = stratified(depths, config.samples)
    draw = {"window": window_pairs, "asynchronous": asynchronous_pairs}[config.loss]

    def loss(scene_params, pose_params, data, key):
        pair_key, depth_key = jax.random.split(key)
        pairs = draw(pair_key, data.streams, span, config)
        poses = jax.vmap(partial(field.pose, pose_params))
        if config.loss == "window":  # one pose for all pixels
            T_now, T_before = (
                jnp.broadcast_to(poses(t[:1]), (config.events, 4, 4)) for t in (pairs.t_now, pairs.t_before)
            )
        else:
            T_now, T_before = poses(pairs.t_now), poses(pairs.t_before)
        pixel = jnp.stack([pairs.pixel % camera.width, pairs.pixel // camera.width], axis=-1)
        pixel = pixel.astype(T_now.dtype)
        rays = [jax.vmap(partial(pixel_ray, camera))(T, pixel) for T in (T_now, T_before)]
        samples = draw_samples(sample, scene_params, rays[0], depth_key)
        change = config.threshold * pairs.change.astype(pixel.dtype)
        mask = data.mask[pairs.pixel] * pairs.weight[:, None]
        return total(scene_params, (*rays, samples, change, mask)) / (3 * config.events)

    return joint(loss, scene.init, field.init, optimizer, config.steps)


def window_pairs(
    key: PRNGKeyArray, streams: PixelIndex, span: tuple[float, float], config: EventTrainConfig
) -> Compared:
    """Pixels that have changed between two instants, the same for all, and some drawn from all pixels.

    Args:
        key: A random key.
        streams: The events, by pixel.
        span: The first and the last instant [s] with events.
        config: How many pixels, how far apart the instants are, how many pixels are drawn from all.

    Returns:
        Pixels and instants to compare.
    """
    end_key, length_key, changed_key, any_key = jax.random.split(key, 4)
    end, before = _instants(end_key, length_key, (), span, config)
    pixels = jnp.arange(len(streams.first))
    at = jax.vmap(cumulative_polarity, (None, 0, None))
    change = at(streams, pixels, end) - at(streams, pixels, before)
    positives = config.events - int(config.events * config.negatives)
    # By inversion of the count of pixels that have changed; if none has, all are as likely.
    passed = jnp.cumsum((change != 0).astype(jnp.int32))
    nth = jax.random.randint(changed_key, (positives,), 0, jnp.maximum(passed[-1], 1)) + 1
    changed = jnp.searchsorted(passed, nth)
    anywhere = jax.random.randint(any_key, (config.events,), 0, len(pixels))
    from_changed = (jnp.arange(config.events) < positives) & (passed[-1] > 0)
    pixel = jnp.where(from_changed, jnp.resize(changed, (config.events,)), anywhere)
    same = lambda t: jnp.broadcast_to(t, (config.events,))
    return Compared(pixel, same(end), same(before), change[pixel], same(jnp.ones(())))


def asynchronous_pairs(
    key: PRNGKeyArray, streams: PixelIndex, span: tuple[float, float], config: EventTrainConfig
) -> Compared:
    """Events, each with an earlier one of its pixel, and pixels drawn from all at two random instants.

    Between two events of a pixel the change is a whole number of thresholds; a pixel's first event has none
    to be compared with and counts nothing.

    Args:
        key: A random key.
        streams: The events, by pixel.
        span: The first and the last instant [s] with events.
        config: How many pixels, how far apart the instants are, how many pixels are drawn from all.

    Returns:
        Pixels and instants to compare.
    """
    event_key, back_key, pixel_key, end_key, length_key = jax.random.split(key, 5)
    negatives = int(config.events * config.negatives)
    positives = config.events - negatives
    now = jax.random.randint(event_key, (positives,), 0, len(streams.t))
    pixel = streams.pixel[now]
    back = jax.random.randint(back_key, (positives,), 1, config.back + 1)
    before = jnp.maximum(now - back, streams.first[pixel])
    t_now, t_before = streams.t[now], streams.t[before]
    usable = (before < now) & (t_now - t_before <= config.longest_s)
    pairs = Compared(
        pixel, t_now, t_before, streams.level[now] - streams.level[before], usable.astype(t_now.dtype)
    )
    pixel = jax.random.randint(pixel_key, (negatives,), 0, len(streams.first))
    end, start = _instants(end_key, length_key, (negatives,), span, config)
    at = jax.vmap(cumulative_polarity, (None, 0, 0))
    change = at(streams, pixel, end) - at(streams, pixel, start)
    others = Compared(pixel, end, start, change, jnp.ones_like(end))
    return Compared(*(jnp.concatenate(pair) for pair in zip(pairs, others, strict=True)))


def _instants(end_key, length_key, shape, span, config):
    """Later and earlier instants, their distance drawn evenly up to the longest."""
    first, last = span
    longest = min(config.longest_s, last - first)
    length = longest * jax.random.uniform(length_key, shape, minval=0.02)
    end = first + length + (last - first - length) * jax.random.uniform(end_key, shape)
    return end, end - length

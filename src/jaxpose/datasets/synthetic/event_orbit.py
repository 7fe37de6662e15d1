"""The events of a camera that circles the object of `orbit`, made on the fly: poses and timestamps are exact.

It stands in for EventNeRF's turntables (Rudnev et al., CVPR 2023): one turn, poses at 1000 instants.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxpose.datasets.synthetic import orbit
from jaxpose.datasets.types import EventRecording, Photographs
from jaxpose.events import Mosaic, log_intensity, mosaic_mask, simulate

BACKGROUND = 159 / 255  # EventNeRF's, behind the object
THRESHOLD = 0.25  # EventNeRF's for synthetic scenes
SPREAD = 0.03  # of the thresholds, an eighth of them: what sensors' data sheets tell
REFRACTORY_S = 1e-3
NOISE_HZ = 0.1  # false events of a pixel
OFFSET = 0.1  # of `log_intensity`
_POSES = 1000
_HELD_OUT = 10


def event_orbit(
    width: int = 100, seed: int = 0, *, poses: int = _POSES, mosaic: Mosaic = "rggb"
) -> EventRecording:
    """Events of a sensor over one turn of the orbit, and ten views held out.

    The sensor sees log intensity, which changes linearly between images rendered at the known poses.

    Args:
        width: Of the square sensor [px].
        seed: Turns and tints the texture and draws thresholds and noise.
        poses: How many are known.
        mosaic: The colour of the pixels.

    Returns:
        The recording.

    Raises:
        ValueError: For fewer than 2 poses or 8 pixels.
    """
    if poses < 2 or width < 8:
        raise ValueError(f"event_orbit: expected at least 2 poses of 8 pixels, got {poses} of {width}")
    camera, paint = orbit.camera(width), orbit.paint(seed)
    shot = jax.jit(partial(orbit.image, camera, paint=paint, background=BACKGROUND))
    t = np.linspace(0, orbit.SECONDS, poses + 1)
    T_world_cam = orbit.orbit_poses(t)
    mask = mosaic_mask(mosaic, width, width)
    mask = mask / mask.sum(-1, keepdims=True)

    def images():
        for timestamp, T in zip(t, T_world_cam, strict=True):
            rgb = np.asarray(shot(jnp.asarray(T, jnp.float32)))
            yield timestamp, log_intensity((rgb * mask).sum(-1), OFFSET)

    events = simulate(
        images(), THRESHOLD, threshold_sigma=SPREAD, refractory_s=REFRACTORY_S, noise_hz=NOISE_HZ, seed=seed
    )
    aside = (np.arange(_HELD_OUT) + 0.25) * orbit.SECONDS / _HELD_OUT
    T_aside = orbit.orbit_poses(aside)
    rgb = [np.round(255 * np.asarray(shot(jnp.asarray(T, jnp.float32)))).astype(np.uint8) for T in T_aside]
    held_out = Photographs(
        "event orbit held out", camera, aside, np.stack(rgb), T_aside, orbit.NEAR, orbit.FAR, "depth",
        tuple(f"held_out/{index:03d}.png" for index in range(_HELD_OUT)),
    )  # fmt: skip
    notes = (
        f"synthetic orbit, {len(events.t)} events of {width} x {width} px from {poses + 1} images, "
        f"exact poses, threshold {THRESHOLD} +- {SPREAD}, refractory {1e3 * REFRACTORY_S:g} ms, "
        f"noise {NOISE_HZ} Hz a pixel",
    )
    return EventRecording(
        "event orbit", camera, mosaic, events, t, T_world_cam, THRESHOLD, True, None, held_out, notes
    )

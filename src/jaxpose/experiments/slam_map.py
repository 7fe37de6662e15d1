"""A map seen from the frames' estimated poses: pictures of it, and how well it shows what was measured."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxpose import metrics
from jaxpose.plots import View
from jaxpose.recording import Recording
from jaxpose.scenes import GridConfig, grid
from jaxpose.scenes.base import Params
from jaxpose.slam.observe import Image, Pixels, SampleConfig, read_pixels, render_pixels
from jaxpose.slam.run import SlamResult

_VIEW_WIDTH = 160  # [px] of rendered pictures, about
_VIEWS = 4
_MEASURED = 10  # frames of each kind
_CHUNK = 4800  # rays rendered in one call

PROTOCOL = (
    f"map rendered from estimated poses of at most {_MEASURED} frames of each kind, about {_VIEW_WIDTH} px "
    "wide; PSNR over pixels where it shows a surface, depth L1 where the frame has depth too; held out: "
    "tracked, never mapped"
)


class Rendered(NamedTuple):
    """A frame and the map, at the same pixels."""

    photograph: UInt8[np.ndarray, "height width 3"]  # the whole frame
    frame_rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    frame_depth: Float[np.ndarray, "h w"]  # m, 0: none
    rgb: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # m, 0: nothing there


Renderer = Callable[[int], Rendered]


def views(recording: Recording, result: SlamResult, render: Renderer) -> list[View]:
    """A few frames, evenly over the recording, beside the map rendered from their estimated poses."""

    def view(i: int) -> View:
        seen = render(i)
        lost = ", lost" if result.lost[i] else ""
        label = f"t = {recording.t[i]:.2f} s{lost}"
        return View(label, seen.photograph, seen.rgb, seen.frame_depth, seen.depth)

    return [view(i) for i in _evenly(np.arange(len(recording.t)), _VIEWS)]


def map_quality(result: SlamResult, render: Renderer) -> dict[str, Any]:
    """PSNR [dB] and mean depth error [m] of the map at mapped and at held-out frames; None without such."""
    kinds = {"mapped": result.mapped & ~result.lost, "held_out": ~result.mapped & ~result.lost}
    return {"protocol": PROTOCOL} | {kind: _quality(render, chosen) for kind, chosen in kinds.items()}


def _quality(render: Renderer, chosen: Bool[np.ndarray, " n"]) -> dict[str, Any] | None:
    rows = []
    for i in _evenly(np.flatnonzero(chosen), _MEASURED):
        seen = render(i)
        there = seen.depth > 0
        both = there & (seen.frame_depth > 0)
        if both.any():
            psnr = metrics.psnr(np.clip(seen.rgb[there], 0, 1), seen.frame_rgb[there])
            error = np.abs(seen.depth - seen.frame_depth)[both].mean()
            rows.append((psnr, error, both.sum() / max((seen.frame_depth > 0).sum(), 1)))
    if not rows:
        return None
    psnr, error, share = np.mean(rows, axis=0)
    return {"psnr": psnr, "depth_l1_m": error, "share_of_depth_shown": share, "frames": len(rows)}


def renderer(recording: Recording, result: SlamResult) -> Renderer:
    """The frame with a given index, and the map as seen from its estimated pose."""
    return lambda i: render_frame(recording, i, result.T_world_cam[i], result.grid, result.scene_params)


def render_frame(
    recording: Recording,
    i: int,
    T_world_cam: Float[np.ndarray, "4 4"],
    size: GridConfig,
    scene_params: Params,
    width: int = _VIEW_WIDTH,
) -> Rendered:
    """A frame and the map as seen from a pose, about `width` pixels wide.

    The measured depth plays no part in the rendering: a first pass over evenly spaced samples finds the
    surface, a second one looks closely.
    """
    camera = recording.camera
    step = max(1, round(camera.width / width))
    row, column = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    frame = recording.read(i)
    image = Image(jnp.asarray(frame.rgb), jnp.asarray(frame.depth, jnp.float32))
    pose = jnp.asarray(T_world_cam, jnp.float32)
    render, count = _compiled(size), row.size
    padded = np.arange(-(-count // _CHUNK) * _CHUNK) % count  # whole chunks: one shape is compiled
    parts = []
    for chunk in padded.reshape(-1, _CHUNK):
        pixels = read_pixels(image, camera, jnp.asarray(row.flat[chunk]), jnp.asarray(column.flat[chunk]))
        parts.append(jax.device_get(render(scene_params, pose, pixels)))
    rgb, depth = (np.concatenate(x)[:count] for x in zip(*parts, strict=True))
    photograph = np.asarray(frame.rgb)
    return Rendered(
        photograph,
        photograph[row, column] / 255,
        np.asarray(frame.depth)[row, column],
        rgb.reshape(*row.shape, 3),
        depth.reshape(row.shape),
    )


@lru_cache(maxsize=1)
def _compiled(size: GridConfig):
    """The rendering of pixels with a map of this size."""
    scene = grid(size)
    fine = SampleConfig(band=size.truncation, width=size.truncation / 8)
    reach = float(np.linalg.norm(np.subtract(size.upper, size.lower)))
    evenly = int(np.clip(reach / size.truncation * 4, 64, 256))
    coarse = SampleConfig(front=evenly, surface=0, behind=0, band=size.truncation, width=size.truncation / 4)

    @jax.jit
    def render(params, T_world_cam: Float[Array, "4 4"], pixels: Pixels):
        query, far = partial(scene.query, params), jnp.float32(reach)
        unknown = pixels._replace(depth=jnp.zeros_like(pixels.depth))
        found = render_pixels(query, T_world_cam, unknown, far, coarse)
        surface = jnp.where(found.opacity > 0.5, found.depth, 0)
        seen = render_pixels(query, T_world_cam, pixels._replace(depth=surface), far, fine)
        there = (surface > 0) & (seen.opacity > 0.5)
        return jnp.where(there[:, None], seen.rgb, 0.86), jnp.where(there, seen.depth, 0)

    return render


def _evenly(indices: Int[np.ndarray, " n"], most: int) -> list[int]:
    """Some of the indices, the first and the last among them."""
    places = np.linspace(0, len(indices) - 1, min(most, len(indices)))
    return [int(indices[round(place)]) for place in places]

"""The painted and lit surfaces of a scene, baked once into one array of texels, each with coarser copies."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from jaxpose.datasets.synthetic import textures
from jaxpose.datasets.synthetic.furniture import Piece
from jaxpose.datasets.synthetic.shapes import FACES, Hit, Shapes, Solids, cast

TEXEL = 0.005  # [m]
LEVELS = 4  # each of half the resolution
LATTICE = 0.06  # spacing of the points where light is computed [m]
_SKY = 32  # directions from which the glow is gathered
_SPOTS = np.array([(i, j, 0.0) for i in (-0.2, 0.0, 0.2) for j in (-0.2, 0.0, 0.2)])  # [m] of a lamp
_LAMPS = (3.4, 3.2, 2.9), (3.5, 3.1, 2.6)  # red, green, blue of lamps in turn


class Atlas(NamedTuple):
    """Charts of all faces behind one another, each at every level; colours packed as 0xBBGGRR."""

    texels: UInt[Array, " m"]
    start: Int[Array, "f l"]
    width: Int[Array, "f l"]
    height: Int[Array, "f l"]


def gather(pieces: list[Piece]) -> tuple[list[Piece], Shapes]:
    """The pieces in the order in which solids are numbered, and their geometry."""
    kinds = ("room", "box", "cylinder", "sphere")
    ordered = [[p for p in pieces if p.kind == kind] for kind in kinds]
    as_solids = lambda group: Solids(
        jnp.array([p.centre for p in group], jnp.float32),
        jnp.array([p.half for p in group], jnp.float32),
        jnp.array([(np.cos(p.yaw), np.sin(p.yaw)) for p in group], jnp.float32),
    )
    return sum(ordered, []), Shapes(*(as_solids(group) for group in ordered))


def extent(piece: Piece, face: int) -> tuple[float, float]:
    """Width and height of a face's chart [m]; zero for a face that the solid does not have."""
    a, b, c = np.multiply(piece.half, 2)
    if piece.kind == "sphere":
        return (np.pi * a, np.pi * a / 2) if face == 0 else (0.0, 0.0)
    if piece.kind == "cylinder":
        return ((np.pi * a, c), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (a, a), (a, a))[face]
    return ((b, c), (b, c), (a, c), (a, c), (a, b), (a, b))[face]


def unfold(piece: Piece, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (both (n, 3), in the world; into the room) at chart coordinates."""
    axis, side = face // 2, 2 * (face % 2) - 1.0
    turn, one = 2 * np.pi * (u - 0.5), np.ones_like(u)
    if piece.kind == "sphere":
        tilt = np.pi * v
        unit = np.stack([np.cos(turn) * np.sin(tilt), np.sin(turn) * np.sin(tilt), np.cos(tilt)], -1)
        normal = unit
    elif piece.kind == "cylinder" and axis == 0:
        unit = np.stack([np.cos(turn), np.sin(turn), 1 - 2 * v], -1)
        normal = unit * (1, 1, 0)
    else:
        flat = [2 * u - 1, 2 * v - 1 if axis == 2 else 1 - 2 * v]
        flat.insert(axis, side * one)
        unit = np.stack(flat, -1)
        normal = np.zeros_like(unit)
        normal[:, axis] = side
    c, s = np.cos(piece.yaw), np.sin(piece.yaw)
    R_world_solid = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    inwards = -1.0 if piece.kind == "room" else 1.0
    return unit * piece.half @ R_world_solid.T + piece.centre, inwards * normal @ R_world_solid.T


@jax.jit
def illuminate(
    shapes: Shapes, spots: Float[Array, "s 3"], point: Float[Array, "3 n"], normal: Float[Array, "3 n"]
) -> Float[Array, "n 3"]:
    """Light (red, green, blue) on surface points: lamps, of `_SPOTS` each, and a glow from all around."""
    start, lights = point + 1e-3 * normal, len(spots) // len(_SPOTS)
    # the normal plus points on a sphere: directions spread by Lambert's law
    directions = [
        spots[:, :, None] - start[None],
        jnp.asarray(_sphere(_SKY), point.dtype)[:, :, None] + normal[None],
    ]
    directions = jnp.concatenate(directions)
    distance = jax.lax.map(lambda direction: cast(shapes, tuple(start), tuple(direction))[0], directions)

    lamp, shine = directions[: len(spots)], distance[: len(spots)] > 0.999
    square = jnp.sum(lamp**2, axis=1)
    facing = jnp.maximum(jnp.sum(lamp * normal[None], axis=1), 0) * jnp.maximum(
        lamp[:, 2], 0
    )  # they shine down
    lamps = jnp.where(shine, facing / (square * (square + 1.5)), 0).reshape(lights, -1, point.shape[1])
    reach = distance[len(spots) :] * jnp.linalg.norm(directions[len(spots) :], axis=1)
    glow = jnp.mean(1 - jnp.exp(-reach / 0.4), axis=0, keepdims=True)
    shades = [_LAMPS[k % 2] for k in range(lights)]
    colour = jnp.array([*shades, (0.62, 0.65, 0.7)], point.dtype)
    return jnp.matmul(jnp.concatenate([lamps.mean(axis=1), glow]).T, colour, precision="highest")


def _sphere(count: int) -> np.ndarray:
    """Points spread evenly over the unit sphere (Fibonacci's spiral)."""
    turn, height = np.arange(count) * np.pi * (3 - np.sqrt(5)), 1 - (2 * np.arange(count) + 1) / count
    return np.stack([np.cos(turn), np.sin(turn), np.ones(count)], -1) * np.stack(
        [np.sqrt(1 - height**2), np.sqrt(1 - height**2), height], -1
    )


def bake(
    pieces: list[Piece],
    shapes: Shapes,
    rng: np.random.Generator,
    lights: tuple[tuple[float, float, float], ...],
) -> Atlas:
    """Paint every face and light it; `pieces` and `shapes` as `gather` returns them."""
    faces = [(piece, face) for piece in pieces for face in range(FACES)]
    size = [np.ceil(np.divide(extent(*item), TEXEL)).astype(int) for item in faces]
    lattice = [np.where(n > 0, np.maximum(np.ceil(n * TEXEL / LATTICE), 3), 0).astype(int) for n in size]
    unfolded = []
    for item, (columns, rows) in zip(faces, lattice, strict=True):
        v, u = np.meshgrid(
            (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
        )
        unfolded.append(unfold(*item, u.ravel(), v.ravel()))
    point, normal = (jnp.asarray(np.concatenate(p).T, jnp.float32) for p in zip(*unfolded, strict=True))
    spots = jnp.asarray((np.asarray(lights)[:, None] + _SPOTS).reshape(-1, 3), jnp.float32)
    light = np.asarray(illuminate(shapes, spots, point, normal)) ** np.float32(1 / 2.2)

    charts, used = [], 0
    for (piece, face), (width, height), (columns, rows) in zip(faces, size, lattice, strict=True):
        lit = light[used : used + rows * columns].reshape(rows, columns, 3)
        used += rows * columns
        if not lit.any():  # no such face, or nothing can see it
            charts.append([np.zeros((1, 1, 3), np.float32)] * LEVELS)
            continue
        painter = piece.painters[face % len(piece.painters)]
        colour = painter(rng, (np.arange(width) + 0.5) * TEXEL, (np.arange(height) + 0.5) * TEXEL)
        row, column = ((np.arange(n) + 0.5) * m / n - 0.5 for n, m in ((height, rows), (width, columns)))
        charts.append(_levels(colour * textures.enlarge(lit, row, column)))
    return _pack(charts)


def _levels(image: np.ndarray) -> list[np.ndarray]:
    """The image and its halvings."""
    levels: list[np.ndarray] = [np.clip(image, 0, 1).astype(np.float32)]
    while len(levels) < LEVELS:
        odd = [(0, n % 2) for n in levels[-1].shape[:2]]
        last = np.pad(levels[-1], [*odd, (0, 0)], mode="edge")
        levels.append((last[::2, ::2] + last[1::2, ::2] + last[::2, 1::2] + last[1::2, 1::2]) / 4)
    return levels


def _pack(charts: list[list[np.ndarray]]) -> Atlas:
    images = [level for chart in charts for level in chart]
    byte = np.concatenate([(255 * image + 0.5).astype(np.uint32).reshape(-1, 3) for image in images])
    shape = np.array([image.shape[:2] for image in images], np.int32)
    start = np.cumsum(np.concatenate([[0], shape.prod(1)[:-1]])).astype(np.int32)
    height, width, start = (x.reshape(len(charts), LEVELS) for x in (shape[:, 0], shape[:, 1], start))
    texels = byte[:, 0] | byte[:, 1] << 8 | byte[:, 2] << 16
    return Atlas(*(jnp.asarray(x) for x in (texels, start, width, height)))


def look_up(atlas: Atlas, hit: Hit, footprint: Float[Array, " n"]) -> Float[Array, "3 n"]:
    """Red, green and blue (0 to 255) at hits, of detail no finer than `footprint` [m]; bilinear."""
    level = jnp.clip(jnp.round(jnp.log2(footprint / TEXEL)), 0, LEVELS - 1).astype(jnp.int32)
    start, width, height = (table[hit.face, level] for table in (atlas.start, atlas.width, atlas.height))

    def neighbours(at, size):
        at = jnp.clip(at * size.astype(at.dtype) - 0.5, 0, (size - 1).astype(at.dtype))
        below = jnp.floor(at)
        first = below.astype(jnp.int32)
        return first, jnp.minimum(first + 1, size - 1), at - below

    left, right, across = neighbours(hit.chart[0], width)
    top, bottom, down = neighbours(hit.chart[1], height)

    def texel(row, column):
        packed = atlas.texels[start + row * width + column]
        return jnp.stack([(packed >> shift & 255).astype(jnp.float32) for shift in (0, 8, 16)])

    upper = texel(top, left) * (1 - across)[None] + texel(top, right) * across[None]
    lower = texel(bottom, left) * (1 - across)[None] + texel(bottom, right) * across[None]
    return upper * (1 - down)[None] + lower * down[None]

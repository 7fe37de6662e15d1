"""What stands in the room: 5 x 4 x 2.6 m, origin on the floor's centre, z up; a ring is left free to walk.

A larger room has the same things, those by a wall moved outwards with it.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxpose.datasets.synthetic import textures
from jaxpose.datasets.synthetic.textures import Painter

Extent = tuple[float, float, float]

SIZE: Extent = (5.0, 4.0, 2.6)
_BY_A_WALL = 1.0  # [m] from the middle
LIGHTS = ((1.1, 0.8, 2.55), (-1.2, -0.7, 2.55))  # centres of 0.6 m squares that shine down


class Piece(NamedTuple):
    """A solid with its paint, one painter or one a face (-x, +x, -y, +y, -z, +z)."""

    kind: str  # box, cylinder, sphere
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw: float
    painters: tuple[Painter, ...]


def box(x, y, z, width, depth, height, painter, yaw=0.0) -> Piece:
    """A box standing at height `z`: extents [m] along x, y, z."""
    return Piece("box", (x, y, z + height / 2), (width / 2, depth / 2, height / 2), yaw, (painter,))


def cylinder(x, y, z, radius, height, painter) -> Piece:
    """An upright cylinder standing at height `z`."""
    return Piece("cylinder", (x, y, z + height / 2), (radius, radius, height / 2), 0.0, (painter,))


def sphere(x, y, z, radius, painter) -> Piece:
    """A ball lying at height `z`."""
    return Piece("sphere", (x, y, z + radius), (radius,) * 3, 0.0, (painter,))


def place(pieces: list[Piece], x: float, y: float, yaw: float = 0.0) -> list[Piece]:
    """Move a group over the floor, first turned about its own origin."""
    c, s = np.cos(yaw), np.sin(yaw)
    return [
        p._replace(
            centre=(
                x + c * p.centre[0] - s * p.centre[1],
                y + s * p.centre[0] + c * p.centre[1],
                p.centre[2],
            ),
            yaw=p.yaw + yaw,
        )
        for p in pieces
    ]


def table(width, depth, height, top: Painter, legs: Painter) -> list[Piece]:
    """A table on four legs."""
    x, y = width / 2 - 0.05, depth / 2 - 0.05
    posts = [cylinder(i * x, j * y, 0, 0.025, height - 0.04, legs) for i in (-1, 1) for j in (-1, 1)]
    return [box(0, 0, height - 0.04, width, depth, 0.04, top), *posts]


def chair(seat: Painter, frame: Painter) -> list[Piece]:
    """A chair, its back at -y."""
    posts = [cylinder(i * 0.18, j * 0.18, 0, 0.018, 0.42, frame) for i in (-1, 1) for j in (-1, 1)]
    back = [box(i * 0.18, -0.2, 0.46, 0.03, 0.03, 0.34, frame) for i in (-1, 1)]
    return [
        *posts,
        *back,
        box(0, 0, 0.42, 0.42, 0.42, 0.04, seat),
        box(0, -0.2, 0.58, 0.42, 0.025, 0.2, seat),
    ]


def sofa(cloth: Painter, left: Painter, right: Painter) -> list[Piece]:
    """A sofa of two seats, its back at -y."""
    return [
        box(0, 0.06, 0, 1.9, 0.76, 0.4, cloth),
        box(0, -0.32, 0.4, 1.9, 0.2, 0.42, cloth),
        box(-0.88, 0.06, 0.4, 0.16, 0.76, 0.18, cloth),
        box(0.88, 0.06, 0.4, 0.16, 0.76, 0.18, cloth),
        box(-0.52, -0.12, 0.4, 0.42, 0.14, 0.34, left, 0.15),
        box(0.5, -0.1, 0.4, 0.4, 0.14, 0.32, right, -0.25),
    ]


def shelf(rng, wood: Painter) -> list[Piece]:
    """A bookcase 1.3 m wide, open in front (+x), filled from `rng`."""
    pieces = [box(0, j * 0.65, 0, 0.3, 0.03, 1.95, wood) for j in (-1, 1)]
    pieces += [box(-0.135, 0, 0, 0.02, 1.28, 1.95, wood)]
    for level in range(5):
        z = 0.05 + 0.45 * level
        pieces.append(box(0, 0, z, 0.3, 1.28, 0.025, wood))
        if level == 4:
            continue
        split = rng.uniform(-0.25, 0.25)
        for start, end in ((-0.62, split - 0.14), (split + 0.14, 0.62)):
            width = (end - start) * rng.uniform(0.7, 1)
            depth, height = rng.uniform(0.17, 0.24), rng.uniform(0.24, 0.36)
            pieces.append(box(-0.01, start + width / 2, z + 0.025, depth, width, height, textures.books))
    return pieces


def on_the_table(leaf: Painter) -> list[Piece]:
    """Books, a mug, a ball, a tin and a vase of leaves, on a table 0.42 m high about the origin."""
    ball = partial(
        textures.stains, colours=((0.85, 0.3, 0.2), (0.95, 0.85, 0.3), (0.2, 0.3, 0.6)), wavelength=0.12
    )
    mug = partial(textures.tiles, colours=((0.9, 0.9, 0.88), (0.15, 0.35, 0.6)), cell=0.03)
    tin = partial(textures.fabric, colour=(0.3, 0.6, 0.35), stripes=True)
    vase = partial(
        textures.stains, colours=((0.85, 0.83, 0.78), (0.5, 0.25, 0.15), (0.2, 0.3, 0.4)), wavelength=0.1
    )
    return [
        box(-0.28, 0.05, 0.42, 0.26, 0.19, 0.05, textures.poster, 0.5),
        box(-0.27, 0.06, 0.47, 0.21, 0.15, 0.035, textures.carton, 0.1),
        cylinder(-0.1, -0.18, 0.42, 0.042, 0.1, mug),
        sphere(0.3, 0.1, 0.42, 0.1, ball),
        cylinder(0.16, -0.17, 0.42, 0.05, 0.15, tin),
        cylinder(0, 0.08, 0.42, 0.065, 0.26, vase),
        sphere(0.01, 0.06, 0.67, 0.075, leaf),
        sphere(0.08, 0.12, 0.72, 0.055, leaf),
        sphere(-0.07, 0.1, 0.73, 0.06, leaf),
    ]


def desk(wood: Painter, metal: Painter) -> list[Piece]:
    """A desk, its user at -y: screen, keyboard, papers, a mug and a lamp."""
    keys = partial(textures.tiles, colours=((0.2, 0.2, 0.2), (0.32, 0.32, 0.34)), cell=0.02)
    return [
        *table(1.5, 0.68, 0.74, wood, metal),
        box(0.1, 0.12, 0.74, 0.22, 0.16, 0.02, metal),
        box(0.1, 0.15, 0.76, 0.04, 0.03, 0.12, metal),
        box(0.1, 0.13, 0.83, 0.56, 0.03, 0.34, textures.screen, 0.12),
        box(0.08, -0.14, 0.74, 0.42, 0.14, 0.02, keys),
        box(-0.5, 0.05, 0.74, 0.24, 0.32, 0.09, textures.books, -0.2),
        cylinder(
            0.45, -0.05, 0.74, 0.04, 0.11, partial(textures.fabric, colour=(0.7, 0.2, 0.2), stripes=True)
        ),
        cylinder(0.6, 0.18, 0.74, 0.07, 0.02, metal),
        cylinder(0.6, 0.18, 0.76, 0.01, 0.32, metal),
        cylinder(0.6, 0.18, 1.04, 0.1, 0.14, partial(textures.wallpaper, colour=(0.95, 0.8, 0.45))),
    ]


def cabinet(wood: Painter, doors: Painter, metal: Painter) -> list[Piece]:
    """A low cabinet open to -x, on it a globe, a picture and a vase."""
    globe = partial(
        textures.stains, colours=((0.15, 0.35, 0.6), (0.2, 0.42, 0.68), (0.75, 0.68, 0.4)), wavelength=0.2
    )
    return [
        box(0, 0, 0, 0.42, 1.2, 0.82, wood),
        *(box(-0.215, side * 0.3, 0.06, 0.02, 0.56, 0.7, doors) for side in (-1, 1)),
        *(sphere(-0.235, side * 0.06, 0.4, 0.018, metal) for side in (-1, 1)),
        cylinder(0, 0.4, 0.82, 0.03, 0.06, metal),
        sphere(0, 0.4, 0.88, 0.15, globe),
        cylinder(
            0.02,
            -0.35,
            0.82,
            0.08,
            0.3,
            partial(textures.stains, colours=((0.8, 0.8, 0.78), (0.2, 0.3, 0.5))),
        ),
        box(0.08, 0.02, 0.82, 0.03, 0.3, 0.4, textures.poster),
    ]


def plant(wood: Painter, leaf: Painter) -> list[Piece]:
    """A potted tree, head high."""
    return [
        cylinder(0, 0, 0, 0.16, 0.32, partial(textures.bricks, colour=(0.7, 0.42, 0.3))),
        cylinder(0, 0, 0.32, 0.02, 0.5, wood),
        sphere(0, 0, 0.6, 0.2, leaf),
        sphere(0.12, 0.1, 0.85, 0.15, leaf),
        sphere(-0.12, -0.05, 0.92, 0.13, leaf),
    ]


def lamp(metal: Painter) -> list[Piece]:
    """A standing lamp."""
    shade = partial(textures.wallpaper, colour=(1.3, 1.15, 0.85))
    return [
        cylinder(0, 0, 0, 0.14, 0.03, metal),
        cylinder(0, 0, 0.03, 0.015, 1.4, metal),
        cylinder(0, 0, 1.4, 0.2, 0.28, shade),
    ]


def cartons() -> list[Piece]:
    """Three boxes on top of each other."""
    return [
        box(0, 0, 0, 0.5, 0.4, 0.38, textures.carton, 0.15),
        box(0.02, 0.02, 0.38, 0.36, 0.32, 0.28, textures.carton, -0.35),
        box(-0.03, -0.02, 0.66, 0.24, 0.22, 0.2, textures.carton, 0.5),
    ]


def prints() -> list[Piece]:
    """Framed prints on the walls."""
    return [
        box(-2.485, -0.85, 1.15, 0.03, 0.5, 0.7, textures.poster),
        box(-2.485, 1.5, 1.25, 0.03, 0.6, 0.45, textures.poster),
        box(2.485, 0.9, 1.25, 0.03, 0.6, 0.8, textures.poster),
        box(2.485, -0.75, 1.35, 0.03, 0.8, 0.55, textures.poster),
        box(0.35, -1.985, 1.2, 1.0, 0.03, 0.7, textures.poster),
        box(-1.25, -1.985, 1.3, 0.5, 0.03, 0.7, textures.poster),
        box(1.2, 1.985, 1.15, 0.9, 0.03, 0.9, textures.poster),
        box(-0.5, 1.985, 1.45, 0.6, 0.03, 0.45, textures.poster),
    ]


def shell(tint, size: Extent, lights: tuple[tuple[float, float, float], ...] = LIGHTS) -> Piece:
    """The room: walls of four kinds, floor boards, ceiling panels with the lamps."""
    glowing = tuple((x + size[0] / 2, y + size[1] / 2) for x, y, _ in lights)
    painters = (
        partial(textures.plaster, colour=tint(0.8, 0.75, 0.64)),
        partial(textures.wallpaper, colour=tint(0.55, 0.66, 0.62)),
        partial(textures.bricks, colour=tint(0.68, 0.38, 0.28)),
        partial(textures.planks, colour=tint(0.78, 0.7, 0.56), upright=True),
        partial(textures.planks, colour=tint(0.64, 0.46, 0.3)),
        partial(textures.panels, glowing=glowing),
    )
    half = size[0] / 2, size[1] / 2, size[2] / 2
    return Piece("room", (0.0, 0.0, half[2]), half, 0.0, painters)


class Palette(NamedTuple):
    """What pieces are made of."""

    tint: Callable[..., Any]  # a colour, slightly another each time
    turned: Callable[[float], float]  # a random angle [rad] of up to so much
    oak: Painter
    dark: Painter
    metal: Painter
    leaf: Painter
    ball: Painter


def palette(rng: np.random.Generator, spread: float) -> Palette:
    """What rooms are furnished from; colours are tinted by up to a share `spread`."""
    tint = lambda *colour: tuple(
        np.clip(np.multiply(colour, rng.uniform(1 - spread, 1 + spread, 3)), 0.05, 0.95)
    )
    oak, dark = (partial(textures.wood, colour=tint(*c)) for c in ((0.74, 0.54, 0.34), (0.42, 0.28, 0.18)))
    return Palette(
        tint,
        lambda most: float(rng.uniform(-most, most)),
        oak,
        dark,
        partial(textures.plain, colour=(0.36, 0.37, 0.4)),
        partial(
            textures.stains,
            colours=((0.14, 0.32, 0.1), (0.27, 0.52, 0.18), (0.5, 0.7, 0.3)),
            wavelength=0.05,
        ),
        partial(textures.tiles, colours=((0.9, 0.9, 0.9), (0.8, 0.2, 0.2)), cell=0.12),
    )


def furnish(rng: np.random.Generator, size: Extent = SIZE) -> list[Piece]:
    """All pieces; the layout is fixed but for small turns, tints come from `rng` too."""
    tint, turned, oak, dark, metal, leaf, ball = palette(rng, 0.1)
    cloth = partial(textures.fabric, colour=tint(0.35, 0.48, 0.6))
    cushions = [
        partial(textures.fabric, colour=tint(0.85, 0.6, 0.3), stripes=stripes) for stripes in (True, False)
    ]
    tin = partial(textures.stains, colours=((0.2, 0.4, 0.65), (0.85, 0.8, 0.6)), wavelength=0.12)

    def outwards(x, y):
        beyond = np.subtract(size, SIZE) / 2
        step = lambda at, by: float(at + np.sign(at) * by * (abs(at) > _BY_A_WALL))
        return step(x, beyond[0]), step(y, beyond[1])

    def stand(pieces, x, y, yaw=0.0):
        return place(pieces, *outwards(x, y), yaw=yaw)

    hung = [p._replace(centre=(*outwards(*p.centre[:2]), p.centre[2])) for p in prints()]
    rug = box(0, 0, 0, 2.2, 1.5, 0.012, partial(textures.rug, colour=tint(0.65, 0.24, 0.2)))
    return [
        shell(tint, size),
        *hung,
        *stand([rug], 0.05, 0.0, turned(0.1)),
        *stand(table(1.0, 0.6, 0.42, oak, dark) + on_the_table(leaf), 0.0, 0.0, 0.4 + turned(0.3)),
        *stand(desk(oak, metal), -0.6, 1.6),
        *stand(chair(cloth, metal), -0.55, 1.05, np.pi + turned(0.3)),
        *stand(sofa(cloth, cushions[0], cushions[1]), 0.4, -1.52),
        *stand(shelf(rng, dark), -2.34, 0.35),
        *stand(cabinet(dark, oak, metal), 2.27, 0.0),
        *stand(cartons(), -2.05, -1.55, turned(0.3)),
        *stand(plant(dark, leaf), 2.1, -1.6),
        *stand(lamp(metal), 2.1, 1.6),
        *stand([sphere(0, 0, 0, 0.16, ball)], 1.2, 1.5),
        *stand(table(0.45, 0.45, 0.55, dark, dark) + [cylinder(0, 0, 0.55, 0.06, 0.2, tin)], 1.55, 1.6, 0.3),
    ]

"""A floor of a building, 15 x 12 x 2.6 m: four furnished rooms and a corridor around a core; a tour of it.

A tour comes back to where it began after 36 m: what loops of SLAM are tested on, as the room is too small.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxpose.datasets.synthetic import furniture, hand_held, textures
from jaxpose.datasets.synthetic.furniture import Extent, Piece, box, cylinder, place, sphere
from jaxpose.datasets.synthetic.hand_held import HandHeldMotion
from jaxpose.datasets.synthetic.textures import Painter

SIZE: Extent = (15.0, 12.0, 2.6)
LIGHTS = tuple(
    (x, y, 2.55)
    for x, y in ((5.2, 3.6), (-5.2, 3.6), (5.2, -3.6), (-5.2, -3.6), (1.8, 4.4), (-1.8, 4.4), (0.0, -4.2))
)
TOUR_S = 72.0  # once around, at speed 1: 36 m
_AXES = 5.75, 4.25  # [m] of the tour, along the middle of rooms and corridor
_DOOR = 1.2  # [m] wide


def tour(walk: HandHeldMotion, t: Float[Array, ""]) -> Float[Array, "4 4"]:
    """`T_world_body` at `t` [s] of a walk around the core through all rooms, looking ahead."""
    turn = lambda t: walk.start + 2 * jnp.pi / TOUR_S * walk.speed * t
    place_at, step = jax.jvp(lambda t: _course(turn(t)), (t,), (jnp.ones_like(t),))
    return hand_held.by_hand(walk, t, place_at, jnp.arctan2(step[1], step[0]))


def _course(angle: Float[Array, ""]) -> Float[Array, "3"]:
    """A closed curve between an ellipse and its bounding rectangle, as smooth as can be."""
    x, y = jnp.cos(angle), jnp.sin(angle)
    size = ((x / _AXES[0]) ** 4 + (y / _AXES[1]) ** 4) ** -0.25
    return jnp.stack([size * x, size * y, jnp.full_like(x, hand_held.HEIGHT)])


def furnish(rng: np.random.Generator) -> list[Piece]:
    """All pieces; the layout is fixed but for small turns, tints come from `rng` too."""
    tint, turned, oak, dark, metal, leaf, ball = furniture.palette(rng, 0.15)
    tin = partial(textures.stains, colours=(tint(0.3, 0.5, 0.6), tint(0.8, 0.7, 0.5)))
    cloth = lambda: partial(textures.fabric, colour=tint(*rng.uniform(0.25, 0.7, 3)))
    stand = lambda pieces, x, y, yaw=0.0: place(pieces, x, y, yaw + turned(0.1))
    dining = furniture.table(1.6, 0.8, 0.74, oak, dark)
    carpet = lambda: [box(0, 0, 0, 2.0, 1.4, 0.012, partial(textures.rug, colour=tint(0.6, 0.3, 0.25)))]
    return [
        furniture.shell(tint, SIZE, LIGHTS),
        *_walls(tint),
        *_prints(rng),
        # the room in the north-east: a study
        *stand(furniture.desk(oak, metal), 2.6, 5.55),
        *stand(furniture.chair(cloth(), metal), 2.6, 4.95, np.pi),
        *stand(furniture.shelf(rng, dark), 7.2, 2.0, np.pi),
        *stand(furniture.cartons(), 4.4, 2.9),
        *stand(carpet(), 5.6, 4.0, 0.5),
        # north-west: a place to sit
        *stand(furniture.sofa(cloth(), cloth(), cloth()), -3.0, 2.95),
        *stand(furniture.table(1.0, 0.6, 0.42, oak, dark) + furniture.on_the_table(leaf), -7.0, 3.4, 1.5),
        *stand(furniture.lamp(metal), -7.1, 5.5),
        *stand(furniture.plant(dark, leaf), -1.2, 5.6),
        *stand(carpet(), -5.4, 4.2, -0.4),
        # south-west: a dining room
        *stand(dining, -7.05, -3.6, np.pi / 2),
        *stand(furniture.chair(cloth(), dark), -6.6, -2.2, 0.4),
        *stand(furniture.cabinet(dark, oak, metal), -4.75, -1.0),
        *stand([sphere(0, 0, 0, 0.16, ball)], -4.6, -2.6),
        # south-east: a store
        *stand(furniture.shelf(rng, oak), 7.2, -3.2, np.pi),
        *stand(furniture.cartons(), 6.9, -5.4),
        *stand(furniture.cartons(), 4.5, -1.3, 1.0),
        *stand(furniture.plant(dark, leaf), 4.5, -0.5),
        *stand([cylinder(0, 0, 0, 0.3, 0.9, tin)], 7.1, -0.6),
        # the corridor
        *stand(furniture.table(0.45, 0.35, 0.8, dark, dark), 1.9, -3.55),
        *stand(furniture.plant(oak, leaf), -2.4, -3.55),
    ]  # fmt: skip


def _walls(tint) -> list[Piece]:
    """The core, the corridor on its south, and three walls with a door each."""
    of = {
        "plaster": partial(textures.plaster, colour=tint(0.78, 0.74, 0.66)),
        "paper": partial(textures.wallpaper, colour=tint(0.66, 0.58, 0.5)),
        "bricks": partial(textures.bricks, colour=tint(0.68, 0.42, 0.32)),
        "planks": partial(textures.planks, colour=tint(0.7, 0.66, 0.56), upright=True),
    }
    high = SIZE[2]
    core = Piece(
        "box", (0, -0.425, high / 2), (4.0, 2.925, high / 2), 0.0,
        (of["planks"], of["paper"], of["plaster"], of["bricks"], of["plaster"], of["plaster"]),
    )  # fmt: skip
    beyond = Piece(
        "box",
        (0, -5.575, high / 2),
        (4.0, 0.425, high / 2),
        0.0,
        (of["bricks"], of["paper"], *[of["plaster"]] * 4),
    )
    return [
        core,
        beyond,
        *_with_door((4.0, 7.5), 5.75, lambda a, b, z, h: _between(a, b, -0.06, 0.06, z, h, of["paper"])),
        *_with_door((-7.5, -4.0), -5.75, lambda a, b, z, h: _between(a, b, -0.06, 0.06, z, h, of["bricks"])),
        *_with_door((2.5, 6.0), 4.25, lambda a, b, z, h: _between(-0.06, 0.06, a, b, z, h, of["planks"])),
    ]


def _with_door(span: tuple[float, float], door: float, wall) -> list[Piece]:
    """A wall over a span with a door in it: to either side, and above."""
    first, last = door - _DOOR / 2, door + _DOOR / 2
    return [
        wall(span[0], first, 0.0, SIZE[2]),
        wall(last, span[1], 0.0, SIZE[2]),
        wall(first, last, 2.1, 0.5),
    ]


def _between(x0, x1, y0, y1, z, height, painter: Painter) -> Piece:
    return box((x0 + x1) / 2, (y0 + y1) / 2, z, x1 - x0, y1 - y0, height, painter)


def _prints(rng: np.random.Generator) -> list[Piece]:
    """Framed prints along all walls, of different sizes at different heights."""
    along_x = lambda y, xs: [(x, y, False) for x in xs]
    along_y = lambda x, ys: [(x, y, True) for y in ys]
    places = [
        *along_x(5.985, (-6.3, -4.4, -2.6, 1.2, 4.6, 6.4)),
        *along_x(2.515, (-1.2, 0.9, 2.8)),
        *along_x(-3.365, (-1.0, 0.4, 3.2)),
        *along_x(-5.135, (-3.0, -1.4, 0.8, 2.6)),
        *along_x(-5.985, (-6.2, -4.7, 5.2)),
        *along_y(7.485, (-4.9, -1.6, 3.8, 5.2)),
        *along_y(-7.485, (-5.2, -1.4, 1.6, 4.6)),
        *along_y(4.015, (-2.4, 1.3)),
        *along_y(-4.015, (-2.2, 0.9, 1.9)),
    ]
    pieces = []
    for x, y, turned in places:
        width, height, z = rng.uniform(0.4, 1.0), rng.uniform(0.4, 0.9), rng.uniform(1.0, 1.5)
        sides = (0.03, width) if turned else (width, 0.03)
        pieces.append(box(x, y, z, *sides, height, textures.poster))
    return pieces

"""Solids with exact ray intersection and a flat chart for every face.

A solid is convex and lives in its own axes (turned about the vertical by its heading), so a ray is inside
it for one interval of distances. Faces are numbered -x, +x, -y, +y, -z, +z; a cylinder's side is face 0, its
ends are 4 and 5; a sphere is all face 0. Charts run over [0, 1]^2, downwards on upright faces. Coordinates
are separate arrays in here rather than an axis of three: that keeps the ray loops vectorised.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

FACES = 6


class Solids(NamedTuple):
    """Solids of one kind; `half` are half extents [m] (a radius is written in each axis that it spans)."""

    centre: Float[Array, "s 3"]
    half: Float[Array, "s 3"]
    heading: Float[Array, "s 2"]  # cosine and sine of the yaw


class Shapes(NamedTuple):
    """All that a ray can meet, numbered in this order; `room` is one box, seen from inside."""

    room: Solids
    boxes: Solids
    cylinders: Solids
    spheres: Solids


Rays = tuple[Float[Array, " #n"], ...]  # x, y, z; one origin may serve all directions


class Hit(NamedTuple):
    """Where rays end: on which face of which solid, and where on its chart."""

    distance: Float[Array, " n"]  # in lengths of the direction vector
    face: Int[Array, " n"]  # FACES * solid + face
    chart: tuple[Float[Array, " n"], Float[Array, " n"]]
    cosine: Float[Array, " n"]  # of the angle between the ray and the surface normal, >= 0


def turn(vector, heading, sign: int = 1):
    """World axes to a solid's axes (`sign` 1) or back (-1), as three separate coordinates."""
    c, s = heading[0], sign * heading[1]
    x, y, z = vector
    return c * x + s * y, c * y - s * x, z


def _slab(origin, direction, half):
    """Interval of a ray between two planes at -half and +half."""
    inverse = 1 / jnp.where(direction == 0, jnp.full_like(direction, 1e-20), direction)
    middle, reach = -origin * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _ball(origin, direction, radius):
    """Interval of a ray within `radius` of the origin, in as many dimensions as the ray has."""
    square = jnp.maximum(sum(d * d for d in direction), 1e-20)
    middle = -sum(o * d for o, d in zip(origin, direction, strict=True)) / square
    nearest = [o + middle * d for o, d in zip(origin, direction, strict=True)]
    chord = (radius**2 - sum(p * p for p in nearest)) / square
    reach = jnp.sqrt(jnp.maximum(chord, 0))
    return jnp.where(chord > 0, middle - reach, jnp.inf), middle + reach


def _box(origin, direction, half):
    slabs = [_slab(origin[k], direction[k], half[k]) for k in range(3)]
    first = jnp.maximum(jnp.maximum(slabs[0][0], slabs[1][0]), slabs[2][0])
    return first, jnp.minimum(jnp.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])


def _cylinder(origin, direction, half):
    side = _ball(origin[:2], direction[:2], half[0])
    ends = _slab(origin[2], direction[2], half[2])
    return jnp.maximum(side[0], ends[0]), jnp.minimum(side[1], ends[1])


def _sphere(origin, direction, half):
    return _ball(origin, direction, half[0])


def cast(
    shapes: Shapes,
    origin: Rays,
    direction: Rays,
    *,
    seen: Bool[Array, " s"] | None = None,
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Distance (in lengths of `direction`) to the nearest surface and its solid's number.

    A ray that starts inside a solid has distance 0. Solids not in `seen` are passed over.
    """

    def local(centre, heading):
        shifted = tuple(o - c for o, c in zip(origin, centre, strict=True))
        return turn(shifted, heading), turn(direction, heading)

    def nearest_of(interval, solids, first, best):
        def visit(best, item):
            number, use, solid = item

            def test(best):
                first, last = interval(*local(solid.centre, solid.heading), solid.half)
                distance = jnp.where(last > jnp.maximum(first, 0), jnp.maximum(first, 0), jnp.inf)
                closer = distance < best[0]
                return jnp.where(closer, distance, best[0]), jnp.where(closer, number, best[1])

            return jax.lax.cond(use, test, lambda best: best, best), None

        numbers = jnp.arange(first, first + len(solids.centre), dtype=jnp.int32)
        use = jnp.ones(numbers.shape, bool) if seen is None else seen[first : first + len(numbers)]
        return jax.lax.scan(visit, best, (numbers, use, solids))[0]

    walls = jax.tree.map(lambda x: x[0], shapes.room)
    distance = jnp.maximum(_box(*local(walls.centre, walls.heading), walls.half)[1], 0)
    best, first = (distance, jnp.zeros(distance.shape, jnp.int32)), 1
    for interval, solids in ((_box, shapes.boxes), (_cylinder, shapes.cylinders), (_sphere, shapes.spheres)):
        best = nearest_of(interval, solids, first, best)
        first += len(solids.centre)
    return best


def within_cone(
    shapes: Shapes, apex: Float[Array, "3"], axis: Float[Array, "3"], cosine: Float[Array, ""]
) -> Bool[Array, " s"]:
    """Which solids may reach into a cone (unit axis, cosine of its half angle): by their bounding spheres."""
    solids = _all(shapes)
    offset = solids.centre - apex[None]
    radius = jnp.sqrt(jnp.sum(solids.half**2, axis=-1))
    along = jnp.sum(offset * axis[None], axis=-1)
    across = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1) - along**2, 0))
    # distance to the cone's surface, positive outside; behind the apex this is an underestimate
    return across * cosine - along * jnp.sqrt(1 - cosine**2) <= radius


def _all(shapes: Shapes) -> Solids:
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *shapes)


def locate(
    shapes: Shapes,
    origin: Rays,
    direction: Rays,
    distance: Float[Array, " n"],
    number: Int[Array, " n"],
) -> Hit:
    """Face, chart coordinates and incidence of rays that end at `distance` on solid `number`."""
    solid = jax.tree.map(lambda x: x[number].T, _all(shapes))
    reached = tuple(o + distance * d - c for o, d, c in zip(origin, direction, solid.centre, strict=True))
    point = tuple(x / h for x, h in zip(turn(reached, solid.heading), solid.half, strict=True))
    along = turn(direction, solid.heading)
    boxes = 1 + len(shapes.boxes.centre)
    is_box, is_cylinder = number < boxes, number < boxes + len(shapes.cylinders.centre)
    charted = (_chart_box(point, along), _chart_cylinder(point, along), _chart_sphere(point, along))
    face, u, v, cosine = (
        jnp.where(is_box, box, jnp.where(is_cylinder, cylinder, sphere))
        for box, cylinder, sphere in zip(*charted, strict=True)
    )
    length = jnp.sqrt(sum(d * d for d in along))
    return Hit(distance, FACES * number + face, (u, v), jnp.minimum(jnp.abs(cosine) / length, 1))


def _chart_box(point, along):
    """Face, chart and component of the direction along the normal, for a point on the unit cube."""
    x, y, z = point
    flat = jnp.abs(z) > jnp.maximum(jnp.abs(x), jnp.abs(y))
    sideways = ~flat & (jnp.abs(x) > jnp.abs(y))
    face = jnp.where(
        flat, jnp.where(z > 0, 5, 4), jnp.where(sideways, jnp.where(x > 0, 1, 0), jnp.where(y > 0, 3, 2))
    )
    u, v = jnp.where(sideways, y, x), jnp.where(flat, y, -z)
    normal = jnp.where(flat, along[2], jnp.where(sideways, along[0], along[1]))
    return face, u / 2 + 0.5, v / 2 + 0.5, normal


def _chart_cylinder(point, along):
    x, y, z = point
    end = z * z > x * x + y * y
    face = jnp.where(end, jnp.where(z > 0, 5, 4), 0)
    u = jnp.where(end, x / 2 + 0.5, jnp.arctan2(y, x) / (2 * jnp.pi) + 0.5)
    v = jnp.where(end, y, -z) / 2 + 0.5
    return face, u, v, jnp.where(end, along[2], x * along[0] + y * along[1])


def _chart_sphere(point, along):
    x, y, z = point
    u = jnp.arctan2(y, x) / (2 * jnp.pi) + 0.5
    v = jnp.arccos(jnp.clip(z, -1, 1)) / jnp.pi
    return jnp.zeros_like(x, jnp.int32), u, v, x * along[0] + y * along[1] + z * along[2]

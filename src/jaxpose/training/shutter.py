"""Rolling shutter and motion blur: every row of a photograph is exposed at its own time, for a while.

The time of a photograph is that of the middle of its exposure, at its middle row.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxpose.fields import PoseField
from jaxpose.fields.types import Description, described

Params = Any


class Shutter(NamedTuple):
    """When the rows of a photograph are exposed."""

    line_delay: float | Float[Array, ""]  # [s] from one row to the next; negative: from the bottom up
    exposure: float | Float[Array, ""]  # [s]
    instants: int = 4  # of an exposure, whose colours are averaged


def exposure_times(
    shutter: Shutter, t: Float[Array, ""], row: Float[Array, ""] | Int[Array, ""], height: int
) -> Float[Array, " instants"]:
    """Instants, equally spaced, at which a pixel is exposed.

    Args:
        shutter: Line delay and exposure.
        t: The time of the photograph [s].
        row: The pixel's row, from the top.
        height: Of the photograph [px].

    Returns:
        Their times [s]; their mean is the middle of the row's exposure.

    >>> times = exposure_times(Shutter(0.1, 0.4, 2), jnp.float32(1), jnp.float32(2), height=3)
    >>> [round(float(t), 3) for t in times]
    [1.0, 1.2]
    """
    phase = (jnp.arange(shutter.instants, dtype=t.dtype) + 0.5) / shutter.instants - 0.5
    return t + shutter.line_delay * (row.astype(t.dtype) - (height - 1) / 2) + shutter.exposure * phase


@dataclass(frozen=True)
class _WithShutter:
    """A field whose parameters also hold a shutter, in units that make both numbers about one."""

    field: Description
    start: tuple[float, float]  # line delay and exposure [s]
    units: tuple[float, float]  # [s]

    @property
    def span(self) -> tuple[float, float]:
        return self.field.span

    def init(self, key) -> Params:
        start = [value / unit for value, unit in zip(self.start, self.units, strict=True)]
        return {"field": self.field.init(key), "shutter": jnp.asarray(start, jnp.zeros(()).dtype)}

    def pose(self, params, t):
        return self.field.pose(params["field"], t)

    def factors(self, params):
        return self.field.factors(params["field"])

    def shifted(self, seconds: float) -> "_WithShutter":
        return replace(self, field=self.field.shifted(seconds))


def with_shutter(field: PoseField, start: Shutter, units: tuple[float, float]) -> PoseField:
    """A pose field that is trained together with the shutter of its camera.

    Args:
        field: A field with a description; its poses stay as they are.
        start: Where line delay and exposure start. The gradient of an exposure is zero at zero.
        units: Of both parameters [s], such as a readout's and a frame interval's share of a row.

    Returns:
        A field of parameters `{"field": those of the field, "shutter": (2,)}`.

    Raises:
        ValueError: For a field of functions alone.
    """
    if field.description is None:
        raise ValueError("with_shutter: expected a field with a description, got one of functions alone")
    begins = float(start.line_delay), float(start.exposure)
    return described(_WithShutter(field.description, begins, units))


def shutter_of(field: PoseField, params: Params, instants: int) -> Shutter:
    """The shutter that a field of `with_shutter` has found.

    Args:
        field: Of `with_shutter`.
        params: Its parameters.
        instants: Of an exposure.

    Returns:
        Line delay and exposure [s]; the sign of an exposure means nothing.
    """
    assert isinstance(field.description, _WithShutter)
    line, exposure = params["shutter"]
    line_unit, exposure_unit = field.description.units
    return Shutter(line * line_unit, exposure * exposure_unit, instants)

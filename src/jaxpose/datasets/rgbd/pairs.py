"""Timestamps of two sensors that belong together."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxpose.datasets.images import some
from jaxpose.errors import DataError


def nearest_pairs(
    where: str, t: Float[np.ndarray, " n"], other: Float[np.ndarray, " m"], limit: float
) -> tuple[list[int], list[int]]:
    """Pair the timestamps of colour and depth one to one, the closest first.

    Args:
        where: What they are of, for errors.
        t: Timestamps (n,) [s] of colour, increasing.
        other: Timestamps (m,) [s] of depth, increasing.
        limit: Less than this apart [s] are timestamps that belong together.

    Returns:
        Indices into both, in pairs; those of colour increase.

    Raises:
        DataError: Where no two belong together, with how far apart the nearest are.
    """
    first, last = np.searchsorted(other, t - limit), np.searchsorted(other, t + limit)
    near = sorted((abs(t[i] - other[j]), i, j) for i in range(len(t)) for j in range(first[i], last[i]))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for difference, i, j in near:
        if difference < limit and i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    if not partner:
        spans = [f"{x[0]:.3f} to {x[-1]:.3f} s" for x in (t, other)]
        apart = np.abs(t[:, None] - other[None]).min()
        raise DataError(
            f"{where}: expected colour and depth within {limit:g} s, got timestamps from "
            f"{' and '.join(spans)}, the nearest {apart:.3g} s apart"
        )
    rows = sorted(partner)
    return rows, [partner[i] for i in rows]


def unpaired_note(
    kind: str, other: str, names: Sequence[str], used: Sequence[int], limit: float
) -> tuple[str, ...]:
    """A note on images of one kind that have no partner of the other.

    Args:
        kind: What they are.
        other: What their partners are.
        names: Of all n of them.
        used: Indices of those that have one.
        limit: How far apart [s] partners may be.

    Returns:
        One note, or none where all have one.
    """
    paired = set(used)
    alone = [name for i, name in enumerate(names) if i not in paired]
    if not alone:
        return ()
    note = f"{len(alone)} of {len(names)} {kind} images left out, no {other} of their own within {limit:g} s"
    return (f"{note}: {some(alone)}",)

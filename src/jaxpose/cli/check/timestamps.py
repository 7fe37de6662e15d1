"""Tests of timestamps as they were read: how many repeat, and the gaps between them."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxpose.cli.check.findings import Checked, Fact, Finding
from jaxpose.errors import DataError
from jaxpose.files.tables import seconds
from jaxpose.files.trajectories import read_timestamps

_GAP = 5.0  # median periods
_MOST_REPEATED = 0.01  # share of the timestamps; fewer are left out by the readers without harm


def check_stamps(
    what: str,
    t: Float[np.ndarray, " n"],
    unit: str = "s",
    *,
    gaps: Literal["note", "warning"],
    t0_ns: int = 0,
    repeated: int = 0,
) -> Checked:
    """Count, rate, span and gaps of increasing timestamps `t` [s] since `t0_ns`, in `unit` in the file.

    `gaps` says whether a gap is a fault, as in what is integrated or tracked, or just to be told; `repeated`
    is how many more lines the reader has left out, as they repeat a timestamp.
    """
    steps = np.diff(t)
    period = float(np.median(steps)) if len(steps) else np.nan
    text, numbers, findings, notes = f"{len(t)}", {}, [], []
    if repeated > _MOST_REPEATED * (len(t) + repeated):
        found = f"{repeated} of {len(t) + repeated} that repeat the one before"
        fix = "write timestamps with more digits, or leave repeated rows out"
        findings.append(
            Finding("warning", "timestamps", found, f"a timestamp of its own for each of {what}", fix)
        )
    if len(steps):
        span, widest = float(np.ptp(t)), int(steps.argmax())
        gap, at = float(steps[widest]), float(t[widest] - t[0])
        text += f" at {1 / period:.4g} Hz over {span:.4g} s ({unit} in the file)"
        text += f", largest gap {gap:.3g} s at {at:.4g} s"
        numbers = {"rate_hz": 1 / period, "span_s": span, "largest_gap_s": gap, "unit": unit}
        numbers |= {"largest_gap_at_s": at, "first_stamp_s": t0_ns / 10**9 + float(t[0])}
        wide = int((steps > _GAP * period).sum())
        found = f"{wide} gaps of more than {_GAP:g} periods, the largest {gap:.3g} s at {at:.4g} s"
        if wide and gaps == "note":
            notes.append(f"{what}: {found}")
        elif wide:
            expected = f"{what} about every {period:.3g} s"
            findings.append(Finding("warning", "gaps", found, expected, "cut the recording at the gaps"))
        elif not findings:
            findings.append(Finding("ok", "timestamps", f"{what}: increasing, no gap, plausible in {unit}"))
    return Checked((Fact(what, text, {"count": len(t), **numbers}),), tuple(findings), tuple(notes))


def stamps_of(file: Path, *, gaps: Literal["note", "warning"]) -> Checked:
    """The timestamps that begin the lines of a file; nothing for one that its loader refuses."""
    try:
        ns = read_timestamps(file)
    except DataError:
        return Checked()
    return check_stamps(file.name, seconds(ns, ns[0]), gaps=gaps, t0_ns=ns[0])

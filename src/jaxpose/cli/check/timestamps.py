"""Tests of timestamps: their order, their unit, and the gaps between them."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from jaxpose.cli.check.findings import Checked, Fact, Finding

_GAP = 5.0  # median periods
_MOST_REPEATED = 0.01  # share of the timestamps; fewer are left out by the readers without harm
_UNITS = {0: "s", -3: "ms", -6: "us", -9: "ns"}
_PLAUSIBLE_HZ = (0.1, 1e4)  # of what is recorded by a camera, an IMU or motion capture
_USUAL_HZ = (0.5, 2e3)
_SINCE_1970 = (1e8, 4e9)  # s, from 1973 to 2096
_WHOLE_PERIOD = 2.0  # s: timestamps that are all whole numbers so far apart count something else


def check_stamps(
    what: str, t: Float[np.ndarray, " n"], unit: Literal["s", "ns"] = "s", *, gaps: Literal["note", "warning"]
) -> Checked:
    """Count, rate, span and gaps of timestamps `t` [s], which were read as `unit`; tests of order and unit.

    `gaps` says whether a gap is a fault, as in what is integrated or tracked, or just to be told.
    """
    steps = np.diff(t)
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan
    span, widest = float(np.ptp(t)) if len(t) else 0.0, int(steps.argmax()) if len(steps) else 0
    text, numbers = f"{len(t)}", {}
    if np.isfinite(period):
        gap = float(steps[widest])
        text += f" at {1 / period:.4g} Hz over {span:.4g} s ({unit} in the file)"
        text += f", largest gap {gap:.3g} s at {t[widest] - t[0]:.4g} s"
        numbers = {"rate_hz": 1 / period, "span_s": span, "largest_gap_s": gap, "unit": unit}
        numbers |= {"largest_gap_at_s": float(t[widest] - t[0]), "first_stamp_s": float(t[0])}
    findings, notes = [*_order(what, t), *_unit(what, t, period, unit)], []
    wide = np.flatnonzero(steps > _GAP * period)
    if len(wide):
        found = f"{len(wide)} gaps of more than {_GAP:g} periods, the largest {steps[widest]:.3g} s at "
        found += f"{t[widest] - t[0]:.4g} s"
        if gaps == "note":
            notes.append(f"{what}: {found}")
        else:
            expected = f"{what} about every {period:.3g} s"
            findings.append(Finding("warning", "gaps", found, expected, "cut the recording at the gaps"))
    elif not findings and np.isfinite(period):
        findings.append(Finding("ok", "timestamps", f"{what}: increasing, no gap, plausible in {unit}"))
    return Checked((Fact(what, text, {"count": len(t), **numbers}),), tuple(findings), tuple(notes))


def _order(what: str, t: Float[np.ndarray, " n"]) -> list[Finding]:
    steps = np.diff(t)
    findings = []
    back = np.flatnonzero(steps < 0)
    if len(back):
        found = f"{len(back)} that go backwards, the first after {t[back[0]]!s} s (row {back[0] + 2})"
        findings.append(
            Finding("error", "timestamps", found, f"increasing timestamps of {what}", "sort the rows")
        )
    repeated = int((steps == 0).sum())
    if repeated > _MOST_REPEATED * len(t):
        found = f"{repeated} of {len(t)} that repeat the one before"
        fix = "write timestamps with more digits, or leave repeated rows out"
        findings.append(
            Finding("warning", "timestamps", found, f"a timestamp of its own for each of {what}", fix)
        )
    return findings


def _unit(what: str, t: Float[np.ndarray, " n"], period: float, unit: str) -> list[Finding]:
    """Timestamps that make no sense in the unit that the format has, and the unit in which they would."""
    if len(t) < 2 or not np.isfinite(period):
        return []
    latest = float(np.abs(t).max())
    whole = unit == "s" and period >= _WHOLE_PERIOD and (t == np.round(t)).all()
    plausible = _PLAUSIBLE_HZ[0] <= 1 / period <= _PLAUSIBLE_HZ[1]
    if plausible and latest <= _SINCE_1970[1] and not whole:
        return []
    own = next(power for power, name in _UNITS.items() if name == unit)
    fitting = [
        (not _SINCE_1970[0] <= latest * 10.0 ** (power - own) <= _SINCE_1970[1], name)
        for power, name in _UNITS.items()
        if name != unit and _USUAL_HZ[0] <= 10.0 ** (own - power) / period <= _USUAL_HZ[1]
    ]
    found = f"{1 / period:.3g} Hz and timestamps up to {latest:.4g} s, read as {unit}"
    if fitting:
        actual = min(fitting)[1]
        found += f": they are in {actual}"
        fix = f"convert the timestamps from {actual} to {unit}"
    else:
        fix = "check the unit of the timestamps"
    expected = f"{what} in {unit} at {_PLAUSIBLE_HZ[0]:g} to {_PLAUSIBLE_HZ[1]:g} Hz"
    return [Finding("warning", "unit of time", found, expected, fix)]

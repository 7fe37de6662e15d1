"""Checks of the event camera data set's layout: events, frames, calibration, truth."""

from itertools import islice
from pathlib import Path

import numpy as np

from jaxpose.commands.check_findings import Checked, Fact, Finding, join, unusable
from jaxpose.commands.check_recording import check_camera
from jaxpose.commands.check_stamps import check_stamps, read_table
from jaxpose.commands.check_trajectory import check_trajectory
from jaxpose.data.images import SUFFIXES, image_size
from jaxpose.errors import DataError

_MOST = 500_000  # events that are read: recordings have hundreds of millions
_SENSOR = (240, 180)  # of the data set's DAVIS240C


def event_files(folder: Path) -> list[Path]:
    """Files of events in a folder."""
    return sorted(folder.glob("events*.txt"))


def check_events(folder: Path) -> Checked:
    """Events of the first file, frames, calibration and truth, as far as they are there."""
    images = sorted(file for file in folder.glob("images/*") if file.suffix in SUFFIXES)
    parts = []
    try:
        size = image_size(images[0]) if images else _SENSOR
        parts.append(_events(event_files(folder)[0], size))
        if (folder / "calib.txt").is_file():
            parts.append(_calibration(folder / "calib.txt", size))
        if (folder / "images.txt").is_file():
            table = read_table(folder / "images.txt")
            parts.append(check_stamps("images.txt", table[:, 0], gaps="warning"))
        if (folder / "groundtruth.txt").is_file():
            checked = check_trajectory(folder / "groundtruth.txt")[1]
            parts.append(
                checked._replace(facts=tuple(f._replace(name=f"truth {f.name}") for f in checked.facts))
            )
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    return join(parts)


def _events(file: Path, size: tuple[int, int]) -> Checked:
    """Count, rate, polarities and pixels of the first events."""
    with file.open() as lines:
        table = np.array([line.split() for line in islice(lines, _MOST)])
    try:
        t, x, y, polarity = table.astype(np.float64).T
    except ValueError:
        raise DataError(f"{file}: expected lines of t x y p, got others") from None
    span = float(np.ptp(t))
    values = sorted({float(p) for p in polarity})
    kept = "the first " if len(t) == _MOST else ""
    text = f"{kept}{len(t)} in {span:.4g} s ({len(t) / max(span, 1e-12):.3g} Hz), polarities "
    text += (
        f"{' and '.join(f'{p:g}' for p in values)}, pixels to {x.max():g}, {y.max():g} of {size[0]}x{size[1]}"
    )
    fact = Fact("events", text, {"count": len(t), "span_s": span, "rate_hz": len(t) / max(span, 1e-12)})
    findings = []
    if (np.diff(t) < 0).any():
        row = int((np.diff(t) < 0).argmax()) + 2
        findings.append(Finding("error", "events", f"one that goes back in line {row}", "stamps that rise"))
    if not (0 <= x.min() and x.max() < size[0] and 0 <= y.min() and y.max() < size[1]):
        expected = f"pixels of {size[0]}x{size[1]}"
        findings.append(Finding("warning", "events", f"up to {x.max():g}, {y.max():g}", expected))
    if values not in ([0.0, 1.0], [-1.0, 1.0]):
        found = ", ".join(f"{p:g}" for p in values[:5])
        findings.append(Finding("warning", "events", found, "polarities 0 and 1, or -1 and 1"))
    if span and not 1e2 < len(t) / span < 1e9:
        found = f"{len(t) / span:.3g} Hz"
        findings.append(Finding("warning", "unit of time", found, "100 Hz to 1 GHz of events", "stamps in s"))
    ok = Finding("ok", "events", "in order, within the sensor, two polarities")
    return Checked((fact,), tuple(findings) or (ok,))


def _calibration(file: Path, size: tuple[int, int]) -> Checked:
    from jaxpose.camera import Camera

    table = read_table(file)
    if table.shape != (1, 9):
        raise DataError(f"{file}: expected 9 numbers (fx fy cx cy k1 k2 p1 p2 k3), got {table.size}")
    fx, fy, cx, cy, *lens = (float(number) for number in table[0])
    return check_camera(Camera(fx, fy, cx, cy, *size, tuple(lens) if any(lens) else ()))

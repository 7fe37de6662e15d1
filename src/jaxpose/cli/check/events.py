"""Checks of event recordings: the events, camera, frames and poses, as far as they are there."""

from pathlib import Path

import numpy as np

from jaxpose.cli.check.findings import Checked, Fact, Finding, join, unusable
from jaxpose.cli.check.poses import check_poses
from jaxpose.cli.check.recording import check_camera
from jaxpose.cli.check.timestamps import stamps_of
from jaxpose.cli.check.trajectory import check_trajectory
from jaxpose.datasets.events import registry as event_registry
from jaxpose.datasets.events.stream import Stream, StreamStats, count, in_words, reach
from jaxpose.datasets.types import EventRecording
from jaxpose.errors import DataError

_MOST = 500_000  # events that are looked at: recordings have hundreds of millions
_RATES_HZ = (1e2, 1e9)
_NAMES = {
    "eventnerf": "EventNeRF",
    "davis": "DAVIS",
    "hdf5": "HDF5",
    "npz": "npz",
    "file": "file of",
    "ros": "ROS bag of",
}


def find_events(path: Path) -> event_registry.Format | None:
    """The layout of the events that a folder or file has; None if it has none."""
    try:
        return event_registry.find_format(path)
    except DataError:
        return None


def check_events(path: Path, form: event_registry.Format) -> tuple[str, Checked]:
    """The format in words, and what is tested of it, of events only the first."""
    parts, name = [], f"{_NAMES[form]} events"
    try:
        stream, camera, _ = event_registry.find(path, form)
        name = f"{name} ({stream.file.name})"
        size = (camera.width, camera.height)
        tally = count(stream, size, most=_MOST)
        parts += [_events(stream, tally, size), check_camera(camera), *_beside(stream.file.parent)]
        # EventNeRF's views are spread over all events, so there all are read.
        span = None if form == "eventnerf" else (tally.earliest, np.nextafter(tally.latest, np.inf))
        parts.append(_recording(event_registry.load_events(path, form, span=span), form))
    except (DataError, OSError) as error:
        parts.append(unusable(error))
    return name, join(parts)


def _events(stream: Stream, tally: StreamStats, size: tuple[int, int]) -> Checked:
    """Count, rate, polarities and pixels of the first events; what loading refuses is not told here."""
    span = tally.latest - tally.earliest
    rate = tally.count / max(span, 1e-12)
    kept = "the first " if tally.count >= _MOST else ""
    text = f"{kept}{tally.count} in {span:.4g} s ({rate:.3g} Hz), polarities {in_words(tally.polarities)}, "
    text += f"pixels {reach(tally)} of {size[0]}x{size[1]}"
    fact = Fact("events", text, {"count": tally.count, "span_s": span, "rate_hz": rate})
    findings = []
    if tally.back:
        found = f"{tally.back} earlier than one before, by up to {tally.most_back:.3g} s, "
        found += f"the first at {stream.where(tally.first_back or 0)}"
        findings.append(Finding("warning", "events", found, "timestamps that rise"))
    if tally.outside:
        expected = f"pixels of {size[0]}x{size[1]}"
        findings.append(Finding("warning", "events", reach(tally), expected))
    if len(tally.polarities) < 2:
        expected = "polarities 0 and 1, or -1 and 1"
        findings.append(Finding("warning", "events", f"only {in_words(tally.polarities)}", expected))
    if span and (tally.unit != (stream.unit or tally.unit) or not _RATES_HZ[0] < rate < _RATES_HZ[1]):
        stated = f"100 Hz to 1 GHz of events, timestamps in {stream.unit or 's, us or ns'}"
        found = f"{rate:.3g} Hz with timestamps in {tally.unit}"
        findings.append(Finding("warning", "unit of time", found, stated))
    ok = Finding("ok", "events", "in order, within the sensor, two polarities")
    return Checked((fact,), tuple(findings) or (ok,))


def _beside(folder: Path) -> list[Checked]:
    """Timestamps of frames, and true poses."""
    parts = []
    if (folder / "images.txt").is_file():
        parts.append(stamps_of(folder / "images.txt", gaps="warning"))
    for file in (folder / "groundtruth.txt", folder / "poses.txt"):
        if file.is_file():
            checked = check_trajectory(file)[1]
            facts = tuple(fact._replace(name=f"ground truth {fact.name}") for fact in checked.facts)
            parts.append(checked._replace(facts=facts))
    return parts


def _recording(recording: EventRecording, form: event_registry.Format) -> Checked:
    """What the loader has to tell, and the views of EventNeRF, which are no trajectory file."""
    if form != "eventnerf":
        return Checked(notes=recording.notes)
    held_out = 0 if recording.held_out is None else len(recording.held_out.t)
    text = f"{len(recording.t)} in {recording.t[-1]:.4g} s, and {held_out} held out"
    fact = Fact("views", text, {"count": len(recording.t), "held_out": held_out})
    return join([Checked((fact,), (), recording.notes), check_poses(recording.t, recording.T_world_cam)])

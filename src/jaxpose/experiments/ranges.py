"""The range of every numeric option of every command.

A number that `RANGES` does not name is finite, at least 0 and at most 1e9. What is named here by its last
word holds wherever that word is an option; a whole path goes first.
"""

import dataclasses
import math
from typing import Any, NamedTuple

from jaxpose.experiments.checks import option_name


class Range(NamedTuple):
    """What a number may be."""

    least: float = 0.0
    most: float = 1e9
    above: bool = False  # whether it is above `least`


_COUNT, _POSITIVE, _SHARE = Range(1), Range(above=True), Range(0, 1)
_RATE_HZ = Range(0, 1e6, True)
_CLOCK_S = Range(-1e9, 1e9)  # [s] between two clocks
_LEARNING_RATE, _RELATIVE = Range(0, 10, True), Range(0, 1e3, True)
_PIXELS = Range(8, 32768)  # along one side of an image

RANGES = {
    **dict.fromkeys(("rate_hz", "recorded_hz", "imu_rate_hz", "bspline_hz"), _RATE_HZ),
    **dict.fromkeys(("imu_offset_s", "time_offset_s"), _CLOCK_S),
    **dict.fromkeys(("learning_rate", "first_rate", "rotation_rate"), _LEARNING_RATE),
    **dict.fromkeys(
        ("iterations", "first_iterations", "field_steps", "patience", "window", "every", "known", "motions"),
        _COUNT,
    ),
    **dict.fromkeys(("rpe_frames", "rays", "events", "points", "steps"), _COUNT),
    **dict.fromkeys(
        ("rpe_seconds", "rpe_metres", "threshold", "spline_smoothing", "position_sigma"), _POSITIVE
    ),
    **dict.fromkeys(("octaves", "posenet_octaves"), Range(0, 32)),
    **dict.fromkeys(("layers", "posenet_layers"), Range(1, 64)),
    **dict.fromkeys(("width", "posenet_width"), Range(1, 32768)),
    **dict.fromkeys(("sample.band", "sample.width"), Range(0, 100, True)),
    **dict.fromkeys(("front", "surface", "behind"), Range(0, 10_000)),
    **dict.fromkeys(("minimum_valid", "keyframe_overlap", "net.window"), _SHARE),
    **dict.fromkeys(("room.width", "room.height", "image_width"), _PIXELS),
    **dict.fromkeys(("track.pixels", "map.pixels"), Range(1, 1e8)),
    **dict.fromkeys(
        ("gyro_density", "accelerometer_density", "gyro_walk", "accelerometer_walk"), Range(0, 1e3)
    ),
    "map_every_s": _POSITIVE,
    "line_delay_us": Range(-1e6, 1e6),  # below 0: read from the last row to the first
    "wait_s": _POSITIVE,
    "voxel": Range(0, 100, True),
    "map_budget_gb": Range(0, 4, True),
    "seed": Range(0, 2**32 - 1),
    "edge": Range(0, 32768),
    "gain": _RELATIVE,
    "decay": Range(0, 1, True),
    "translation_scale": _POSITIVE,
    "colour_weight": Range(0, 1e6),
    "dof_weight": Range(0, 1e6),
    **dict.fromkeys(("recovery", "loop"), _RELATIVE),  # all within them
    "room.duration_s": Range(0, 1e6, True),
    "room.speed": Range(0, 100, True),
    "room.depth_noise": Range(0, 1e3),
    "room.gravity_world": Range(-100, 100),
    "noise_translation": Range(0, 1e6),
    "noise_sigma": Range(0, 1e3),
    "noise_rotation_deg": Range(0, 180),
    "rotation_sigma_deg": Range(0, 180, True),
    "axis_offset_deg": Range(0, 45),
    "port": Range(0, 65535),
    "frustums": Range(0, 100_000),
}


def check_ranges(config: Any, within: str = "") -> None:
    """Refuse numbers out of their range, NaN and infinity; None is free.

    Args:
        config: a dataclass or NamedTuple of options, others nested in it.
        within: where it is nested, "slam.track.".

    Raises:
        ValueError: for the first that is out of its range.
    """
    fields = dataclasses.fields(config) if dataclasses.is_dataclass(config) else ()
    for name in [field.name for field in fields] or getattr(config, "_fields", ()):
        value, path = getattr(config, name), f"{within}{name}"
        if dataclasses.is_dataclass(value) or hasattr(value, "_fields"):
            check_ranges(value, f"{path}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                _check(path, number)


def range_of(path: str) -> Range:
    """The range of an option.

    Args:
        path: names of the fields, "slam.track.pixels".

    Returns:
        What it may be.
    """
    words = path.removeprefix("slam.").split(".")
    for key in (".".join(words), ".".join(words[-2:]), words[-1], words[0]):
        if key in RANGES:
            return RANGES[key]
    return Range()


def _check(path: str, number: int | float) -> None:
    least, most, above = range_of(path)
    if math.isfinite(number) and least <= number <= most and not (above and number == least):
        return
    wanted = f"above {least:g} and at most {most:g}" if above else f"from {least:.10g} to {most:.10g}"
    raise ValueError(f"{option_name(path)}: expected a number {wanted}, got {str(number)[:40]}")

"""Every numeric option of every command refuses what is no number, and numbers that mean nothing."""

import math
import re
from dataclasses import replace

import pytest
from helpers.refused import complaint

from jaxpose.cli.main import SUBCOMMANDS, main
from jaxpose.experiments import command as command_module
from jaxpose.experiments.command import Command, parse
from jaxpose.experiments.option_help import Option, options
from jaxpose.experiments.ranges import check_ranges, range_of

SIGNED = {"imu_offset_s", "time_offset_s", "room.gravity_world", "slam.line_delay_us", "line_delay_us"}
# Numbers of which none, or 0, is a choice.
ZERO_IS_ONE = SIGNED | {
    "start", "slam.seed", "room.seed", "seed", "slam.field.octaves", "net.octaves", "posenet_octaves",
    "net.window", "slam.track.edge", "slam.map.edge", "slam.track.colour_weight", "slam.track.dof_weight",
    "slam.track.minimum_valid", "slam.track.sample.front", "slam.track.sample.behind",
    "slam.map.sample.front", "slam.map.sample.behind", "slam.hold_out", "slam.keyframe_overlap",
    "room.line_delay_us", "exposure_ms",
    "room.depth_noise", "noise_translation", "noise_rotation_deg", "noise_sigma", "test_pose_steps",
    "axis_offset_deg", "max_difference_s", "port", "frustums", "devices.process",
    *(f"{of}.imu_noise.{name}" for of in ("slam", "room") for name in
      ("gyro_density", "accelerometer_density", "gyro_walk", "accelerometer_walk")),
}  # fmt: skip
POSITIONAL = {
    "fit": ["t.txt"],
    "eval": ["a.txt", "b.txt"],
    "export": ["run", "--format", "tum", "--out", "o.txt"],
    "view": ["run"],
    "convert": ["data", "--to", "plain", "--out", "o"],
}
_COMMANDS: dict[str, Command] = {}


def asked(name: str) -> Command:
    """What a subcommand hands to `parse`."""
    if name not in _COMMANDS:
        with pytest.MonkeyPatch.context() as patch:

            def keep(command, args):
                _COMMANDS[name] = command
                raise SystemExit(0)

            patch.setattr(command_module, "parse", keep)
            with pytest.raises(SystemExit):
                main([name])
    return _COMMANDS[name]


def numeric(name: str) -> list[Option]:
    """The options of a subcommand that take numbers."""
    command = asked(name)
    return [o for o in options(command.config, command.hidden) if re.search("INT|FLOAT", o.values)]


def config_of(name: str):
    """The defaults of a subcommand."""
    return parse(asked(name), POSITIONAL.get(name, []))


def replaced(config, path: str, value):
    """The config with another value at a path of fields."""
    own, _, rest = path.partition(".")
    value = replaced(getattr(config, own), rest, value) if rest else value
    return config._replace(**{own: value}) if hasattr(config, "_fields") else replace(config, **{own: value})


def refused(config, option: Option, value: float) -> str:
    """What is said of a value; empty where it is taken."""
    count = 1 if "..." in option.values else option.values.count("FLOAT")
    several = "..." in option.values or count > 1
    value = float(value) if "FLOAT" in option.values else value
    try:
        check_ranges(replaced(config, option.path, (value,) * count if several else value))
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", [name for name in SUBCOMMANDS if name != "check"])
def test_bad_numbers_are_refused(name):
    taken, config = [], config_of(name)
    assert numeric(name)
    for option in numeric(name):
        bad = [math.nan, math.inf, -math.inf, 1e30] if "FLOAT" in option.values else [10**30]
        bad += [] if option.path in SIGNED else [-1]
        bad += [] if option.path in ZERO_IS_ONE else [0]
        taken += [f"{option.flag} {value}" for value in bad if not refused(config, option, value)]
    assert taken == []


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["slam", "--seed", "-1"], "jaxpose slam: --seed: expected a number from 0 to 4294967295, got -1"),
        (
            ["slam", "--imu-noise.gyro-walk", "nan"],
            "--imu-noise.gyro-walk: expected a number from 0",
        ),
        (
            ["export", "run", "--format", "tum", "--out", "o", "--rate-hz", "1e9"],
            "--rate-hz: expected a number above 0 and at most 1e+06",
        ),
        (["nerf", "--net.layers", "0"], "jaxpose nerf: --net.layers: expected a number from 1 to 64, got 0"),
        (["planar", "--points", "9" * 5000], "jaxpose planar: "),
    ],
)
def test_a_command_says_it_in_one_line(args, message):
    assert message in complaint(main, *args)


def test_the_defaults_are_in_their_ranges():
    for name in SUBCOMMANDS:
        for option in numeric(name):
            least, most, above = range_of(option.path)
            for word in (option.default or "").split():
                assert least <= float(word) <= most and not (above and float(word) == least), option


def test_a_whole_path_goes_before_a_word():
    assert range_of("room.width").least == 8 and range_of("slam.field.width").least == 1
    assert range_of("slam.recovery.held").above and range_of("no.such.option") == (0, 1e9, False)

"""The command `jaxpose`: it loads what it is asked for, its help is whole, a wrong call costs one line."""

import importlib
import json
import re
import subprocess
import sys

import numpy as np
import pytest
from helpers.refused import complaint
from PIL import Image

from jaxpose.cli.main import SUBCOMMANDS, main
from jaxpose.experiments import command as command_module
from jaxpose.experiments.command import Command
from jaxpose.experiments.option_help import options
from jaxpose.files import trajectories

EXPERIMENTS = ("slam", "nerf", "events", "planar")


def asked(name: str, monkeypatch) -> Command:
    """What a subcommand hands to `parse`."""
    found = []

    def parse(command, args):
        found.append(command)
        raise SystemExit(0)

    monkeypatch.setattr(command_module, "parse", parse)
    with pytest.raises(SystemExit):
        main([name])
    return found[0]


# --- help -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_what_needs_nothing_loads_nothing(option):
    code = (
        f"import sys\nfrom jaxpose.cli.main import main\nmain(['{option}'])\n"
        "print(sorted({name.split('.')[0] for name in sys.modules} & {'jax', 'numpy', 'tyro', 'scipy'}))\n"
        "import time; print(time.process_time())"  # of the processor, however busy the machine is
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *_, loaded, seconds = said.stdout.splitlines()
    assert loaded == "[]" and said.stderr == "" and float(seconds) < 0.5
    if option == "--help":
        assert all(f"\n  {name} " in said.stdout for name in SUBCOMMANDS)
    else:
        assert re.match(r"jaxpose \d+\.\d+\.\d+\n", said.stdout)


def test_a_subcommand_loads_no_other(tmp_path):
    code = (
        "import sys\nfrom jaxpose.cli.main import main\n"
        "try: main(['export', '--help'])\nexcept SystemExit: pass\n"
        "print([name for name in sys.modules if name.startswith('jaxpose.cli.') or name == 'jax'])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.splitlines()[-1] == "['jaxpose.cli.main', 'jaxpose.cli.source', 'jaxpose.cli.export']"


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_every_option_has_a_text_of_its_own(name, monkeypatch):
    command = asked(name, monkeypatch)
    found = options(command.config, command.hidden)
    texts = {option.path: option.text for option in found}
    assert {path for path, text in texts.items() if len(text) < 8} == set()
    of_its_own = [text for path, text in texts.items() if "noise" not in path and "sample" not in path]
    assert len(set(of_its_own)) > len(of_its_own) - 6  # nested settings of one kind share theirs
    own = [text for path, text in texts.items() if "." not in path]
    assert len(set(own)) == len(own)


@pytest.mark.parametrize("name", SUBCOMMANDS)
def test_the_first_screen_is_short_and_help_all_is_whole(name, monkeypatch, capsys):
    command = asked(name, monkeypatch)
    monkeypatch.undo()
    monkeypatch.setenv("COLUMNS", "110")
    screens = []
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as stop:
            main([name, option])
        assert not stop.value.code
        said = capsys.readouterr()
        screens.append(said.out)
        assert said.out.startswith(f"usage: jaxpose {name} ")
    flags = [option.flag for option in options(command.config, command.hidden)]
    assert all(re.search(rf"^  {re.escape(flag)}( |$)", screens[1], re.MULTILINE) for flag in flags)
    shown = re.findall(r"^  (--[\w.-]+)", screens[0], re.MULTILINE)
    assert len(shown) <= 15 and set(shown) <= set(flags)
    if command.groups:
        assert f"{len(flags) - len(shown)} more options: jaxpose {name} --help-all" in screens[0]
        assert {"--out", "--name", "--resume", "--smoke", "--json", "--seed"} <= set(shown)


def test_one_option_means_one_thing(monkeypatch):
    """Of all commands that have it."""
    kinds = {}
    for name in SUBCOMMANDS:
        command = asked(name, monkeypatch)
        for option in options(command.config, command.hidden):
            if option.flag in ("--out", "--name", "--seed", "--resume", "--smoke", "--json", "--recorded-hz"):
                kinds.setdefault(option.flag, set()).add(option.values)
    assert all(len(values) == 1 for values in kinds.values()), kinds
    assert set(kinds) == {"--out", "--name", "--seed", "--resume", "--smoke", "--json", "--recorded-hz"}


def test_every_subcommand_is_there():
    for found in SUBCOMMANDS.values():
        assert callable(importlib.import_module(found.module).main)


def test_a_reader_may_go_before_the_end():
    command = [sys.executable, "-m", "jaxpose", "planar", "--help"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    said = [line for line in process.stderr.read().splitlines() if not line.startswith("  loading")]
    assert process.wait() == 0 and said == []


# --- bad input ------------------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder to be in, with files of the wrong kinds and good ones."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.txt").write_text("no numbers\n")
    t = np.arange(0, 4, 0.1)
    trajectories.write_tum("good.txt", trajectories.Trajectory(t, np.tile(np.eye(4), (40, 1, 1))))
    Image.new("RGB", (64, 48)).save("image.png")
    np.savez("other.npz", a=np.zeros(3))
    return tmp_path


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        # a folder or file that is not there
        ("slam --data none", "none: expected a recording"),
        ("nerf --data none", "none: expected a folder of photographs"),
        ("events --data none", "none: expected a recording of events"),
        ("planar --image none.png", "none.png"),
        ("check none", "none: expected an RGB-D recording"),
        ("fit none", "none: expected a trajectory file or a run folder, got nothing"),
        ("eval none good.txt", "none: expected a trajectory file or a run folder, got nothing"),
        ("export none --format tum --out x", "none: expected a trajectory file"),
        ("view none", "none: expected a trajectory file"),
        # of the wrong kind
        ("slam --data empty", "empty: expected a recording"),
        ("slam --data text.txt", "text.txt: expected a recording"),
        ("nerf --data empty", "empty: expected photographs, with poses_bounds.npy"),
        ("events --data other.npz", "other.npz"),
        ("planar --image text.txt", "text.txt: expected an image"),
        ("check text.txt", "text.txt"),
        ("fit text.txt", "text.txt"),
        ("eval text.txt good.txt", "text.txt"),
        ("export text.txt --format tum --out x", "text.txt"),
        ("export good.txt --format colmap --out x", "expected a run folder for --format colmap"),
        ("view empty", "expected a run folder with trajectory.txt"),
        # numbers that mean nothing
        ("slam --rate-hz nan", "--rate-hz: expected a positive number, got nan"),
        ("slam --data empty --recorded-hz -3", "--recorded-hz: expected a positive number, got -3"),
        ("slam --imu-offset-s inf", "--imu-offset-s: expected a finite number, got inf"),
        ("slam --voxel -1", "voxel: expected a positive number, got -1"),
        ("nerf --noise-translation nan", "--noise-translation: expected at least 0, got nan"),
        ("nerf --seed -1", "--seed: expected at least 0, got -1"),
        ("events --threshold nan", "--threshold: expected a positive number, got nan"),
        ("events --axis-offset-deg -2", "--axis-offset-deg: expected at least 0, got -2"),
        ("planar --motions 0", "--motions: expected at least 1, got 0"),
        ("planar --seed -1", "--seed: expected at least 0, got -1"),
        ("fit good.txt --bspline-hz nan", "--bspline-hz: expected a positive number, got nan"),
        ("fit good.txt --steps 0", "--steps: expected at least 1, got 0"),
        ("eval good.txt good.txt --time-offset-s nan", "--time-offset-s: expected a finite number, got nan"),
        ("eval good.txt good.txt --max-difference-s -1", "--max-difference-s: expected at least 0, got -1"),
        (
            "export good.txt --format tum --out x --rate-hz -1",
            "--rate-hz: expected a positive number, got -1",
        ),
        ("view good.txt --frustums -1", "--frustums: expected at least 0, got -1"),
        # output in the place of the input
        ("slam --data empty --out empty", "--out: expected another place than the input"),
        ("nerf --data empty --out ./empty", "--out: expected another place than the input"),
        ("events --data empty --out empty", "--out: expected another place than the input"),
        ("planar --image image.png --out image.png", "--out: expected another place than the input"),
        ("fit good.txt --out good.txt", "--out: expected another place than the input"),
        ("export good.txt --format tum --out good.txt", "--out: expected another place than the input"),
        # names of the run folder
        ("slam --out x --name y", "--name: expected no --out with it"),
        ("planar --name ../x", "--name: expected the name of one folder"),
        ("slam --resume", "--resume: expected --out DIR or --name NAME"),
        # options that are none
        ("slam --sed 3", "Unrecognized options: --sed, 3; Perhaps you meant: --seed$"),
        ("nerf --stepps 3", "--steps"),
        ("events --treshold 3", "--threshold"),
        ("planar --motion 3", "--motions"),
        ("check good.txt --jsn", "--json"),
        ("fit good.txt --step 3", "--steps"),
        ("eval good.txt good.txt --aling se3", "--align"),
        ("export good.txt --form tum --out x", "--format"),
        ("view good.txt --prt 3", "--port"),
        # commands that are none
        ("slamm", "expected one of slam, nerf, .* got slamm; did you mean slam?"),
        ("", "expected one of slam, nerf, .* got nothing"),
    ],
)
def test_bad_input_is_one_line(files, args, expected):
    before = sorted(files.rglob("*"))
    line = complaint(main, *args.split())
    assert line.startswith("jaxpose"), line
    assert re.search(expected.replace("?", r"\?"), line), line
    assert sorted(files.rglob("*")) == before, "nothing is made, nothing is taken away"


def test_results_of_another_program_stay(files):
    """A folder that holds no run is not written over."""
    (files / "mine").mkdir()
    (files / "mine" / "results.json").write_text("{}")
    line = complaint(main, "planar", "--image", "image.png", "--smoke", "--out", "mine", "--motions", "1")
    assert "mine/results.json: expected a new folder or that of a run, got a file of no run" in line
    assert (files / "mine" / "results.json").read_text() == "{}"
    assert [path.name for path in (files / "mine").iterdir()] == ["results.json"]


@pytest.mark.slow
def test_json_is_all_that_an_experiment_prints(files, capsys):
    main(["planar", "--image", "image.png", "--smoke", "--motions", "1", "--out", "run", "--json"])
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert told["folder"] == "run"
    assert told["results"] == json.loads((files / "run" / "results.json").read_text())
    own = [line for line in said.err.splitlines() if not line.startswith("  loading")]
    assert own[0] == "  run folder run"

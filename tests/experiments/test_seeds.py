"""Trainings with many seeds: what is started, one table with failures in it, an interruption, a cluster."""

import json
import subprocess
import sys
import time

import pytest
from helpers import refused

from jaxpose.experiments import many_runs, seeds
from jaxpose.experiments.seeds import Config

# In place of `python -m jaxpose nerf OPTIONS --seed K --out DIR`: writes what it was asked for, or fails.
FAKE = """
import json, pathlib, sys
words = dict(zip(sys.argv[2::2], sys.argv[3::2]))
seed, out = int(words["--seed"]), pathlib.Path(words["--out"])
if seed == 2: sys.exit("nerf: no camera")
out.mkdir(parents=True, exist_ok=True)
found = {"rotation_error_deg": 0.5 + seed, "translation_error_percent": 2.0, "psnr": None, "train_s": 7.0}
(out / "results.json").write_text(json.dumps(found | {"words": sys.argv[1:]}))
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Runs are the script above."""
    script = tmp_path / "fake.py"
    script.write_text(FAKE)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nshift 2\nexec "{sys.executable}" "{script}" "$@"\n')
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    return tmp_path / "study"


def test_one_table_of_all_seeds_with_failures(fake):
    config = Config(commands=("", "--noise-translation 0.3"), seeds=3, processes=2, out=fake)
    outcome = seeds.run(config)
    default, other = outcome.results["rows"]
    assert default["registered"] == [0] and default["failures"] == {2: "nerf: no camera"}
    assert default["rotation_error_deg"] == {"median": 1.0, "min": 0.5, "max": 1.5}
    cells = [cell.strip() for cell in seeds.table([default]).splitlines()[2].strip("|").split("|")]
    assert cells == ["(defaults)", "1 of 3, 1 failed", "1.000 (0.500 to 1.500)", "2.000", "n/a", "7"]
    assert other["options"] == "--noise-translation 0.3"
    started = json.loads((fake / "runs" / "1-1" / "results.json").read_text())["words"]
    assert started[:5] == ["nerf", "--noise-translation", "0.3", "--seed", "1"]
    assert "failed        seed 2: nerf: no camera" in seeds.report(outcome)
    assert json.loads((fake / "results.json").read_text())["rows"][0]["registered"] == [0]


def test_resuming_resumes_each_run_that_has_begun(fake):
    seeds.run(Config(seeds=1, out=fake))
    seeds.run(Config(seeds=2, out=fake, resume=True))
    words = [json.loads((fake / "runs" / f"0-{k}" / "results.json").read_text())["words"] for k in (0, 1)]
    assert ["--resume" in each for each in words] == [True, False]


def test_an_interrupted_study_leaves_no_run_behind(tmp_path, monkeypatch):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nexec sleep 600\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    started = []

    def interrupt(futures):
        while len(many_runs._RUNNING) < 2:
            time.sleep(0.01)
        started.extend(many_runs._RUNNING)
        raise KeyboardInterrupt

    monkeypatch.setattr(many_runs, "as_completed", interrupt)
    with pytest.raises(KeyboardInterrupt):
        seeds.run(Config(seeds=4, processes=2, out=tmp_path / "study"))
    assert len(started) == 2 and all(process.wait(10) != 0 for process in started)
    assert not many_runs._RUNNING


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--seeds", "0"], "--seeds: expected at least 1, got 0"),
        (["--commands=--seed 3"], "--commands: expected no --seed, it is set here, got '--seed 3'"),
        (["--commands=--pose 'x"], '--commands: expected options, got "--pose \'x": No closing quotation'),
        (["--commands", "", ""], "--commands: expected at least one, each once, got ('', '')"),
        (["--resume"], "--resume: expected --out DIR or --name NAME with it"),
        (["--scheduler", "nowhere"], "--scheduler: expected one at nowhere, got "),
    ],
)
def test_bad_options_are_one_line(args, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(many_runs, "_CONNECT_S", 0.2)
    assert expected in refused.complaint(seeds.main, *args)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_workers_of_a_cluster_make_the_same_table(fake):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster:
        config = Config(seeds=3, scheduler=cluster.scheduler_address, out=fake)
        (row,) = seeds.run(config).results["rows"]
    assert row["registered"] == [0] and row["failures"] == {2: "nerf: no camera"}


@pytest.mark.slow
def test_a_study_of_two_seeds(tmp_path):
    command = [sys.executable, "-m", "jaxpose.experiments.seeds", "--smoke", "--seeds", "2"]
    command += ["--commands=--test-pose-steps 0", "--out", str(tmp_path / "study")]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    (row,) = json.loads((tmp_path / "study" / "results.json").read_text())["rows"]
    run = json.loads((tmp_path / "study" / "runs" / "0-1" / "results.json").read_text())
    assert run["seed"] == 1 and run["rotation_error_deg"] in row["rotation_error_deg"].values()
    assert (tmp_path / "study" / "table.md").read_text().strip() in ended.stdout

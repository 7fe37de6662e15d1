"""A run that is killed goes on where it was; what is damaged or of another run is refused."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

from jaxpose.datasets.types import select
from jaxpose.errors import DataError
from jaxpose.experiments import rgbd_slam
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.files import trajectories
from jaxpose.slam import MapConfig, SlamConfig, TrackingStatus, checkpoint, run

KILLED = """
import os, signal, sys
import jax
jax.config.update("jax_disable_most_optimizations", True)
from pathlib import Path
from jaxpose.experiments import rgbd_slam
from jaxpose.experiments.slam import checkpointing
checkpointing.SAVE_EVERY_S = 0.0
def on_update(update):
    if len(sys.argv) > 2 and update.done == 5:
        os.kill(os.getpid(), signal.SIGKILL)
config = rgbd_slam.Config(smoke=True, out=Path(sys.argv[1]), resume=True)
rgbd_slam.run(config, on_update)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_and_ends_as_if_nothing_had_been(tmp_path):
    def run(folder, *kill):
        return subprocess.run([sys.executable, "-c", KILLED, tmp_path / folder, *kill]).returncode

    assert run("killed", "kill") == -signal.SIGKILL
    left = {path.name for path in (tmp_path / "killed").iterdir()}
    assert {"checkpoint.npz", "settings.json", "preview.png"} <= left and "results.json" not in left
    with np.load(tmp_path / "killed" / "checkpoint.npz") as file:
        assert len(file["['state'].frames.t"]) in (4, 5)
    assert run("killed") == 0 and run("whole") == 0
    killed, whole = (
        trajectories.read_tum(tmp_path / name / "trajectory.txt") for name in ("killed", "whole")
    )
    np.testing.assert_allclose(killed.T, whole.T, atol=1e-6)
    numbers = [json.loads((tmp_path / name / "results.json").read_text()) for name in ("killed", "whole")]
    assert numbers[0]["ate_rmse_m"] == pytest.approx(numbers[1]["ate_rmse_m"], abs=1e-6)
    assert numbers[0]["keyframes"] == numbers[1]["keyframes"]
    assert not (tmp_path / "killed" / "checkpoint.npz").exists()
    before = (tmp_path / "killed" / "results.json").stat().st_mtime_ns
    assert run("killed") == 0  # finished: nothing is done again
    assert (tmp_path / "killed" / "results.json").stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fused", "gradient"])
def test_a_checkpoint_holds_the_whole_state(method, tmp_path):
    options = rgbd_slam.Config(smoke=True, slam=SlamConfig(voxel=0.2, map=MapConfig(method=method)))
    recording, config = load(options).recording, slam_config(options)
    states = []
    run(select(recording, np.arange(3)), config, on_frame=lambda progress: states.append(progress.state))
    state = states[-1]._replace(duration_s=recording.t[-1] - recording.t[0], max_depth=2.5)
    state = state._replace(frames=state.frames.put(2, status=TrackingStatus.LOST, loss=0.7, sigma=[0.1, 0.2]))
    checkpoint.save(tmp_path / "c.npz", state)
    found = checkpoint.load(tmp_path / "c.npz", recording, config)
    assert (found.max_depth, found.grid) == (2.5, state.grid)
    for name, value in state.frames._asdict().items():
        np.testing.assert_array_equal(getattr(found.frames, name), value, err_msg=name)
    np.testing.assert_array_equal(found.map.params[0], state.map.params[0])
    np.testing.assert_array_equal(found.thumbnails, state.thumbnails)
    with pytest.raises(DataError, match="c.npz: expected a run over frames at the times of"):
        checkpoint.load(tmp_path / "c.npz", recording._replace(t=recording.t + 0.1), config)
    with np.load(tmp_path / "c.npz") as file:
        older = {name: value for name, value in file.items() if "version" not in name}
    np.savez(tmp_path / "c.npz", **older)
    with pytest.raises(DataError, match=r"c.npz: expected a checkpoint of version 2, got none"):
        checkpoint.load(tmp_path / "c.npz", recording, config)
    (tmp_path / "c.npz").write_bytes(b"PK\3\4 not a checkpoint")
    with pytest.raises(DataError, match="c.npz: expected a checkpoint"):
        checkpoint.load(tmp_path / "c.npz", recording, config)


def test_other_settings_are_not_resumed(tmp_path):
    (tmp_path / "settings.json").write_text(json.dumps({"seed": 3}))
    with pytest.raises(DataError, match="expected --"):
        rgbd_slam.run(rgbd_slam.Config(smoke=True, out=tmp_path, resume=True))

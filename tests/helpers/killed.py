"""What a training makes of SIGKILL."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


def whole_and_killed(experiment: str, args: str, steps: int, out: Path) -> tuple[dict, dict]:
    """Results of a training left alone, and of one killed in the middle of its steps and resumed."""
    code = (
        f"from jaxpose.experiments import training_loop\n"
        f"from jaxpose.experiments.{experiment} import pipeline\n"
        "training_loop._SAVE_EVERY_S = 0; pipeline.main()"
    )
    command = [sys.executable, "-c", code, *args.split(), "--steps", str(steps)]
    start = lambda name: subprocess.Popen([*command, "--out", out / name, "--resume"])
    assert start("whole").wait() == 0
    process, checkpoint = start("killed"), out / "killed" / "checkpoint.npz"
    while not checkpoint.exists():
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    with np.load(checkpoint) as file:
        assert file[".state.step"] < steps
    assert start("killed").wait() == 0
    whole, killed = (json.loads((out / name / "results.json").read_text()) for name in ("whole", "killed"))
    return whole, killed

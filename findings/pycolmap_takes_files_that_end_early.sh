#!/usr/bin/env bash
# pycolmap 4.2.1: a points3D.bin that ends early never comes back, a cameras.bin that ends early is taken for whole.
#
# Guess: a file that is cut off (a full disk, a broken copy) is refused. Seen, with a scene by pycolmap's own generator: of
# cameras.bin without its last 4 bytes Reconstruction gives a camera and no error; of an empty points3D.bin it has not
# returned after 20 seconds. Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "pycolmap==4.2.1"
cd "$folder"
"$folder/env/bin/python" - <<'PYTHON'
import pathlib
import shutil
import subprocess
import sys

import pycolmap

options = pycolmap.SyntheticDatasetOptions()
options.num_points3D, options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 50, 1, 1, 4
pathlib.Path("whole").mkdir()
pycolmap.synthesize_dataset(options).write_binary("whole")
READ = 'import pycolmap; print(pycolmap.Reconstruction("cut").num_cameras(), "camera")'


def of(name, length):
    shutil.rmtree("cut", ignore_errors=True)
    shutil.copytree("whole", "cut")
    file = pathlib.Path("cut", name)
    file.write_bytes(file.read_bytes()[:length])
    try:
        done = subprocess.run([sys.executable, "-c", READ], capture_output=True, text=True, timeout=20)
    except subprocess.TimeoutExpired:
        return "not back after 20 s"
    return done.stdout.strip() if done.returncode == 0 else "refused"


cameras, points = of("cameras.bin", -4), of("points3D.bin", 0)
print(f"pycolmap {pycolmap.__version__}, cameras.bin without 4 bytes: {cameras}; points3D.bin empty: {points}")
sys.exit(cameras != "1 camera" or points != "not back after 20 s")
PYTHON

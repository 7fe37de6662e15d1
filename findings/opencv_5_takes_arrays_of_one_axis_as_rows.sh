#!/usr/bin/env bash
# OpenCV 5.0.0: a numpy array of one axis is a row of n columns; up to 4.14 it was a column of n rows.
#
# Guess: as in 4.x, `cv2.remap` with maps of shape (n,) returns (n, 1, channels), so that `[:, 0]` are the n colours, and the right side of
# `cv2.solve` may be of one axis. Seen, 4.14.0 against 5.0.0: remap (7, 1, 3) against (1, 7, 3), of which `[:, 0]` is one colour, and numpy
# broadcasts it to all seven places without a word; `cv2.solve` (3, 1) against an error. Maps of shape (n, 1) and (1, n) give the same in
# both, and so do points of shape (n, 2).
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/shapes.py" <<'PYTHON'
import sys

import cv2
import numpy as np

row = cv2.__version__.startswith("5.")
assert cv2.__version__ == sys.argv[1], cv2.__version__
ramp = np.tile(np.arange(60, dtype=np.float32)[None, :, None], (50, 1, 3))
x = np.linspace(1, 40, 7, dtype=np.float32)
seen = cv2.remap(ramp, x, x, cv2.INTER_LINEAR)
colours = np.zeros((7, 3), np.float32)
colours[:] = seen[:, 0]
print(f"OpenCV {cv2.__version__}: remap {seen.shape}, first and last of [:, 0]: {colours[0, 0]:g}, {colours[-1, 0]:g}")
assert seen.shape == ((1, 7, 3) if row else (7, 1, 3)), seen.shape
assert (colours[0, 0], colours[-1, 0]) == ((1, 1) if row else (1, 40)), colours
assert cv2.remap(ramp, x[:, None], x[:, None], cv2.INTER_LINEAR).shape == (7, 1, 3)
assert cv2.remap(ramp, x[None], x[None], cv2.INTER_LINEAR).shape == (1, 7, 3)
assert cv2.undistortPoints(np.zeros((7, 2), np.float32), np.eye(3), None).shape == (7, 1, 2)
try:
    print(f"  solve: {cv2.solve(np.eye(3), np.ones(3))[1].shape}")
    assert not row
except cv2.error as error:
    print(f"  solve: {str(error).splitlines()[0][:60]}")
    assert row, error
PYTHON
for package in 4.14.0.94 5.0.0.93; do
  "${PYTHON:-python3}" -m venv "$folder/$package"
  "$folder/$package/bin/pip" install --quiet "opencv-python-headless==$package" "numpy>=2,<3"
  "$folder/$package/bin/python" "$folder/shapes.py" "${package%.*}"
done

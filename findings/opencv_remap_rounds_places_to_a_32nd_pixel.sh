#!/usr/bin/env bash
# OpenCV 4.14.0: remap and warpAffine look up colours at places rounded to 1/32 px, in float images too; 5.0.0 does so for float64 images alone.
#
# Guess: with a float image and float maps, INTER_LINEAR interpolates at the places asked for. Seen, of a ramp that has its own column as its
# value, at 101 places between two columns: 33 different values, up to 1/64 px off; a warpAffine by 0.01 px moves nothing. So an alignment by
# warped images has a slope of zero between steps, and cannot be finer. 5.0.0 is exact for float32, and rounds as before where the image is float64.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/ramp.py" <<'PYTHON'
import sys

import cv2
import numpy as np

assert cv2.__version__ == sys.argv[1], cv2.__version__
exact_float32 = cv2.__version__.startswith("5.")
ramp = np.tile(np.arange(64, dtype=np.float32), (8, 1))
x = np.linspace(10, 11, 101, dtype=np.float32)[None]
by = np.array([[1, 0, 0.01], [0, 1, 0.0]])
for kind in (np.float32, np.float64):
    seen = cv2.remap(ramp.astype(kind), x, np.full_like(x, 3), cv2.INTER_LINEAR)
    moved = cv2.warpAffine(ramp.astype(kind), by, (64, 8), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)[3, 20] - 20
    off, count = np.abs(seen - x).max(), len(np.unique(seen))
    print(f"OpenCV {cv2.__version__}, {kind.__name__}: {count} values at 101 places, {off:.4f} px off at most; 0.01 px is {moved:.3f}")
    exact = exact_float32 and kind is np.float32
    assert count == (101 if exact else 33), count
    assert off < 1e-5 if exact else 0.01 < off < 1 / 64 + 1e-5, off
    assert abs(moved - (0.01 if exact else 0)) < 1e-5, moved
PYTHON
for package in 4.14.0.94 5.0.0.93; do
  "${PYTHON:-python3}" -m venv "$folder/$package"
  "$folder/$package/bin/pip" install --quiet "opencv-python-headless==$package" "numpy>=2,<3"
  "$folder/$package/bin/python" "$folder/ramp.py" "${package%.*}"
done

#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: cv2.undistortPoints stops after five steps, a third of a pixel away in the corners of a common lens.
#
# Guess: what undistortPoints returns is projected back to the pixel that it was given, by projectPoints with the same lens. Seen, for a lens
# of 752 x 480 px, focal length 458, k1 -0.28, k2 0.07 (such as visual-inertial cameras have): 0.36 px off in the corners; with k1 -0.38, k2 0.17,
# k3 -0.03: 1.4 px. The middle is right, so that a look at some points does not show it. `cv2.undistortPointsIter` takes a criterion (in 5.0.0
# undistortPoints itself), and with forty steps both are back to 0.001 px.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/corners.py" <<'PYTHON'
import sys
from functools import partial

import cv2
import numpy as np

assert cv2.__version__ == sys.argv[1], cv2.__version__
K = np.array([[458.0, 0, 367], [0, 457, 248], [0, 0, 1]])
pixels = np.stack(np.meshgrid(np.linspace(0, 751, 40), np.linspace(0, 479, 30)), -1).reshape(-1, 1, 2)
steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)


def off(undistorted, lens):
    rays = np.concatenate([undistorted, np.ones_like(undistorted[..., :1])], -1)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, lens)
    return np.linalg.norm(back - pixels, axis=-1)


for lens, least in (((-0.28, 0.07, 2e-4, 2e-5, 0), 0.3), ((-0.38, 0.17, 1e-3, 0, -0.03), 1.0)):
    lens = np.array(lens)
    five = off(cv2.undistortPoints(pixels, K, lens), lens)
    by_steps = (
        partial(cv2.undistortPoints, criteria=steps)
        if cv2.__version__.startswith("5.")
        else partial(cv2.undistortPointsIter, R=np.eye(3), P=np.eye(3), criteria=steps)
    )
    forty = off(by_steps(pixels, K, lens), lens)
    print(f"OpenCV {cv2.__version__}, k1 {lens[0]:g}: {np.median(five):.4f} px median, {five.max():.2f} at most; forty steps {forty.max():.5f}")
    assert np.median(five) < 0.02 and five.max() > least and forty.max() < 1e-3
PYTHON
for package in 4.14.0.94 5.0.0.93; do
  "${PYTHON:-python3}" -m venv "$folder/$package"
  "$folder/$package/bin/pip" install --quiet "opencv-python-headless==$package" "numpy>=2,<3"
  "$folder/$package/bin/python" "$folder/corners.py" "${package%.*}"
done

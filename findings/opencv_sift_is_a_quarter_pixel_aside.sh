#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: cv2.SIFT_create() puts every keypoint 0.25 px right of and below where it is, at every scale.
#
# Guess: a keypoint has its centre where the image has it, in the convention in which pixel (0, 0) has its centre at (0, 0), as everywhere
# else in OpenCV. Seen, of round blobs at known places: +0.25 px in x and in y whatever the blob's size, with a scatter of 0.02 px: a principal
# point that is wrong by ten times the noise. `enable_precise_upscale=True`, which is off by default, takes it off.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/blobs.py" <<'PYTHON'
import sys

import cv2
import numpy as np

assert cv2.__version__ == sys.argv[1], cv2.__version__
random = np.random.default_rng(0)
rows, columns = np.mgrid[:128, :128]


def aside(sigma, **options):
    sift, found = cv2.SIFT_create(contrastThreshold=0.01, **options), []
    for _ in range(30):
        x, y = 64 + random.uniform(-3, 3, 2)
        blob = 40 + 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
        keypoints = sift.detect(blob.round().astype(np.uint8))
        strongest = max(keypoints, key=lambda keypoint: keypoint.response, default=None)
        if strongest is not None:
            found.append([strongest.pt[0] - x, strongest.pt[1] - y])
    return np.mean(found, axis=0), np.std(found, axis=0).max()


print(f"OpenCV {cv2.__version__}: keypoints less the blob's centre [px]")
for sigma in (1.5, 2.5, 4.0, 6.0):
    default, scatter = aside(sigma)
    precise, _ = aside(sigma, enable_precise_upscale=True)
    print(f"  sigma {sigma}: {default.round(3)} +- {scatter:.3f}, with enable_precise_upscale {precise.round(3)}")
    assert np.abs(default - 0.25).max() < 0.02 and scatter < 0.03
    assert np.abs(precise).max() < 0.02
PYTHON
for package in 4.14.0.94 5.0.0.93; do
  "${PYTHON:-python3}" -m venv "$folder/$package"
  "$folder/$package/bin/pip" install --quiet "opencv-python-headless==$package" "numpy>=2,<3"
  "$folder/$package/bin/python" "$folder/blobs.py" "${package%.*}"
done

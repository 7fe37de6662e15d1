#!/usr/bin/env bash
# OpenCV 4.14.0 and 5.0.0: cv2.ORB returns corners of level k of its pyramid (s - 1) / 2 px left of and above where they are, s = 1.2^k.
#
# Guess: keypoints of all levels are in the coordinates of the image, so that those of an image and of the same one twice as large differ by
# the magnification alone. Seen, four levels apart: 0.8 px aside, where 5000 matches tell it to 0.01. A level is made by `resize`, whose pixels have a
# width (outer edges meet), but its corners' indices are multiplied by s, as if they had none; and a level has whole pixels, so that its true
# scale is not s. `(pt / s + 0.5) * w / round(w / s) - 0.5` is right, for a level of scale s and an image of w columns.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/levels.py" <<'PYTHON'
import sys

import cv2
import numpy as np

assert cv2.__version__ == sys.argv[1], cv2.__version__
random, small, large = np.random.default_rng(0), 320, 664
orb, matcher = cv2.ORB_create(3000, fastThreshold=5), cv2.BFMatcher(cv2.NORM_HAMMING, True)


def texture():
    blots = [cv2.GaussianBlur(random.normal(0, 1, (small, small)), (0, 0), sigma) for sigma in (1.5, 3, 6, 12)]
    return np.clip(128 + 30 * sum(each / each.std() for each in blots), 0, 255).astype(np.uint8)


def corrected(keypoint, width):
    scale = 1.2**keypoint.octave
    return (np.array(keypoint.pt) / scale + 0.5) * width / round(width / scale) - 0.5


def aside(place):
    found = []
    for a, b in pairs:
        off = place(b, large) - ((place(a, small) + 0.5) * large / small - 0.5)
        if b.octave == a.octave + 4 and np.abs(off).max() < 4:
            found.append(off)
    return np.mean(found, axis=0), np.std(found, axis=0).max() / np.sqrt(len(found)), len(found)


pairs = []
for _ in range(4):
    image = texture()
    magnified = cv2.resize(image, (large, large), interpolation=cv2.INTER_CUBIC)
    (a, of_a), (b, of_b) = (orb.detectAndCompute(each, None) for each in (image, magnified))
    pairs += [(a[match.queryIdx], b[match.trainIdx]) for match in matcher.match(of_a, of_b)]
stated, right = aside(lambda keypoint, _: np.array(keypoint.pt)), aside(corrected)
print(f"OpenCV {cv2.__version__}, {stated[2]} matches four levels apart: {stated[0].round(3)} +- {stated[1]:.3f} px aside,")
print(f"  with pixels that have a width: {right[0].round(3)}")
assert stated[0].max() < -0.5 and np.abs(right[0]).max() < 0.05
PYTHON
for package in 4.14.0.94 5.0.0.93; do
  "${PYTHON:-python3}" -m venv "$folder/$package"
  "$folder/$package/bin/pip" install --quiet "opencv-python-headless==$package" "numpy>=2,<3"
  "$folder/$package/bin/python" "$folder/levels.py" "${package%.*}"
done

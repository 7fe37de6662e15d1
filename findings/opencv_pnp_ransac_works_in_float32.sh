#!/usr/bin/env bash
# OpenCV 5.0.0: cv2.solvePnPRansac rounds float64 object points to float32 before it solves.
#
# Guess: float64 points in give a float64 pose, as cv2.solvePnP does to millimetres far from the origin. Seen, with 100 exact
# points 3 to 6 m before a camera and nothing wrong among them, all moved by the same offset (x, -x, 0), as maps in
# projected coordinates (UTM) are: at 0 all are inliers; at 500 km 89 are, and the pose is 0.13 degrees off; at 4000 km 11 are, it is
# 4.8 degrees off, and the call still returns True. Nothing warns. Subtracting the points' mean first mends it.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "opencv-python-headless==5.0.0.93" "numpy>=2,<3"
"$folder/env/bin/python" - <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(0)
points = rng.uniform([-2, -2, 3], [2, 2, 6], (100, 3))
seen = points[:, :2] / points[:, 2:]  # by a camera at the points' origin, which looks along z


def located(offset, centred):
    world = points + [offset, -offset, 0]
    given = world - world.mean(axis=0) if centred else world
    found, rotation, _, inliers = cv2.solvePnPRansac(
        given, seen, np.eye(3), None, reprojectionError=3 / 500, iterationsCount=300, flags=cv2.SOLVEPNP_AP3P
    )
    assert given.dtype == np.float64
    return found, np.degrees(np.linalg.norm(rotation)), 0 if inliers is None else len(inliers)


for offset in (0.0, 5e5, 4e6):
    for centred in (False, True):
        found, angle, inliers = located(offset, centred)
        print(
            f"OpenCV {cv2.__version__}, points {offset / 1000:.0f} km away{', their mean taken off' if centred else ''}: "
            f"returns {found}, {inliers} of 100 inliers, {angle:.3f} degrees off"
        )
        if offset and not centred:
            assert found and inliers < 95 and angle > 0.05, (inliers, angle)
        else:
            assert found and inliers == 100 and angle < 0.01, (inliers, angle)
PYTHON

#!/usr/bin/env bash
# GTSAM 4.3.0: PreintegratedCombinedMeasurements turns a force by the orientation at the start of its step.
#
# Guess: readings averaged over a step (or interpolated at its middle) integrate to second order, as the midpoint rule does. Seen, for an
# ideal IMU at rest in place that turns at 2 rad/s for one second, whose predicted speed should be zero: with readings of the middles
# 0.098, 0.049, 0.025 and 0.012 m/s at 100, 200, 400 and 800 Hz, that is g * rate * step / 2, a force that is turned half a step too
# little; with readings of the starts less than 1e-3 m/s at every rate. So averaging neighbours before integrateMeasurement does harm.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "gtsam==4.3.0" "numpy>=2,<3"
"$folder/env/bin/python" - <<'PYTHON'
import gtsam
import numpy as np

GRAVITY, RATE, SECONDS = 9.81, 2.0, 1.0


def speed(hz, place):
    """Predicted speed after a second at rest, of readings taken at a place of each step."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    bias = gtsam.imuBias.ConstantBias()
    summed = gtsam.PreintegratedCombinedMeasurements(params, bias)
    for k in range(round(SECONDS * hz)):
        angle = RATE * (k + place) / hz
        force = GRAVITY * np.array([0.0, np.sin(angle), np.cos(angle)])
        summed.integrateMeasurement(force, np.array([RATE, 0.0, 0.0]), 1 / hz)
    at_rest = gtsam.NavState(gtsam.Pose3(), np.zeros(3))
    return float(np.linalg.norm(summed.predict(at_rest, bias).velocity()))


for hz in (100, 200, 400, 800):
    middle, start = speed(hz, 0.5), speed(hz, 0.0)
    print(f"{hz} Hz: {middle:.4f} m/s by readings of the middles, {start:.2e} m/s by those of the starts")
    assert abs(middle - GRAVITY * RATE * SECONDS / (2 * hz)) < 1e-3, middle
    assert start < 1e-3, start
PYTHON

"""Half-way between frames: every second pose of a run is left out, and estimated from the others.

Options are those of `python -m jaxpose.experiments.imu_slam`. Printed are errors after SE(3) alignment of the
tracked poses and of the batch pass, and, at the poses left out, of a spline through the others and of
`smooth` by the others and the readings of one sensor or both.

    python benchmarks/between_frames.py --help
"""

import numpy as np
import tyro

from jaxpose import fields
from jaxpose.estimate import smooth
from jaxpose.evaluation import trajectory_error
from jaxpose.experiments.imu_slam import Config
from jaxpose.experiments.slam.options import slam_config
from jaxpose.experiments.slam.source import load
from jaxpose.fields import numpy_evaluator
from jaxpose.geometry import rigid
from jaxpose.slam.batch import SEEN_AGAIN_S, own_covariances
from jaxpose.slam.pipeline import run


def main() -> None:
    config = tyro.cli(Config, description=__doc__)
    recording = load(config).recording
    truth, t = recording.T_world_cam, recording.t - recording.t[0]
    assert truth is not None and recording.imu is not None, (
        "expected true poses to measure against, and an IMU"
    )
    imu = recording.imu._replace(t=np.asarray(recording.imu.t) - recording.t[0])
    result = run(recording, slam_config(config))
    tracked = result.frames.T_world_body @ recording.T_body_cam
    own = own_covariances(result.frames)
    print(f"{recording.name}, {len(t)} frames, IMU {config.slam.imu}, seed {config.slam.seed}")
    show("tracked", tracked, truth)
    show("with the batch pass", result.T_world_cam, truth)
    kept = np.arange(0, len(t), 2)
    out = np.arange(1, kept[-1], 2)
    show("left out: as tracked", tracked[out], truth[out])
    spline = fields.fit(fields.bspline((0.0, float(t[kept][-1])), len(kept) - 1), t[kept], tracked[kept])
    factor = spline.field.description.factors(spline.params)[0]
    show("left out: a spline through the others", numpy_evaluator.evaluate(factor, t[out]), truth[out])
    for use in (("gyroscope", "accelerometer"), ("gyroscope",), ("accelerometer",)):
        known = smooth(
            t[kept], tracked[kept], own[kept], imu, use=use, noise=config.slam.imu_noise,
            T_body_cam=recording.T_body_cam, gravity_world=recording.gravity_world,
            drift=2 * own[kept], drift_s=SEEN_AGAIN_S,  # the map was made from all
        )  # fmt: skip
        show(f"left out: by {' and '.join(use)}", known.pose(t[out]), truth[out])


def show(name: str, T, truth) -> None:
    ate = trajectory_error.ate(T, truth)
    aligned = trajectory_error.align(ate.alignment, T)
    turned = np.degrees(rigid.rotation_angle(aligned[:, :3, :3], truth[:, :3, :3]))
    rpe = trajectory_error.rpe(T, truth)
    print(
        f"  {name:<40} ATE {100 * ate.rmse:.3f} cm, {np.sqrt(np.mean(turned**2)):.3f} deg, RPE "
        f"{100 * rpe.translation_m.rmse:.3f} cm, {rpe.rotation_deg.rmse:.3f} deg"
    )


if __name__ == "__main__":
    main()

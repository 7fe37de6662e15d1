"""What a run's batch pass found of the sensors, in numbers and in words."""

from typing import Any

import numpy as np

from jaxpose.estimate import Posterior


def calibration_numbers(known: Posterior) -> dict[str, Any]:
    """The sensors with one sigma each, for the results.

    Args:
        known: of the batch pass.

    Returns:
        Numbers under identifiers.
    """
    s, noise = known.sensors, known.noise
    middle = len(s.bias_t) // 2
    return {
        "estimated": list(known.estimated),
        "unobserved": list(known.unobserved),
        "offset_s": s.offset_s,
        "offset_sigma_s": s.offset_sigma_s,
        "T_body_cam": s.T_body_cam,
        "T_body_cam_sigma": s.T_body_cam_sigma,
        "gravity_world": s.gravity_world,
        "gravity_sigma_rad": s.gravity_sigma,
        "gyro_bias": s.gyro_bias[middle],
        "gyro_bias_sigma": s.gyro_bias_sigma[middle],
        "accelerometer_bias": s.accelerometer_bias[middle],
        "accelerometer_bias_sigma": s.accelerometer_bias_sigma[middle],
        "gyro_noise_rad_s": noise.gyro,
        "accelerometer_noise_m_s2": noise.accelerometer,
        "position_factor": noise.position,
        "rotation_factor": noise.rotation,
    }


def calibration_lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as lines of a report, name and text.

    Args:
        found: `calibration_numbers`, as they are or as JSON gave them back.

    Returns:
        What was estimated, a line each; what the motion did not show is said so.
    """
    lines = []
    if "offset" in found["estimated"]:
        ms, sigma = 1e3 * found["offset_s"], 1e3 * found["offset_sigma_s"]
        lines.append(("time offset", f"{ms:.2f} +- {sigma:.2f} ms  t_imu = t_cam + offset"))
    if "extrinsics" in found["estimated"]:
        T, sigma = np.array(found["T_body_cam"]), np.array(found["T_body_cam_sigma"])
        lever = " ".join(f"{100 * x:.2f}" for x in T[:3, 3])
        lines.append((
            "T_body_cam",
            f"camera at {lever} cm (+- {100 * sigma[:3].max():.2f}), rotation "
            f"+- {np.degrees(sigma[3:].max()):.3f} deg  in results.json",
        ))  # fmt: skip
    gyro, accelerometer = (
        " ".join(f"{x:.4f}" for x in found[name]) for name in ("gyro_bias", "accelerometer_bias")
    )
    worst = [max(found[f"{name}_sigma"]) for name in ("gyro_bias", "accelerometer_bias")]
    lines.append((
        "IMU biases",
        f"{gyro} rad/s (+- {worst[0]:.4f}), {accelerometer} m/s^2 (+- {worst[1]:.3f})  in the middle",
    ))  # fmt: skip
    if found["unobserved"]:
        lines.append(("not observed", f"{', '.join(found['unobserved'])}: this motion says nothing of it"))
    return lines

"""The ASL layout of EuRoC, as small as it gets."""

T0 = 1403715523912140001  # the last digits are lost in float64

SENSOR = """%YAML:1.0
# a comment: T_BS: data: [9]
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,   # turned
         1.0, 0.0, 0.0, 0.0,
         0.0, 0.0, 1.0, -0.25,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def truth_line(timestamp, position=(1, 2, 3), quaternion=(0.5, 0.5, 0.5, 0.5)):
    return ",".join(map(str, [timestamp, *position, *quaternion, *range(4, 13)]))


def write_sequence(folder):
    """A made-up recording: two readings and two lines of ground truth."""
    for name in ("imu0", "state_groundtruth_estimate0"):
        (folder / "mav0" / name).mkdir(parents=True)
    imu = [
        "#timestamp [ns],w x,w y,w z,a x,a y,a z",
        f"{T0},1,2,3,4,5,6",
        "",
        f"{T0 + 5000007}, 1.5,0,0,-1,0,9",
    ]
    (folder / "mav0/imu0/data.csv").write_text("\r\n".join(imu))
    (folder / "mav0/imu0/sensor.yaml").write_text(SENSOR)
    ground_truth = [
        "#timestamp",
        truth_line(T0 + 1000000000),
        truth_line(T0 + 1005000000, (1, 2, 4), (-1, 0, 0, 0)),
    ]
    (folder / "mav0/state_groundtruth_estimate0/data.csv").write_text("\n".join(ground_truth) + "\n")
    return folder

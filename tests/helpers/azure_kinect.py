"""Recordings of Azure Kinect, byte by byte: Matroska (RFC 9559), k4arecorder's tracks, tags and attachment.

learn.microsoft.com, "Azure Kinect DK recording file format"; the calibration as the sensor SDK reads it.
"""

import io
import json
import struct

import numpy as np
from PIL import Image

COLOR, DEPTH = (640, 360), (320, 288)
LENS = (0.5, -0.1, 0.02, 0.4, -0.05, 0.01)  # k1 to k6
BEGAN_NS = 7_000_123_000  # on the device's clock


def element(number, *content):
    data = b"".join(part if isinstance(part, bytes) else _number(part) for part in content)
    return (
        number.to_bytes((number.bit_length() + 7) // 8, "big")
        + (len(data) | 1 << 56).to_bytes(8, "big")
        + data
    )


def _number(value):
    return value.encode() if isinstance(value, str) else value.to_bytes(8, "big")


def track(number, name, kind, codec, size=None, fourcc=b"", bits=0):
    video = []
    if size is not None:
        header = struct.pack("<IiiHH4sIiiII", 40, *size, 1, bits, fourcc, 0, 0, 0, 0, 0)
        video = [element(0x63A2, header), element(0xE0, element(0xB0, size[0]), element(0xBA, size[1]))]
    head = (element(0xD7, number), element(0x73C5, 100 + number), element(0x83, kind), element(0x9C, 0))
    return element(0xAE, *head, element(0x86, codec), element(0x536E, name), *video)


def block(number, us, data):
    return element(0x1F43B675, element(0xE7, us), element(0xA3, bytes([0x80 | number, 0, 0, 0x80]), data))


def calibration(T_color_depth, T_imu_depth):
    """Shares of the sensors' grids, as the device has them."""

    def camera(location, size, T, shares):
        rotation, translation = T[:3, :3].reshape(-1).tolist(), T[:3, 3].tolist()
        intrinsics = {
            "ModelParameterCount": 14,
            "ModelParameters": [*shares, *LENS, 0, 0, 2e-4, -1e-4],
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        }
        return {
            "Location": f"CALIBRATION_CameraLocation{location}",
            "Intrinsics": intrinsics,
            "Rt": {"Rotation": rotation, "Translation": translation},
            "SensorWidth": size[0], "SensorHeight": size[1], "MetricRadius": 1.7,
        }  # fmt: skip

    imu = {"Rotation": T_imu_depth[:3, :3].reshape(-1).tolist(), "Translation": T_imu_depth[:3, 3].tolist()}
    sensors = [
        {"SensorType": f"CALIBRATION_InertialSensorType_{kind}", "Rt": imu}
        for kind in ("Gyro", "Accelerometer")
    ]
    cameras = [
        camera("D0", (1024, 1024), np.eye(4), (0.5, 0.51, 0.49, 0.49)),
        camera("PV0", (4096, 3072), T_color_depth, (0.49, 0.52, 0.47, 0.63)),
    ]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras, "InertialSensors": sensors}}).encode()


def write(path, rgb, counts, readings, stated, *, drop=()):
    """Frames at 30 Hz, depth 160 us later; readings are (us, force, rate) on the file's clock."""
    tracks = {
        "COLOR": track(1, "COLOR", 1, "V_MS/VFW/FOURCC", COLOR, b"MJPG", 24),
        "DEPTH": track(2, "DEPTH", 1, "V_MS/VFW/FOURCC", DEPTH, b"b16g", 16),
        "IMU": track(3, "IMU", 0x11, "S_K4A/IMU"),
    }
    blocks = []
    for k, (image, depth) in enumerate(zip(rgb, counts, strict=True)):
        jpeg = io.BytesIO()
        Image.fromarray(image).save(jpeg, "jpeg", quality=95)
        blocks.append((33_333 * k, 1, jpeg.getvalue()))
        blocks.append((33_333 * k + 160, 2, depth.astype(">u2").tobytes()))
    for us, force, rate in readings:
        at = BEGAN_NS + 1000 * us
        blocks.append((us, 3, struct.pack("<Q3fQ3f", at, *force, at + 11_000, *rate)))
    name = element(0x67C8, element(0x45A3, "K4A_DEPTH_MODE"), element(0x4487, "NFOV_2X2BINNED"))
    attached = (element(0x466E, "calibration.json"), element(0x4660, "application/octet-stream"))
    attached += (element(0x465C, stated), element(0x46AE, 9))
    parts = {
        "info": element(0x1549A966, element(0x2AD7B1, 1000), element(0x5741, "k4arecord-1.4.1")),
        "tracks": element(0x1654AE6B, *(data for key, data in tracks.items() if key not in drop)),
        "calibration": element(0x1941A469, element(0x61A7, *attached)),
        "tags": element(0x1254C367, element(0x7373, element(0x63C0), name)),
        "frames": b"".join(block(number, us, data) for us, number, data in sorted(blocks)),
    }
    head = element(0x1A45DFA3, element(0x4282, "matroska"), element(0x4287, 2), element(0x4285, 2))
    path.write_bytes(head + element(0x18538067, *(data for key, data in parts.items() if key not in drop)))
    return path

"""Images in messages of ROS, raw and compressed, as colour (uint8) and depth (metres)."""

from typing import Any, Literal, NamedTuple

import numpy as np

# Encodings of sensor_msgs/Image: bytes a pixel (its channels), and the name of OpenCV's conversion to RGB.
_COLORS: dict[str, tuple[int, str | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, "BGR2RGB"),
    "8UC3": (3, "BGR2RGB"),
    "rgba8": (4, "RGBA2RGB"),
    "bgra8": (4, "BGRA2RGB"),
    "8UC4": (4, "BGRA2RGB"),
    "mono8": (1, "GRAY2RGB"),
    "8UC1": (1, "GRAY2RGB"),
    "yuv422": (2, "YUV2RGB_UYVY"),
    "uyvy": (2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "YUV2RGB_YUY2"),
    "yuyv": (2, "YUV2RGB_YUY2"),
    "bayer_rggb8": (1, "BayerRGGB2RGB"),
    "bayer_bggr8": (1, "BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "BayerGBRG2RGB"),
    "bayer_grbg8": (1, "BayerGRBG2RGB"),
}
_DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
_GREY = ("mono8", "8UC1")
_HEADER = 12  # bytes of compressedDepth before its PNG: a format, and two float32 of its quantisation
_PNG = b"\x89PNG"


class ImageKind(NamedTuple):
    """What the images of a topic are."""

    role: Literal["color", "grey", "depth"]
    encoding: str  # in words
    size: tuple[int, int]  # width, height


def image_kind(message: Any) -> ImageKind | None:
    """What an image message holds; None for one of an encoding that is neither colour nor depth.

    Args:
        message: `sensor_msgs/Image` or `CompressedImage`.

    Returns:
        Its kind.

    Raises:
        ValueError: For a compressed image that cannot be decoded, and for too few bytes.
    """
    if hasattr(message, "encoding"):
        size = (int(message.width), int(message.height))
        if message.encoding in _DEPTHS:
            _row_bytes(message, np.dtype(_DEPTHS[message.encoding]), 1)
            return ImageKind("depth", message.encoding, size)
        if message.encoding in _COLORS:
            _row_bytes(message, np.dtype(np.uint8), _COLORS[message.encoding][0])
            role = "grey" if message.encoding in _GREY else "color"
            return ImageKind(role, message.encoding, size)
        return None
    form = str(message.format).strip("\0 ")
    if "compressedDepth" in form:
        height, width = depth_of(message).shape
        return ImageKind("depth", form, (width, height))
    pixels = _decode(bytes(message.data))
    height, width = pixels.shape[:2]
    if pixels.dtype == np.uint16:
        return ImageKind("depth", form, (width, height))
    return ImageKind("grey" if pixels.ndim == 2 else "color", form, (width, height))


def color_of(message: Any) -> np.ndarray:
    """The pixels of a message as (height, width, 3) uint8 RGB, grey as three equal channels.

    Args:
        message: `sensor_msgs/Image` of one of the known encodings, or `CompressedImage` (jpeg, png).

    Returns:
        The image.

    Raises:
        ValueError: For another encoding, for too few bytes, and for what cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        pixels = _decode(bytes(message.data))
        if pixels.dtype != np.uint8:
            raise ValueError(f"expected pixels of 8 bits, got {pixels.dtype}")
        return _converted(pixels, "GRAY2RGB" if pixels.ndim == 2 else "BGR2RGB")
    if message.encoding not in _COLORS:
        raise ValueError(f"expected an encoding of {', '.join(_COLORS)}, got {message.encoding}")
    channels, conversion = _COLORS[message.encoding]
    pixels = _pixels(message, np.dtype(np.uint8), channels)
    return _converted(pixels, conversion)


def depth_of(message: Any) -> np.ndarray:
    """The depth of a message [m], (height, width) float32, 0 where there is none.

    16 bits are millimetres and 32 bits metres (REP 118). `compressedDepth` holds a PNG of 16 bits behind 12
    bytes: of millimetres, or of a / depth [m] + b with the a and b of its header, where it was made from
    metres (image_transport_plugins, compressed_depth_image_transport).

    Args:
        message: `sensor_msgs/Image` of 16UC1, mono16 or 32FC1, or `CompressedImage`.

    Returns:
        Depth; 0, 65535, NaN and infinity are none.

    Raises:
        ValueError: For another encoding, for too few bytes, and for what cannot be decoded.
    """
    if hasattr(message, "encoding"):
        if message.encoding not in _DEPTHS:
            raise ValueError(f"expected an encoding of {', '.join(_DEPTHS)}, got {message.encoding}")
        order = ">" if message.is_bigendian else "<"
        pixels = _pixels(message, np.dtype(_DEPTHS[message.encoding]).newbyteorder(order), 1)
        if pixels.dtype.kind == "f":
            return np.where(np.isfinite(pixels) & (pixels > 0), pixels, 0).astype(np.float32)
        return _metres(pixels)
    data, form = bytes(message.data), str(message.format)
    if "compressedDepth" not in form:
        return _metres(_decode(data))
    start = data.find(_PNG, 0, _HEADER + len(_PNG))
    if start < 0:
        raise ValueError(f"expected compressedDepth with a PNG, got {form.strip()}, bytes {data[:16].hex()}")
    counts = _decode(data[start:])
    if not form.startswith("32FC1"):
        return _metres(counts)
    if start != _HEADER:
        raise ValueError(f"expected compressedDepth with a header of {_HEADER} bytes, got {start}")
    a, b = np.frombuffer(data, "<f4", 2, offset=4)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(counts > 0, a / (counts.astype(np.float32) - b), 0)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _metres(counts: np.ndarray) -> np.ndarray:
    if counts.dtype.kind != "u" or counts.dtype.itemsize != 2 or counts.ndim != 2:
        raise ValueError(f"expected depth of 16 bits, got {counts.dtype} of shape {counts.shape}")
    return np.where(counts == 65535, 0, counts).astype(np.float32) / np.float32(1000)


def _pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """(height, width[, channels]) of a raw message, whose rows may be padded."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data, row = np.asarray(message.data, np.uint8), _row_bytes(message, dtype, channels)
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    return rows.view(dtype).reshape((height, width, channels) if channels > 1 else (height, width))


def _row_bytes(message: Any, dtype: np.dtype, channels: int) -> int:
    """The bytes of a row without its padding; ValueError for a raw message with fewer than its rows have."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row, there = width * channels * dtype.itemsize, len(message.data)
    if step < row or there < step * height:
        raise ValueError(
            f"expected {width}x{height} pixels of {message.encoding}, got {there} bytes in rows of {step}"
        )
    return row


def _converted(pixels: np.ndarray, conversion: str | None) -> np.ndarray:
    import cv2

    return pixels if conversion is None else cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}"))


def _decode(data: bytes) -> np.ndarray:
    import cv2

    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None:
        raise ValueError(f"expected a jpeg or png, got {len(data)} bytes that are neither")
    return pixels[..., :3] if pixels.ndim == 3 else pixels

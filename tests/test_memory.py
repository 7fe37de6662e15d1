"""What this process holds, in processes of their own, as the peak of this one may lie behind it."""

import platform
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpose._memory import give_back_zeros

HELD = """
import jax, jax.numpy as jnp, numpy as np
from pathlib import Path
def held():
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmRSS"))
    return int(line.split()[1]) / 1024
"""
ON_LINUX = pytest.mark.skipif(platform.system() != "Linux", reason="the system's own way to say it")


def said(code: str) -> list[float]:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [float(word) for word in run.stdout.split()]


def test_peak_rss_sees_memory_that_was_freed():
    code = (
        "import numpy as np; from jaxpose._memory import peak_rss_bytes as peak; a = peak()\n"
        "x = np.ones(12_500_000); del x; print(a, peak())"
    )
    before, after = said(code)
    assert 20e6 < before < 1e9
    assert 60e6 < after - before < 120e6


@ON_LINUX
def test_zeros_that_were_given_back_take_memory_as_they_are_written():
    before, made, back, written = said(
        HELD + "from jaxpose._memory import give_back_zeros\n"
        "set_rows = jax.jit(lambda x, y: x.at[:25].set(y), donate_argnums=0)\n"
        "jax.jit(lambda x: x + 1)(1.0); a = held()\n"
        "x = jnp.zeros((100, 1 << 18)).block_until_ready(); b = held(); give_back_zeros(x); c = held()\n"
        "x = set_rows(x, jnp.ones((25, 1 << 18))).block_until_ready(); print(a, b, c, held())"
    )
    assert made - before > 90 and back - before < 20  # MiB, of 100
    assert 20 < written - back < 75  # 25, and as much that is set


@ON_LINUX
def test_a_map_takes_the_memory_of_its_blocks():
    """A pool for a furnished office, 228 MiB, of which a first frame fills little."""
    before, empty, some = said(
        HELD + "from jaxpose.scenes.voxel_blocks import *\n"
        "jax.jit(lambda x: x + 1)(1.0); a = held(); config = BlockConfig()\n"
        "pool = empty_blocks(config); pool.values.block_until_ready(); b = held()\n"
        "wanted = np.argwhere(np.ones((10, 10, 10)))\n"
        "pool = with_blocks(config, pool, wanted); values = np.ones((1000, 9, 9, 9, 8), np.int16)\n"
        "jax.block_until_ready(with_first_rows(pool, jnp.asarray(values))); print(a, b, held())"
    )
    # MiB; 1000 blocks are 11, here three times, and compiled
    assert empty - before < 40 and some - empty < 70


def test_what_is_given_back_stays_as_it_was():
    x = jnp.zeros((64, 4096)).at[:5].set(7.0)
    give_back_zeros(x, 5)
    np.testing.assert_array_equal(np.asarray(x), np.repeat([7.0, 0.0], [5, 59])[:, None] * np.ones(4096))
    added = jax.jit(lambda x: x.at[40].add(1.0), donate_argnums=0)(x)
    assert float(added.sum()) == 4096 * 36
    in_trace = jax.jit(lambda: (give_back_zeros(zeros := jnp.zeros((9, 4096))), zeros)[1])()
    assert not np.asarray(in_trace).any()
    for small in (jnp.zeros(3), jnp.zeros((1, 2))):  # less than a page
        give_back_zeros(small)
        assert not np.asarray(small).any()

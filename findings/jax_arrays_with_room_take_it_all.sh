#!/usr/bin/env bash
# jax 0.10.2 on a CPU: an array with room for more than it will hold takes all of it, however it is made.
#
# Guess: as in numpy, memory that nobody has written is not there yet, so a large `jax.lax.empty`, or numpy's zeros taken
# over without a copy and then donated to the function that fills some rows, takes what is filled. Seen: `jax.lax.empty`
# writes zeros, 512 MiB of them at once. Numpy's zeros are taken over (`from_dlpack(copy=False)`, the same pointer, no
# memory), but donated they are copied: no warning, another pointer, 512 MiB. JAX's own array is updated in place.
# The system takes an array's pages back (`madvise(MADV_DONTNEED)` at `unsafe_buffer_pointer()`), after which it is
# still zeros and still updated in place.
# Needs Linux. Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "jax==0.10.2" "jaxlib==0.10.2" "numpy==2.4.1"
JAX_PLATFORMS=cpu "$folder/env/bin/python" - <<'PYTHON'
import ctypes
import mmap
import re
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

MIB, ROWS = 512, 512
set_row = jax.jit(lambda x: x.at[5].set(7), donate_argnums=0)
warnings.simplefilter("error")


def held():
    return int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1]) // 1024


def taken(name, make):
    before = held()
    found = make()
    more = held() - before
    print(f"jax {jax.__version__}, {name}: {more} of {MIB} MiB")
    return found, more


jax.block_until_ready(set_row(jnp.zeros((ROWS, 1 << 20), jnp.uint8)))  # compiled
raw = np.zeros((MIB << 20) + 4096, np.uint8)
start = -raw.ctypes.data % 4096
zeros = raw[start : start + (MIB << 20)].reshape(ROWS, 1 << 20)

x, more = taken("jax.lax.empty", lambda: jax.block_until_ready(jax.lax.empty((ROWS, 1 << 20), jnp.uint8)))
assert more > 0.9 * MIB
before, own = held(), x.unsafe_buffer_pointer()
page = -own % mmap.PAGESIZE
ctypes.CDLL(None).madvise(ctypes.c_void_p(own + page), ctypes.c_size_t((MIB << 20) - 4096), mmap.MADV_DONTNEED)
print(f"its pages taken back: {held() - before} MiB")
assert held() - before < -0.9 * MIB
y, more = taken("then donated, a row set", lambda: jax.block_until_ready(set_row(x)))
assert y.unsafe_buffer_pointer() == own and more < 0.1 * MIB and int(y[:9].sum(dtype=jnp.uint32)) == 7 << 20
del x, y

x, more = taken("numpy's zeros taken over", lambda: jax.dlpack.from_dlpack(zeros, copy=False))
shared = x.unsafe_buffer_pointer()
assert shared == zeros.ctypes.data and more < 0.1 * MIB
y, more = taken("then donated, a row set", lambda: jax.block_until_ready(set_row(x)))
print(f"in place: {y.unsafe_buffer_pointer() == shared}, the original unchanged: {not zeros[5].any()}")
assert y.unsafe_buffer_pointer() != shared and more > 0.9 * MIB and not zeros[5].any()
PYTHON

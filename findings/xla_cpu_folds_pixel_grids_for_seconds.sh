#!/usr/bin/env bash
# jax 0.10.2, XLA's CPU compiler: what depends on constants alone is computed while it is compiled, by an interpreter.
#
# Guess: rays of a camera's pixels, asked for inside of a jitted function with fixed intrinsics, cost as much as they would outside, once.
# Seen, for six Newton steps that undo a lens's distortion at 640 x 480 pixels: the function takes 3.2 s to compile, and 0.2 s with the same
# pixels as an argument.
# So grids are better made in numpy, and handed in as what they are. Exits with 1 if the ratio falls below 3.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "jax==0.10.2" "numpy>=2,<3"
JAX_PLATFORMS=cpu "$folder/env/bin/python" - <<'PYTHON'
import time

import jax
import jax.numpy as jnp
import numpy as np

K1, K2 = 0.2624, -0.9531  # of a lens
row, column = np.mgrid[:480, :640].astype(np.float32)
GRID = np.stack([(column - 318.6) / 517.3, (row - 255.3) / 516.5], axis=-1)


def undistorted(seen):
    """The points whose images these are: x (1 + k1 r^2 + k2 r^4) = seen, by Newton's method."""
    at = seen
    for _ in range(6):
        x, y = at[..., 0], at[..., 1]
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (K1 + r2 * K2), 2 * (K1 + 2 * r2 * K2)
        xx, xy, yy = radial + x * x * slope, x * y * slope, radial + y * y * slope
        a, b = x * radial - seen[..., 0], y * radial - seen[..., 1]
        step = jnp.stack([yy * a - xy * b, xx * b - xy * a], axis=-1)
        at = at - step / (xx * yy - xy * xy)[..., None]
    return at


def compiled_in(function, *args):
    lowered = jax.jit(function).lower(*args)
    began = time.perf_counter()
    lowered.compile()
    return time.perf_counter() - began


depth = jnp.ones((480, 640), jnp.float32)
compiled_in(lambda depth: depth + 1, depth)
constant = compiled_in(lambda depth: undistorted(jnp.asarray(GRID)) * depth[..., None], depth)
argument = compiled_in(lambda depth, grid: undistorted(grid) * depth[..., None], depth, jnp.asarray(GRID))
print(f"jax {jax.__version__}: {constant:.2f} s to compile with the pixels as constants, {argument:.2f} s as an argument")
assert constant > 3 * argument, (constant, argument)
PYTHON

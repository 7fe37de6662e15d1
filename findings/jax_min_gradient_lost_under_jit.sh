#!/usr/bin/env bash
# jax 0.12.0.1 on a CPU: the compiled gradient of jnp.min over values computed in the same program is zero for some inputs.
#
# Guess: jit changes a gradient by rounding at most. Seen: for `min(walls - (o + z * d))`, the distance to the nearest of
# three walls, 82 of 1000 compiled gradients by the ray's origin are all zeros, where one entry must be -1; no NaN, no
# warning. Op by op all are right, and so they are compiled by jax 0.10.2. The minimum and the values that it is
# compared with are rounded differently after fusion, so that no value equals the least one. A scene made of jnp.min then
# trains on wrong gradients; `jax.lax.optimization_barrier` around the values mends it.
# Needs Python 3.12 or newer (PYTHON names it). Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "jax==0.12.0.1" "jaxlib==0.12.0.1" "numpy==2.5.0"
JAX_PLATFORMS=cpu "$folder/env/bin/python" - <<'PYTHON'
import jax
import jax.numpy as jnp
import numpy as np

walls = jnp.array([2.0, 3.0, 4.0])
plain = lambda o, z, d: jnp.min(walls - (o + z * d))
held = lambda o, z, d: jnp.min(jax.lax.optimization_barrier(walls - (o + z * d)))
rng = np.random.default_rng(0)
o, d = (jnp.asarray(rng.uniform(-1, 1, (1000, 3)), jnp.float32) for _ in range(2))
z = jnp.asarray(rng.uniform(0, 2, 1000), jnp.float32)

for name, distance in (("plain", plain), ("behind a barrier", held)):
    gradient = jax.vmap(jax.grad(distance))
    for how, compute in (("op by op", gradient), ("compiled", jax.jit(gradient))):
        found = np.asarray(compute(o, z, d))
        zeros = int((found == 0).all(axis=1).sum())
        print(f"jax {jax.__version__}, {name}, {how}: {zeros} of {len(found)} gradients are all zeros")
        if (name, how) == ("plain", "compiled"):
            assert np.isfinite(found).all() and zeros > 10, zeros
        else:
            assert zeros == 0, (name, how, zeros)
PYTHON

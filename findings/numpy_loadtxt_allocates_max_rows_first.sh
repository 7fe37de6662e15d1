#!/usr/bin/env bash
# numpy 2.4.6: numpy.loadtxt allocates all of max_rows before it reads a line.
#
# Guess: max_rows bounds what is read, so a limit that is far too large costs nothing. Seen: two lines of three numbers read
# with max_rows=50,000 take 1.2 MB at most, with 10,000,000 240 MB and with 20,000,000 480 MB: 8 bytes for every number that
# might come. Passing on a count that a file's own header states lets a file of 200 bytes ask for any amount of memory; the
# bytes that are left in the file bound it. Without max_rows the same two lines take a few kB.
# Exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet "numpy==2.4.6"
"$folder/env/bin/python" - <<'PYTHON'
import io
import tracemalloc

import numpy as np


def peak(**options):
    tracemalloc.start()
    found = np.loadtxt(io.BytesIO(b"1 2 3\n4 5 6\n"), ndmin=2, **options)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.tolist() == [[1, 2, 3], [4, 5, 6]]
    return most


few = peak()
print(f"numpy {np.__version__}, two lines: {few / 1e6:.3f} MB without max_rows")
assert few < 5e6, few
for rows in (50_000, 10_000_000, 20_000_000):
    most = peak(max_rows=rows)
    print(f"{most / 1e6:.1f} MB with max_rows={rows}")
    assert 24 * rows <= most < 25 * rows + 1e6, most
PYTHON

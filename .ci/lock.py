"""Write what the gate installs, to the last version: `python3.11 .ci/lock.py`, `python3.13 .ci/lock.py`.

A file of constraints for the Python that runs this, resolved from `pyproject.toml` and its extra `test` now.
"""

import json
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def main() -> None:
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet"]
    run = subprocess.run(
        [*command, "--report", "-", "-e", f"{HERE.parent}[test]"], check=True, stdout=subprocess.PIPE
    )
    found = {
        item["metadata"]["name"]: item["metadata"]["version"] for item in json.loads(run.stdout)["install"]
    }
    lines = [f"{name}=={found[name]}" for name in sorted(found, key=str.lower) if name != "jaxpose"]
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    head = f"# Versions that the gate installs on Python {version}; written by .ci/lock.py.\n"
    (HERE / f"constraints-{version}.txt").write_text(head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

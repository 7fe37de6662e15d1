"""Known vulnerabilities of what the gate installs, by pip-audit; a line where its service does not answer."""

import json
import subprocess
import sys
from pathlib import Path


def main() -> None:
    known, looked_at = [], 0
    for file in sorted(Path(__file__).parent.glob("constraints-*.txt")):
        command = ["pip-audit", "--disable-pip", "--no-deps", "--format", "json", "--timeout", "10"]
        run = subprocess.run([*command, "-r", str(file)], capture_output=True, text=True)
        if not run.stdout.strip():
            print(f"left out, the service does not answer: {run.stderr.strip().splitlines()[-1][:200]}")
            return
        found = json.loads(run.stdout)["dependencies"]
        looked_at += sum("vulns" in package for package in found)
        known += [
            f"{file.name}: {package['name']} {package['version']}: {vulnerability['id']}, mended in "
            f"{', '.join(vulnerability['fix_versions']) or 'no version'}"
            for package in found
            for vulnerability in package.get("vulns", ())
        ]
    if not looked_at:
        print("left out, the registry tells nothing of vulnerabilities")
    print("\n".join([*known, f"{looked_at} packages looked at, {len(known)} vulnerabilities"]))
    sys.exit(1 if known else 0)


if __name__ == "__main__":
    main()

"""Known vulnerabilities of every locked version; says so when nobody could tell.

    python .ci/audit.py [--vulnerability-service=osv] LOCK...

Runs pip-audit beside this Python. All pins count, also those for other versions of
Python and other platforms. Exit status: 0 none known, 1 some, 2 not audited.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

PIN = re.compile(r"^([\w.-]+)==([^\s;]+)", re.M)


def listed(pins: set[tuple[str, str]]) -> list[str]:
    """Requirement files that hold every pin; each names a package once."""
    files: list[dict[str, str]] = []
    for name, version in sorted(pins):
        place = next((file for file in files if name not in file), None)
        if place is None:
            files.append(place := {})
        place[name] = version
    return ["".join(f"{n}=={v}\n" for n, v in file.items()) for file in files]


def audited(text: str, options: list[str]) -> list[dict]:
    """What pip-audit says of each package of one requirement file."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write(text)
        file.flush()
        tool = [Path(sys.executable).parent / "pip-audit", "--progress-spinner=off"]
        flags = ["--no-deps", "--disable-pip", "--format=json", "-r", file.name]
        done = subprocess.run(
            [*tool, *flags, *options], capture_output=True, text=True, check=False
        )
    try:
        return json.loads(done.stdout)["dependencies"]
    except ValueError:
        last = done.stderr.strip().splitlines() or ["no output"]
        reason = f"pip-audit: {last[-1][:300]}"
        return [
            {"name": name, "version": version, "skip_reason": reason}
            for name, version in PIN.findall(text)
        ]


def main(arguments: list[str]) -> int:
    """Audit the files that are named; flags go to pip-audit."""
    options = [word for word in arguments if word.startswith("-")]
    locks = [Path(word) for word in arguments if word not in options]
    pins = {pin for lock in locks for pin in PIN.findall(lock.read_text())}
    found = [entry for text in listed(pins) for entry in audited(text, options)]
    known = 0
    for entry in found:
        for flaw in entry.get("vulns", ()):
            known += 1
            fixed = ", ".join(flaw["fix_versions"]) or "none"
            print(f"{entry['name']} {entry['version']}: {flaw['id']}, fixed in {fixed}")
    unknown = [entry["skip_reason"] for entry in found if "skip_reason" in entry]
    if unknown:
        print(
            f"error: audit: {len(unknown)} of {len(pins)} locked versions not audited, "
            f"the first for: {unknown[0]}",
            file=sys.stderr,
        )
    elif not known:
        print(f"audit: {len(pins)} locked versions, no known vulnerability")
    return 1 if known else 2 if unknown or not pins else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Every row of docs/reliability.md by its command.

    python -m benchmarks.reliability.table [--minutes=5] [--anew]

Runs the commands of the page's tables in their order, one at a time, and writes
reliability.json: exit status, seconds and the line that sums it up, by row. Exit
status 1 if one failed. `--minutes` leaves out rows that say that they take longer. A
row that came out as stated with this very code is not run again, so that four hours may
be several evenings; `--anew` runs all. Rows that depend on what others publish
(`WORLD`) are run each time.
"""

import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

from absl import flags

from benchmarks.common import write
from rcirl_jax.cli.running import run
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.runtime.provenance import HOOK_VARIABLES

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reliability.md"
NOT_RUN = 77  # status of a row whose tests were skipped, in part or all
TOLD = 4000  # characters of what a row said that came out otherwise
# what no row's outcome depends on, by its path from the root
NO_CODE = re.compile(r"docs/|benchmarks/results/|.*\.md$")
WORLD = ("make audit", "make test-ceiling")  # depend on what others publish
CELLS = 4  # fault, outcome, minutes, command
# "3 passed, 1 skipped in 0.12s", by pytest
SUMMARY = re.compile(r"^=* ?((?:no tests ran|\d+ \w+).* in [\d.]+s.*)$", re.M)
_MINUTES = flags.DEFINE_float("minutes", float("inf"), "longest row that is run")
_ANEW = flags.DEFINE_bool("anew", False, "run what came out as stated before, too")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the page."""

    fault: str
    minutes: float
    command: str


def rows_of(text: str) -> list[Row]:
    """The rows of all tables of a page that have a command in their last column."""
    found = []
    for line in text.splitlines():
        cells = [x.strip() for x in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == CELLS and cells[-1].startswith("`"):
            fault, _, minutes, command = cells
            command = command.strip("`")
            found.append(Row(fault=fault, minutes=float(minutes), command=command))
    return found


def words(command: str, output: str = "") -> list[str]:
    """A page's command as this Python runs it: `pytest` and `python` are its own.

    What benchmarks write goes to `output`.
    """
    first, *rest = shlex.split(command)
    if first == "python":
        return [sys.executable, *rest, f"--output={output}"]
    own = [sys.executable, "-m", "pytest", "-q"] if first == "pytest" else [first]
    return [*own, *rest]


def tree_sha256() -> str:
    """Of every file that git knows, but documentation and results.

    Raises:
      InputError: git knows nothing of this folder.
    """
    env = {k: v for k, v in os.environ.items() if k not in HOOK_VARIABLES}
    words = ["git", "-C", str(ROOT), "ls-files", "-z"]
    done = subprocess.run(words, env=env, text=True, capture_output=True, check=False)
    if done.returncode != 0 or not done.stdout:
        raise InputError(f"{ROOT}: git ls-files: no files: expected a checkout")
    names = [x for x in done.stdout.split("\0") if x and not NO_CODE.match(x)]
    files = {name: ROOT / name for name in names}
    return digest({n: file_sha256(path) for n, path in files.items() if path.is_file()})


def ran(row: Row, output: str) -> dict:
    """Runs one row and returns its outcome."""
    begin = time.monotonic()
    done = subprocess.run(
        words(row.command, output), cwd=ROOT, text=True, capture_output=True,
        check=False, env={**os.environ, "PY_COLORS": "0"},
    )  # fmt: skip
    text = done.stdout + done.stderr
    tests = SUMMARY.findall(done.stdout)
    status = done.returncode or (NOT_RUN if " skipped" in " ".join(tests) else 0)
    if status:  # the file keeps one line of it
        print(text[-TOLD:], file=sys.stderr)
    said = tests or [line for line in text.splitlines() if line.strip()]
    return {
        **dataclasses.asdict(row),
        "status": status,
        "seconds": round(time.monotonic() - begin, 1),
        "said": said[-1] if said else "",
    }


def as_stated_before(path: Path, code: str) -> dict[str, dict]:
    """Command -> row of a result file that came out as stated with this code."""
    if not path.is_file():
        return {}
    try:
        rows = json.loads(path.read_text())["rows"]
        return {
            row["command"]: row
            for row in rows
            if row["status"] == 0
            and row["tree_sha256"] == code
            and row["command"] not in WORLD
        }
    except (ValueError, LookupError, TypeError) as error:
        expected = "expected a result of this command"
        raise InputError(f"{path}: {expected}: {error}") from error


def main() -> None:
    """The page's rows, one after the other."""
    found, code = rows_of(PAGE.read_text()), tree_sha256()
    done = as_stated_before(Path(_OUTPUT.value) / "reliability.json", code)
    for row in found:
        if row.minutes > _MINUTES.value:
            print(f"left out, {row.minutes:g} minutes: {row.fault}")
            continue
        if row.command in done and not _ANEW.value:
            print(f"as stated before, with this code: {row.fault}")
            continue
        print(f"{row.fault}: {row.command}", flush=True)
        made = done[row.command] = ran(row, _OUTPUT.value) | {"tree_sha256": code}
        good = "as stated" if made["status"] == 0 else "NOT as stated"
        print(f"    {good}, {made['seconds']} s: {made['said']}", flush=True)
        rows = [done[one.command] for one in found if one.command in done]
        not_run = [one.fault for one in found if one.command not in done]
        write("reliability", {"rows": rows, "not_run": not_run}, _OUTPUT.value)
    failed = [row["fault"] for row in done.values() if row["status"] != 0]
    told = ", ".join(failed)
    print(f"{len(done)} of {len(found)} rows, {len(failed)} not as stated: {told}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    run(main)

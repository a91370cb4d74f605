"""Every row of docs/reliability.md by its command.

    python -m benchmarks.reliability.table [--minutes=5] [--rows=guard,SIGTERM] [--anew]

Runs the commands of the page's tables in their order, one at a time, and writes
reliability.json: exit status, seconds and the line that sums it up, by row. Exit
status 1 if one failed. `--minutes` leaves out rows that say that they take longer, and
names them. A row that came out as stated with this very code is not run again, so that
four hours may be several evenings; `--anew` runs all. Rows that depend on what others
publish (`WORLD`) are run each time.
"""

import dataclasses
import datetime
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
from rcirl_jax.commands.flags.common import run
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.pipeline import digest, file_sha256
from rcirl_jax.runtime.provenance import HOOK_VARIABLES, git_commit

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reliability.md"
NOT_RUN = 77  # status of a row whose tests were skipped, in part or all
TOLD = 4000  # characters of what a row said that came out otherwise
# what no row's outcome depends on, by its path from the root
NO_CODE = re.compile(r"docs/|benchmarks/results/|.*\.md$")
WORLD = ("make audit", "make test-ceiling")  # depend on what others publish
# "3 passed, 1 skipped, 2 deselected in 0.12s", by pytest
_OF = r"\d+ (?:passed|failed|skipped|deselected|xfailed|xpassed|warnings?|errors?)"
SUMMARY = re.compile(rf"^=* ?((?:no tests ran|{_OF}(?:, {_OF})*) in [\d.]+s.*)$", re.M)
NOISE = re.compile(r"make(\[\d+\])?: (Entering|Leaving|\*\*\* \[)|WARNING: ")
CELLS = 6  # fault, injected, count, outcome, minutes, command
_MINUTES = flags.DEFINE_float("minutes", None, "longest row that is run")
_ROWS = flags.DEFINE_list("rows", None, "words of the first column; only such rows")
_ANEW = flags.DEFINE_bool("anew", False, "run what came out as stated before, too")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the page."""

    fault: str
    count: str
    minutes: float
    command: str


def rows_of(text: str) -> list[Row]:
    """The rows of all tables of a page that have a command in their last column."""
    found = []
    for line in text.splitlines():
        cells = [x.strip() for x in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == CELLS and cells[-1].startswith("`"):
            fault, _, count, _, minutes, command = cells
            row = Row(
                fault=fault,
                count=count,
                minutes=float(minutes),
                command=command.strip("`"),
            )
            found.append(row)
    return found


def words(command: str) -> list[str]:
    """A page's command as this Python runs it: `pytest` and `python` are its own.

    What benchmarks write goes to --output.
    """
    first, *rest = shlex.split(command)
    if first == "python":
        rest.append(f"--output={_OUTPUT.value if flags.FLAGS.is_parsed() else ''}")
    own = {"pytest": [sys.executable, "-m", "pytest", "-q"], "python": [sys.executable]}
    return [*own.get(first, [first]), *rest]


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


def summed_up(stdout: str, stderr: str, status: int) -> tuple[str, bool]:
    """(the line that says what came of a command, whether it skipped tests)."""
    tests = SUMMARY.findall(stdout)
    bad = [x for x in tests if re.search(r"\b(failed|errors?|skipped)\b", x)]
    out, err = (
        [x for x in text.splitlines() if x.strip() and not NOISE.match(x)]
        for text in (stdout, stderr)
    )
    said = bad or (tests or out or err if status == 0 else err or out)
    return said[-1] if said else "", any(" skipped" in x for x in tests)


def ran(row: Row) -> dict:
    """What came of one row."""
    begin, load = time.monotonic(), os.getloadavg()[0]
    done = subprocess.run(
        words(row.command), cwd=ROOT, text=True, capture_output=True, check=False,
        env={**os.environ, "PY_COLORS": "0"},
    )  # fmt: skip
    said, skipped = summed_up(done.stdout, done.stderr, done.returncode)
    status = done.returncode or (NOT_RUN if skipped else 0)
    if status:  # the file keeps one line of it
        print((done.stdout + done.stderr)[-TOLD:], file=sys.stderr)
    return {
        **dataclasses.asdict(row),
        "status": status,
        "seconds": round(time.monotonic() - begin, 1),
        "said": said,
        "load_before": round(load, 2),
        "date": datetime.date.today().isoformat(),
    }


def as_stated_before(path: Path, code: str) -> dict[tuple[str, str], dict]:
    """The rows of a result file that came out as stated with this code.

    None of `WORLD`: what others publish is not in the code.
    """
    try:
        rows = json.loads(path.read_text())["rows"]
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError) as error:
        expected = "expected a result of this command"
        raise InputError(f"{path}: {expected}: {error}") from error
    return {
        (row["fault"], row["command"]): row
        for row in rows
        if row["status"] == 0
        and row.get("tree_sha256") == code
        and row["command"] not in WORLD
    }


def main() -> None:
    """The page's rows, one after the other."""
    found, code, commit = rows_of(PAGE.read_text()), tree_sha256(), git_commit()
    wanted = [
        row
        for row in found
        if not _ROWS.value or any(name in row.fault for name in _ROWS.value)
    ]
    if not wanted:
        raise InputError(f"--rows: {_ROWS.value}: no row of {PAGE.name} has the words")
    most = float("inf") if _MINUTES.value is None else _MINUTES.value
    path = Path(_OUTPUT.value) / "reliability.json"
    keys = [(row.fault, row.command) for row in found]
    done = as_stated_before(path, code)
    for row in wanted:
        key = (row.fault, row.command)
        if row.minutes > most:
            print(f"left out, {row.minutes:g} minutes: {row.fault}")
            continue
        if key in done and not _ANEW.value:
            print(f"as stated before, with this code: {row.fault}")
            continue
        print(f"{row.fault}: {row.command}", flush=True)
        done[key] = ran(row) | {"tree_sha256": code, "git_commit": commit}
        good = "as stated" if done[key]["status"] == 0 else "NOT as stated"
        print(f"    {good}, {done[key]['seconds']} s: {done[key]['said']}", flush=True)
        rows = [done[one] for one in keys if one in done]
        not_run = [one[0] for one in keys if one not in done]
        write("reliability", {"rows": rows, "not_run": not_run}, _OUTPUT.value)
    failed = [fault for (fault, _), row in done.items() if row["status"] != 0]
    print(
        f"{len(done)} of {len(found)} rows, {len(failed)} not as stated: "
        f"{', '.join(failed)}"
    )
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    run(main)

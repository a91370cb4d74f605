"""Every row of docs/reliability.md by its command.

    python -m benchmarks.reliability.table [--minutes=5] [--rows=guard,SIGTERM]

Runs the commands of the page's tables in their order, one at a time, and writes
reliability.json: exit status, seconds and the last line said. Exit status 1 if one
failed. `--minutes` leaves out rows that say that they take longer, and names them.
"""

import dataclasses
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

from absl import flags

from benchmarks.common import write
from experiments.common import run
from rcirl_jax.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reliability.md"
NOT_RUN = 77  # status of a row whose tests were skipped, in part or all
CELLS = ("fault", "injected", "count", "outcome", "minutes", "command")
_MINUTES = flags.DEFINE_float("minutes", None, "longest row that is run")
_ROWS = flags.DEFINE_list("rows", None, "words of the first column; only such rows")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the page."""

    fault: str
    minutes: float
    command: str


def rows_of(text: str) -> list[Row]:
    """The rows of all tables of a page that have a command in their last column.

    Raises:
      InputError: a row without minutes.
    """
    found = []
    for line in text.splitlines():
        cells = [x.strip() for x in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) != len(CELLS) or not cells[-1].startswith("`"):
            continue
        cell = dict(zip(CELLS, cells, strict=True))
        try:
            minutes = float(cell["minutes"])
        except ValueError as error:
            raise InputError(
                f"{PAGE.name}: {cell['fault']}: minutes: {cell['minutes']}: "
                "expected a number"
            ) from error
        command = cell["command"].strip("`")
        found.append(Row(fault=cell["fault"], minutes=minutes, command=command))
    return found


def words(command: str) -> list[str]:
    """A page's command as this Python runs it: `pytest` and `python` are its own.

    What benchmarks write goes to --output.
    """
    first, *rest = shlex.split(command)
    if first == "python":
        rest.append(f"--output={_OUTPUT.value if flags.FLAGS.is_parsed() else ''}")
    own = {
        "pytest": [sys.executable, "-m", "pytest", "-q"],
        "python": [sys.executable],
    }
    return [*own.get(first, [first]), *rest]


def ran(row: Row) -> dict:
    """What came of one row."""
    begin = time.monotonic()
    done = subprocess.run(
        words(row.command), cwd=ROOT, text=True, capture_output=True, check=False
    )
    said = (done.stdout + done.stderr).strip().splitlines()
    last = said[-1] if said else ""
    status = done.returncode
    if row.command.startswith("pytest") and "skipped" in last:
        status = status or NOT_RUN
    return {
        **dataclasses.asdict(row),
        "status": status,
        "seconds": round(time.monotonic() - begin, 1),
        "said": last,
    }


def main() -> None:
    """The page's rows, one after the other."""
    found, results = rows_of(PAGE.read_text()), []
    wanted = [
        row
        for row in found
        if not _ROWS.value or any(name in row.fault for name in _ROWS.value)
    ]
    if not wanted:
        raise InputError(f"--rows: {_ROWS.value}: no row of {PAGE.name} has the words")
    most = float("inf") if _MINUTES.value is None else _MINUTES.value
    for row in wanted:
        if row.minutes > most:
            print(f"left out, {row.minutes:g} minutes: {row.fault}")
            continue
        print(f"{row.fault}: {row.command}", flush=True)
        results.append(ran(row))
        good = "as stated" if results[-1]["status"] == 0 else "NOT as stated"
        print(f"    {good}, {results[-1]['seconds']} s: {results[-1]['said']}")
        write("reliability", {"rows": results}, _OUTPUT.value)
    failed = [one["fault"] for one in results if one["status"] != 0]
    print(f"{len(results)} rows, {len(failed)} not as stated: {', '.join(failed)}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    run(main)

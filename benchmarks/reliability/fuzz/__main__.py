"""Damaged and hostile files for every reader, very many of them.

    python -m benchmarks.reliability.fuzz --inputs=1000000 --output=benchmarks/results

Each reader runs in a process of its own, in which an input may take 10 s and 2 GiB,
and may open, write and start nothing outside its folder. It has to return, or to raise
`InputError` of one line that names the file. Coverage
of our code guides the inputs (atheris, of requirements/fuzz.lock; without it
`--unguided` draws them at random). Most are made inside of
their form: checksums, lengths and compression are right, what they hold is not.
`--copies=3000` puts one piece (row, element, field, item) so often into a file.

Writes fuzz.json (fuzz_copies.json with --copies), a row per reader, and under
OUTPUT/crashes the inputs that broke a promise; one of these makes the exit status 1.
`unforeseen` counts the lines by which the last net of the importers refused an input,
and the place in the code that each names.
"""

import contextlib
import dataclasses
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from absl import flags

from benchmarks.reliability.fuzz import child

with child.instrumented():
    from benchmarks.common import write
    from benchmarks.reliability.fuzz.readers import READERS, shares
    from rcirl_jax.commands.flags.common import run
    from rcirl_jax.errors import InputError
    from rcirl_jax.runtime.atomic_files import write_json

_INPUTS = flags.DEFINE_integer("inputs", 1_000_000, "over all readers", 1)
_READERS = flags.DEFINE_list("readers", ["all"], "which of them")
_SECONDS = flags.DEFINE_integer("seconds", 3600, "at most so long a reader", 1)
_SEED = flags.DEFINE_integer("seed", 0, "of the inputs")
_COPIES = flags.DEFINE_integer("copies", 0, "most of one piece, at random; 0: a few", 0)
_UNGUIDED = flags.DEFINE_bool("unguided", False, "at random, without atheris")
_OUTPUT = flags.DEFINE_string("output", "benchmarks/results", "folder of the JSON")
SLACK_S = 60.0  # s for seeds, on top of what a reader is given
# "#1500 DONE cov: 699 ft: 1863 corp: 141/156Kb ...", libFuzzer's last line
PROGRESS = re.compile(r"#\d+\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)/")
ENDED = re.compile(r"stat::number_of_executed_units:\s*(\d+)")
PEAK = re.compile(r"stat::peak_rss_mb:\s+(\d+)")


@dataclasses.dataclass(kw_only=True)
class Row:
    """What came of one reader."""

    reader: str
    inputs: int = 0
    mutator: str = ""
    corpus: int = 0  # inputs that reached something new
    covered: int = 0  # edges of our code, libFuzzer's cov
    features: int = 0  # and how often each was taken, its ft
    crashes: list[str] = dataclasses.field(default_factory=list)
    unforeseen: dict[str, int] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0
    slowest_s: float = 0.0
    peak_mib: int = 0
    command: str = ""


def chosen() -> list[str]:
    """The readers asked for."""
    names = list(READERS) if _READERS.value == ["all"] else list(_READERS.value)
    for name in names:
        if name not in READERS:
            raise InputError(f"--readers: {name}: expected all or {', '.join(READERS)}")
    return names


def is_guided() -> bool:
    """Whether coverage guides the inputs; many copies get too long for that."""
    return not (_COPIES.value or _UNGUIDED.value)


def _child(name: str, folder: Path, inputs: int, seconds: int) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with (folder / "said.txt").open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    child.fuzz(name, folder, inputs, seconds, _SEED.value, _COPIES.value, is_guided())


def fuzzed(name: str, inputs: int, seconds: int, output: Path) -> Row:
    """All inputs of a reader, in a process of its own."""
    row = Row(
        reader=name,
        mutator=f"{'atheris' if is_guided() else 'at random'}, by form",
        command=f"python -m {child.PACKAGE} --readers={name} --inputs={inputs} "
        f"--seed={_SEED.value} --copies={_COPIES.value}"
        f"{' --unguided' if _UNGUIDED.value else ''}",
    )
    begin = time.monotonic()
    place = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=place) as made:
        folder = Path(made)
        for part in ("corpus", "crashes"):
            (folder / part).mkdir()
        # a fork, so that imports and their instrumentation are paid for once
        process = multiprocessing.get_context("fork").Process(
            target=_child, args=(name, folder, inputs, seconds)
        )
        process.start()
        process.join(seconds + SLACK_S)
        process.kill()
        process.join()
        account(row, folder, process.exitcode or 0)
        if files := sorted((folder / "crashes").iterdir()):
            kept = output / "crashes" / name
            kept.mkdir(parents=True, exist_ok=True)
            for file in files:
                shutil.copy(file, kept)
    row.seconds = round(time.monotonic() - begin, 1)
    return row


def account(row: Row, folder: Path, status: int) -> None:
    """What the process of a reader has left, into its row."""
    found, said = {}, (folder / "said.txt").read_text(errors="replace")
    with contextlib.suppress(OSError):
        found = json.loads((folder / "status.json").read_text())
    counted = [int(x) for x in ENDED.findall(said)]
    row.inputs = max(found.get("inputs", 0), *counted, 0)
    row.slowest_s = found.get("slowest_s", 0.0)
    row.unforeseen = found.get("unforeseen", {})
    row.crashes = found.get("breaches", [])
    for line in PROGRESS.findall(said)[-1:]:
        row.covered, row.features, row.corpus = map(int, line)
    row.peak_mib = max(map(int, PEAK.findall(said)), default=0)
    if status != 0:
        reason = re.findall(r"SUMMARY: (.*)", said) or said.strip().splitlines() or [""]
        row.crashes.append(f"process: {status}: {reason[-1][:200]}")


def main() -> None:
    """Fuzz the readers; exit status 1 if any broke a promise or inputs are missing."""
    names, output = chosen(), Path(_OUTPUT.value)
    if is_guided() and not child.has_atheris():
        raise InputError("atheris: not installed: expected, or --unguided")
    result = "fuzz_copies" if _COPIES.value else "fuzz"
    output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for name, inputs in shares(names, _INPUTS.value).items():
        row = fuzzed(name, inputs, _SECONDS.value, output)
        rows.append(row)
        print(
            f"{name}: {row.inputs:,} inputs, {row.seconds:.0f} s, corpus {row.corpus}, "
            f"features {row.features}, crashes {len(row.crashes)}, "
            f"unforeseen {sum(row.unforeseen.values())}",
            *(f"  {line}" for line in row.crashes),
            sep="\n",
            flush=True,
        )
        write_json(output / f"{result}.json", {"rows": rows})
    limits = {"seconds": child.MAX_S, "bytes": child.MAX_BYTES}
    write(result, {"rows": rows, "limits": limits}, str(output))
    total = sum(row.inputs for row in rows)
    broken = sum(len(row.crashes) for row in rows)
    print(f"{total:,} inputs, {broken} crashes")
    if total < _INPUTS.value:
        print(f"expected {_INPUTS.value:,} inputs: give it more --seconds")
    if broken or total < _INPUTS.value:
        sys.exit(1)


if __name__ == "__main__":
    run(main)

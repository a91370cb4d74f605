"""One reader under the fuzzer, in a process that may die.

Its folder has corpus/ and crashes/ of the reader; status.json says how far it is and
what was broken. Coverage of our code guides what is tried next (atheris), or inputs
are drawn at random.
"""

import contextlib
import gc
import hashlib
import importlib
import importlib.util
import io
import json
import os
import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

MAX_S = 10  # s that one input may take
MAX_BYTES = 2 * 2**30  # bytes of memory on top of what the imports take
PACKAGE = "benchmarks.reliability.fuzz"
INSTRUMENTED = {"rcirl_jax", "tomllib", "defusedxml"}
EVERY_S = 1.0  # s between two writings of the status


def has_atheris() -> bool:
    """Whether coverage can guide."""
    return importlib.util.find_spec("atheris") is not None


class Session:
    """Runs inputs and keeps account."""

    def __init__(self, name: str, folder: Path, seed: int) -> None:
        """Make the reader's target; our code is imported here, not before."""
        readers, self._contract, self._forms, logs = (
            importlib.import_module(f"{PACKAGE}.{module}")
            for module in ("readers", "contract", "forms", "logs")
        )
        logs.parse_once()
        work = folder / "work"
        self.reader = readers.READERS[name]
        self.target = self.reader.make(work)
        self._folder, self._rng, self._last = folder, random.Random(seed), 0.0
        self.inputs, self._slowest = 0, 0.0
        self._breaches: dict[str, str] = {}  # kind -> file and text of the first
        self._unforeseen: dict[str, int] = {}
        self._watch = self._contract.Watch(folder)
        tempfile.tempdir = str(work)

    def run(self, data: bytes) -> None:
        """Read one input; note what it broke."""
        self.inputs += 1
        self.target.put(data)
        elsewhere = self.target.names_paths(data)
        begin = time.perf_counter()
        with self._watch:
            breach, line = self._contract.verdict(
                self.target.read, self.target.names, elsewhere
            )
        spent = time.perf_counter() - begin
        broken = self._contract.broken_by(breach, self._watch.seen, elsewhere)
        if spent > MAX_S:
            broken.append(self._contract.Breach("too long", f"{spent:.0f} s"))
        self._slowest = max(self._slowest, spent)
        for place in self._contract.UNFORESEEN.findall(line or ""):
            if place not in self._unforeseen:
                self._keep(data, "unforeseen")
            self._unforeseen[place] = self._unforeseen.get(place, 0) + 1
        for breach in broken:
            if breach.kind not in self._breaches:
                kept = self._keep(data, "breach")
                self._breaches[breach.kind] = f"{kept}: {breach.kind}: {breach.text}"
        if begin - self._last > EVERY_S:
            self._last = begin
            self.write_status()

    def mutate(self, data: bytes, most: int, seed: int, plain: Any = None) -> bytes:  # noqa: ANN401
        """Another input, made from one."""
        rng = random.Random(seed)
        index = self.target.index(data)
        if rng.random() < 0.05 or not data:
            index = rng.randrange(len(self.target.seeds))
            data = bytes([index]) + self.target.seeds[index]
        if plain is not None and rng.random() < 0.3:
            made = plain(data[1:], most - 1)
        else:
            made = self._forms.mutate(data[1:], self.target.forms[index], rng)
        return bytes([index]) + made[: most - 1]

    def draw(self) -> bytes:
        """A mutated seed, without anything that guides."""
        data = b""
        for _ in range(self._rng.choice((1, 1, 2, 3))):
            data = self.mutate(data, 2**22, self._rng.getrandbits(32))
        return data

    def write_status(self) -> None:
        """How far it is."""
        found = {
            "inputs": self.inputs,
            "slowest_s": round(self._slowest, 3),
            "unforeseen": self._unforeseen,
            "breaches": [*self._breaches.values()],
        }
        path = self._folder / "status.json"
        path.with_suffix(".new").write_text(json.dumps(found))
        path.with_suffix(".new").rename(path)

    def _keep(self, data: bytes, what: str) -> str:
        name = f"{what}-{hashlib.sha256(data).hexdigest()[:12]}"
        (self._folder / "crashes" / name).write_bytes(data)
        return name


def guided(session: Session, folder: Path, arguments: list[str]) -> None:
    """libFuzzer, guided by coverage; does not return."""
    import atheris

    longest = max(map(len, session.target.seeds))
    for index, seed in enumerate(session.target.seeds):
        (folder / "corpus" / f"seed-{index:02d}").write_bytes(bytes([index]) + seed)
    escaped = ["".join(f"\\x{b:02x}" for b in w.encode()) for w in session.reader.words]
    (folder / "words").write_text("".join(f'"{x}"\n' for x in escaped) or '"0"\n')
    most = psutil.Process().memory_info().rss + MAX_BYTES
    flags = [
        f"-timeout={MAX_S}",
        f"-rss_limit_mb={most // 2**20}",
        f"-max_len={longest + 2048}",
        f"-artifact_prefix={folder}/crashes/",
        f"-dict={folder}/words",
        *("-print_final_stats=1", "-len_control=0", "-use_value_profile=0"),
    ]

    def mutator(data: bytes, most: int, seed: int) -> bytes:
        return session.mutate(data, most, seed, atheris.Mutate)

    given = ["fuzz", *flags, *arguments, str(folder / "corpus")]
    atheris.Setup(given, session.run, custom_mutator=mutator)
    atheris.Fuzz()


@contextlib.contextmanager
def instrumented() -> Iterator[None]:
    """What is imported of our code meanwhile counts its edges, with atheris."""
    if not has_atheris():
        yield
        return
    from atheris.import_hook import HookManager

    # comparisons are not traced: that takes twice the time, and files are changed
    # inside of their form anyway
    hook = HookManager(INSTRUMENTED, set(), True, trace_dataflow=False)
    with contextlib.redirect_stderr(io.StringIO()), hook:
        yield
        importers = importlib.import_module("rcirl_jax.data.importers")
        for name in importers.IMPORTERS:
            importlib.import_module(f"{importers.__name__}.{name}.reader")


def fuzz(
    name: str,
    folder: Path,
    inputs: int,
    seconds: int,
    seed: int,
    copies: int,
    guide: bool,
) -> None:
    """Fuzz one reader in this process; it may not return.

    At most `copies` of a piece, if not 0; guided by coverage (atheris) or at random.
    """
    changes = importlib.import_module(f"{PACKAGE}.changes")
    changes.COPIES = copies or changes.COPIES
    session, end = Session(name, folder, seed), time.monotonic() + seconds
    for index, content in enumerate(session.target.seeds):
        session.run(bytes([index]) + content)
    gc.collect()
    gc.freeze()  # what the imports made is never looked through again
    mapped = psutil.Process().memory_info().vms + MAX_BYTES
    psutil.Process().rlimit(psutil.RLIMIT_AS, (mapped, mapped))
    if guide:
        limits = [f"-runs={inputs}", f"-max_total_time={seconds}", f"-seed={seed}"]
        guided(session, folder, limits)
    while session.inputs < inputs and time.monotonic() < end:
        session.run(session.draw())
    session.write_status()
    os._exit(0)  # without what libraries do at the end of a fork

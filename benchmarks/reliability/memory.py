"""Memory over time: who looks at it, and when it counts as growth."""

import contextlib
import ctypes
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import psutil
from scipy import stats

WARM_UP = 0.25  # share of a series of rounds before it is watched: programs, pools
LOOKS = 3  # rounds at either end that a count is compared in
SHARE, MB = 0.10, 200.0  # growth allowed to a phase of work: the larger of the two
PEAK_MB = 1_000.0  # that a moment may hold above that


class _Malloc(ctypes.Structure):
    """glibc's mallinfo2 (2.33), bytes over all arenas."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd",
            "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    ]  # fmt: skip


def in_use_mb() -> float:
    """Returns what malloc has given and not got back, MiB.

    Resident memory has the room besides that it keeps or gives back as it likes, and
    falls by hundreds of MiB at once.
    """
    ask = ctypes.CDLL(None).mallinfo2
    ask.restype = _Malloc
    found = ask()
    return (found.uordblks + found.hblkhd) / 2**20


def watched(values: Sequence[float]) -> np.ndarray:
    """A series of one value a round, without the warm-up."""
    return np.asarray(values, np.float64)[int(WARM_UP * len(values)) :]


def rise(values: Sequence[float]) -> float:
    """By how much a series of one value a round has risen over the watched rounds.

    Told by the slope of Theil (1950) and Sen (1968), the median of the slopes between
    all pairs of rounds: a spike, or noise around a level, does not move it.
    """
    left = watched(values)
    found = np.asarray(stats.theilslopes(left, np.arange(left.size)), np.float64)
    return float(found[0]) * (left.size - 1)


def kept(counts: Sequence[float]) -> float:
    """How many more things all of the last rounds have than any of the first watched.

    One thing kept once does not move a slope; a number that now and then is one
    higher is no growth.
    """
    left = watched(counts)
    return float(left[-LOOKS:].min() - left[:LOOKS].max())


def level(held: Sequence[float]) -> tuple[dict[str, float], list[str]]:
    """Memory [MiB] of a phase of work, looked at evenly; what is wrong with it.

    Its second tenth is compared with its ninth, so that neither start nor end counts.
    """
    tenths = np.array_split(np.asarray(held, np.float64), 10)
    before, after = float(np.median(tenths[1])), float(np.median(tenths[8]))
    found = {"early_mb": before, "late_mb": after, "at_most_mb": max(held)}
    allowed, limit = max(SHARE * before, MB), max(before, after) + PEAK_MB
    problems = []
    if after - before > allowed:
        problems.append(f"grew by {after - before:.0f} MiB, expected {allowed:.0f}")
    if max(held) > limit:
        problems.append(f"held {max(held):.0f} MiB, expected {limit:.0f} at most")
    return {name: round(value, 1) for name, value in found.items()}, problems


def held_mb(pid: int) -> float:
    """Resident memory of a process and all below it; shared pages count in each."""
    total = 0
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        for one in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess):
                total += one.memory_info().rss
    return total / 2**20


@contextlib.contextmanager
def looking(pid: int, seconds: float) -> Iterator[list[float]]:
    """Looks at a process so often inside the `with` block; MiB of each look."""
    over, held = threading.Event(), []

    def looks() -> None:
        while not over.wait(seconds):
            held.append(held_mb(pid))

    thread = threading.Thread(target=looks, daemon=True)
    thread.start()
    try:
        yield held
    finally:
        over.set()
        thread.join()

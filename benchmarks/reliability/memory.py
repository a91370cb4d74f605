"""Memory over time: who looks at it, and when it counts as growth.

Growth is told by the slope of Theil (1950) and Sen (1968), the median of the slopes
between all pairs of points: a spike, or noise around a level, does not move it. Its
interval (Sen's) takes the points as independent; those of a process are not quite.
"""

import contextlib
import ctypes
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import psutil
from numpy.typing import ArrayLike
from scipy import stats

WARM_UP = 0.25  # share of a series before it is watched: programs, pools, buffers
LEAST = 4  # points that a slope is taken from
LOOKS = 3  # rounds at either end that a count is compared in
MOST = 500  # points that a slope is taken from: all pairs of them are compared
SHARE, MB = 0.05, 50.0  # growth allowed to a series of rounds: the larger of the two
PHASE_SHARE, PHASE_MB = 0.10, 200.0  # and to a phase, from its second tenth to its last
PEAK_MB = 1_000.0  # that a moment may hold above the level
# and to what ends an import: 160 to 420 were seen, the most of 10 million scenes, whose
# index would take more in Python's objects
FINISHING_MB = 600.0
BOUNDED = "bounded"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Growth:
    """How a series rises after its warm-up."""

    per_round: float
    # 95 % interval of it
    low: float
    high: float
    rounds: int  # that were watched
    # over the watched rounds, and what is allowed
    by: float
    allowed: float
    # by more than allowed, and shown to rise at all
    grows: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample:
    """One look at a process."""

    seconds: float
    mb: float  # resident, MiB
    all_mb: float  # with all processes below it; shared pages count in each
    done: float  # of the work, in its own unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Level:
    """Memory of a phase of work, MiB."""

    after_a_tenth: float  # median while the second tenth is done
    at_the_end: float  # median while the last tenth is done
    at_most: float
    grown: float
    allowed: float
    # per unit of work in the second half, when buffers and pools are full; interval
    mb_per_unit: tuple[float, float, float]
    outcome: str  # bounded, or what it is instead


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
    """What malloc has given and not got back, MiB.

    Resident memory has the room besides that it keeps or gives back as it likes, and
    falls by hundreds of MiB at once.
    """
    ask = ctypes.CDLL(None).mallinfo2
    ask.restype = _Malloc
    found = ask()
    return (found.uordblks + found.hblkhd) / 2**20


def growth(values: ArrayLike, allowed: float = 0.0, *, counted: bool = False) -> Growth:
    """Whether a series of one value a round grows; the warm-up is dropped here.

    Of counted things more than `allowed` kept is growth: all of the last `LOOKS`
    rounds have so many more than any of the first that are watched. One thing kept
    once does not move the slope, which is the median of pairs; a number that now and
    then is one higher is no growth.

    Args:
      values: one a round, from the first on.
      allowed: rise over the watched rounds that does not count.
      counted: they are numbers of things.

    Raises:
      ValueError: too few rounds to tell.
    """
    watched = _watched(values)
    if watched.size < LEAST:
        raise ValueError(f"{watched.size} rounds: expected {LEAST} after the warm-up")
    slope, low, high = _slope(np.arange(watched.size), watched)
    by = slope * (watched.size - 1)
    grows = bool(by > (0.5 if counted else allowed) and low > 0.0)
    kept = float(watched[-LOOKS:].min() - watched[:LOOKS].max())
    if counted and kept > allowed:
        by, grows = max(by, kept), True
    return Growth(
        per_round=slope,
        low=low,
        high=high,
        rounds=watched.size,
        by=by,
        allowed=allowed,
        grows=grows,
    )


def memory_growth(values: ArrayLike) -> Growth:
    """Of a series of MiB: more than `SHARE` of it and more than `MB` is growth."""
    return growth(values, max(SHARE * float(np.median(_watched(values))), MB))


def _watched(values: ArrayLike) -> np.ndarray:
    """Without the warm-up."""
    every = np.asarray(values, np.float64)
    return every[int(WARM_UP * every.size) :]


def level(samples: Sequence[Sample], total: float) -> Level:
    """What memory does in a phase of `total` units of work.

    Raises:
      ValueError: it was not looked at often enough.
    """
    done = np.array([sample.done for sample in samples]) / total
    mb = np.array([sample.all_mb for sample in samples])
    early, late = mb[(done >= 0.1) & (done <= 0.2)], mb[done >= 0.9]
    half = done >= 0.5
    if not early.size or not late.size or half.sum() < LEAST:
        raise ValueError(f"{len(samples)} looks at memory: expected more in each tenth")
    before, after = float(np.median(early)), float(np.median(late))
    allowed, at_most = max(PHASE_SHARE * before, PHASE_MB), float(mb.max())
    held = too_much(at_most, max(before, after) + PEAK_MB)
    outcome = held[0] if held else BOUNDED
    if after - before > allowed:
        outcome = f"grew by {after - before:.0f} MiB"
    return Level(
        after_a_tenth=before,
        at_the_end=after,
        at_most=at_most,
        grown=after - before,
        allowed=allowed,
        mb_per_unit=_slope(done[half] * total, mb[half]),
        outcome=outcome,
    )


def too_much(at_most: float, limit: float) -> list[str]:
    """What is wrong with having held so much [MiB]; nothing up to the limit."""
    return [f"held {at_most:.0f} MiB, expected {limit:.0f} at most"][: at_most > limit]


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Slope and its interval; of some of the points where there are many."""
    at = np.unique(np.linspace(0, x.size - 1, MOST).astype(int))
    if np.ptp(x[at]) == 0.0:
        return 0.0, 0.0, 0.0
    found = np.asarray(stats.theilslopes(y[at], x[at]), np.float64)
    slope, _, low, high = found.tolist()
    return slope, low, high


class Watch:
    """Looks at a process and all below it, now or again and again."""

    def __init__(self, pid: int, done: Callable[[], float]) -> None:
        """Of the process `pid`; `done` says how much of the work is done."""
        self.samples: list[Sample] = []
        self._process, self._done = psutil.Process(pid), done
        self._begin = time.monotonic()

    def look(self) -> None:
        """Look once, now; a process that has ended is not seen."""
        with contextlib.suppress(psutil.NoSuchProcess):
            own, below = self._process.memory_info().rss, 0
            for child in self._process.children(recursive=True):
                with contextlib.suppress(psutil.NoSuchProcess):
                    below += child.memory_info().rss
            sample = Sample(
                seconds=time.monotonic() - self._begin,
                mb=own / 2**20,
                all_mb=(own + below) / 2**20,
                done=self._done(),
            )
            self.samples += [sample] if own else []

    @contextlib.contextmanager
    def every(self, seconds: float) -> Iterator[None]:
        """Look so often inside the `with` block."""
        over = threading.Event()

        def looks() -> None:
            while not over.wait(seconds):
                self.look()

        thread = threading.Thread(target=looks, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def thinned(samples: Sequence[Sample], most: int = 200) -> list[Sample]:
    """At most so many, evenly over time, for a file."""
    at = np.unique(np.linspace(0, len(samples) - 1, most).astype(int))
    return [samples[place] for place in at] if samples else []

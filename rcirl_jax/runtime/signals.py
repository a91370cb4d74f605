"""SIGTERM and SIGINT: save what can be saved, then end within ten seconds.

Work is written so that a kill at any moment loses nothing but time. Told to end, a
command stops where it stands; a training first finishes its step and saves it. The
exit status is 128 + the signal's number: 143 for SIGTERM, 130 for SIGINT.

Python hears a signal between two of its own instructions, and a compilation can take
a minute: a thread ends the process after `GRACE_S` whatever the main one does. A
second SIGINT ends it at once.
"""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

GRACE_S = 8.0  # s from the signal to the end of the process, at most
SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Interrupted(BaseException):
    """The process was told to end; not an Exception, so that nothing goes on."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class _Heard:
    """The signal this process was sent, and whether somebody asks for it later."""

    number: int | None = None
    waits: bool = False  # somebody asks for it at a better moment


def install() -> None:
    """Handles both signals from now on; in the main thread, once."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    for number in SIGNALS:
        signal.signal(number, _hear)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    threading.Thread(target=_end_in_time, args=(read,), daemon=True).start()


def _hear(number: int, _: FrameType | None) -> None:
    if _Heard.number is not None:
        return  # it is ending already
    _Heard.number = number
    if not _Heard.waits:
        raise Interrupted(number)


def _end_in_time(read: int) -> None:
    """Waits for the first signal, gives the main thread its time, ends the process."""
    number = 0
    while number not in SIGNALS:
        number = os.read(read, 1)[0]
    deadline = time.monotonic() + GRACE_S
    while select.select([read], [], [], max(deadline - time.monotonic(), 0.0))[0]:
        if os.read(read, 1)[0] == signal.SIGINT:
            break
    leave(number, "in the middle of a computation; ")


def leave(number: int, why: str = "") -> NoReturn:
    """Prints one line and ends now; workers see their parent gone and end as well."""
    name = signal.Signals(number).name
    line = f"stopped by {name}: {why}the same command goes on from here\n"
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.write(line)
        sys.stderr.flush()
    os._exit(128 + number)


@contextlib.contextmanager
def asked() -> Iterator[Callable[[], int | None]]:
    """Defers signals inside the block; yields what asks for the number, or None.

    Raises:
      Interrupted: at the end, if nobody asked.
    """
    before, _Heard.waits = _Heard.waits, True
    try:
        yield lambda: _Heard.number
    finally:
        _Heard.waits = before
    if _Heard.number is not None and not before:
        raise Interrupted(_Heard.number)

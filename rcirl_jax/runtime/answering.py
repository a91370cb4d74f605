"""A program that answers what it is asked over stdin and stdout, in limited time.

Either side may be slow, silent, dead or babbling: whatever happens, an answer or one
line on why there is none comes within the limit. Two ways of writing: named arrays
after their length, for processes of this package, and lines, for those of users.
"""

import contextlib
import io
import os
import select
import signal
import struct
import subprocess
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

LONGEST_LINE = 2**20  # bytes of an answer that is a line


class NoAnswer(Exception):
    """Says why a program gave no answer; it has been ended."""


class TooLate(NoAnswer):
    """Says that none came in time."""


def packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Named arrays as an npz after its length."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return struct.pack("<Q", file.tell()) + file.getvalue()


def unpacked(npz: bytes) -> dict[str, np.ndarray]:
    """The named arrays of an npz."""
    with np.load(io.BytesIO(npz), allow_pickle=False) as found:
        return dict(found)


class AnsweringProcess:
    """A process that is asked one thing at a time; by one thread at a time."""

    def __init__(self, command: Sequence[str]) -> None:
        """Starts it; its standard error is ours.

        Raises:
          OSError: it cannot be started.
        """
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout
        os.set_blocking(self._to, False)
        self._unread = b""
        self._finalizer = weakref.finalize(self, _end, self._process)

    def end(self) -> None:
        """Ends it and what it has started."""
        self._finalizer()

    def ask(
        self, given: Mapping[str, np.ndarray], limit: float
    ) -> dict[str, np.ndarray]:
        """Sends named arrays, and returns those that come back.

        Raises:
          NoAnswer: none came in `limit` s.
        """
        until = time.monotonic() + limit
        with self._limited(limit):
            self._write(packed(given), until)
            (length,) = struct.unpack("<Q", self._taken(8, until))
            return unpacked(self._taken(length, until))

    def ask_line(self, line: bytes, limit: float) -> bytes:
        """Sends a line, and returns the one that comes back, both without their end.

        Raises:
          NoAnswer: none came in `limit` s, or one came before it was asked.
        """
        until = time.monotonic() + limit
        with self._limited(limit):
            if self._is_ready(0.0):
                self._more()
            if self._unread:
                said = self._unread[:80].decode(errors="replace")
                raise NoAnswer(f"{said!r} without being asked")
            self._write(line + b"\n", until)
            while b"\n" not in self._unread:
                if len(self._unread) > LONGEST_LINE:
                    raise NoAnswer(f"a line longer than {LONGEST_LINE:,} bytes")
                self._read(until)
            answer, _, self._unread = self._unread.partition(b"\n")
            return answer

    @contextlib.contextmanager
    def _limited(self, limit: float) -> Iterator[None]:
        """Turns what may go wrong into `NoAnswer`, after the process was ended."""
        try:
            yield
        except TimeoutError:
            self.end()
            raise TooLate(f"no answer in {limit:g} s") from None
        except (EOFError, BrokenPipeError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            self.end()
            status = self._process.wait()
            raise NoAnswer(f"its process ended with status {status}") from None
        except NoAnswer:
            self.end()
            raise

    def _write(self, data: bytes, until: float) -> None:
        left, ready = memoryview(data), select.poll()
        ready.register(self._to, select.POLLOUT)
        while left:
            wait = until - time.monotonic()
            if wait <= 0.0 or not ready.poll(1e3 * wait):
                raise TimeoutError
            left = left[os.write(self._to, left) :]

    def _is_ready(self, wait: float) -> bool:
        """True if something can be read within `wait` s."""
        ready = select.poll()
        ready.register(self._from, select.POLLIN)
        return bool(ready.poll(1e3 * wait))

    def _more(self) -> None:
        """Reads what is there; raises EOFError at its end."""
        part = os.read(self._from.fileno(), 2**16)
        if not part:
            raise EOFError
        self._unread += part

    def _read(self, until: float) -> None:
        """Waits for more and reads it."""
        wait = until - time.monotonic()
        if wait <= 0.0 or not self._is_ready(wait):
            raise TimeoutError
        self._more()

    def _taken(self, size: int, until: float) -> bytes:
        while len(self._unread) < size:
            self._read(until)
        taken, self._unread = self._unread[:size], self._unread[size:]
        return taken


def _end(process: subprocess.Popen) -> None:
    """Kills a process and its children, and waits until it is gone."""
    with contextlib.suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):
            pipe.close()  # type: ignore[union-attr]
    process.wait()

"""A reader with what it reads: one file of several is another at a time."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.reliability.fuzz.forms import form_of


class Target:
    """A reader and the sound content of every file it reads.

    An input is one byte, which of the files, and what that file holds instead. The
    others are sound.
    """

    def __init__(
        self,
        read: Callable[[], object],
        files: Sequence[Path],
        names: Sequence[str] = (),
        after: Callable[[int], None] = lambda index: None,
    ) -> None:
        """Note what the files hold.

        Args:
          read: everything the reader does.
          files: those that inputs stand for, sound as they are.
          names: what else counts as a file's name in a refusal.
          after: called with the number of the file just written, to make the sums of
            other files fit.
        """
        self.read = read
        self.forms = [form_of(file.name) for file in files]
        self.seeds = [file.read_bytes() for file in files]
        self.names = (*{str(file.parent) for file in files}, *names)
        self._files, self._after = files, after
        self._changed: int | None = None

    def names_paths(self, data: bytes) -> bool:
        """Whether the input may name files anywhere: a user's own options."""
        return self.forms[self.index(data)] == "toml"

    def index(self, data: bytes) -> int:
        """Which file an input stands for."""
        return data[0] % len(self.seeds) if data else 0

    def put(self, data: bytes) -> None:
        """Write the input's file; the one before is sound again."""
        index = self.index(data)
        if self._changed not in (None, index):
            self._files[self._changed].write_bytes(self.seeds[self._changed])
        self._files[index].write_bytes(data[1:])
        self._changed = index
        self._after(index)


class OneFile(Target):
    """A reader of single files: it is given the one that the input stands for."""

    def __init__(self, read: Callable[[Path], object], files: list[Path]) -> None:
        """Args as of `Target`."""
        super().__init__(lambda: read(self._files[self._changed or 0]), files)


class Bytes(Target):
    """A reader of bytes in memory; each seed is an input of its own form."""

    def __init__(
        self,
        read: Callable[[bytes], object],
        seeds: Sequence[tuple[str, bytes]],
        names: Sequence[str],
    ) -> None:
        """Args as of `Target`; a seed is (form, content)."""
        self.forms = [form for form, _ in seeds]
        self.seeds = [content for _, content in seeds]
        self.names = tuple(names)
        self.read = lambda: read(self._data)
        self._data = b""

    def put(self, data: bytes) -> None:
        """Hold the input."""
        self._data = data[1:]


class Several(Target):
    """Targets of one reader after one another, each with its own files."""

    def __init__(self, targets: Sequence[Target]) -> None:
        """The first input bytes stand for the first target's files, and so on."""
        self.forms = [form for target in targets for form in target.forms]
        self.seeds = [seed for target in targets for seed in target.seeds]
        self.names = tuple(name for target in targets for name in target.names)
        self._owners = [(t, i) for t in targets for i in range(len(t.seeds))]
        self._last = targets[0]
        self.read = lambda: self._last.read()

    def put(self, data: bytes) -> None:
        """Write the input's file."""
        self._last, own = self._owners[self.index(data)]
        self._last.put(bytes([own]) + data[1:])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reader:
    """How a target is made, and its share of all inputs."""

    make: Callable[[Path], Target]
    share: int = 1
    words: tuple[str, ...] = ()  # that libFuzzer may put in

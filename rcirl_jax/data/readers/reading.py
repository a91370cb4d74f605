"""A bar of its own for an input that is read for long before it gives a recording."""

import contextlib
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import tqdm

DELAY_S = 2.0  # s; what is read faster shows no bar


@contextlib.contextmanager
def reading(path: Path, files: Sequence[Path]) -> Iterator[Callable[[int], object]]:
    """Gives a function to be called with the bytes just read of the files.

    The bar stands below that of the import, shows bytes/s and the time left, and
    goes when all is read. Processes that the import started show none.
    """
    with tqdm.tqdm(
        total=sum(file.stat().st_size for file in files if file.is_file()),
        desc=f"{path.name}: read",
        unit="B",
        unit_scale=True,
        unit_divisor=1024,
        leave=False,
        delay=DELAY_S,
        mininterval=0.5,
        disable=multiprocessing.parent_process() is not None,
    ) as bar:
        # the last piece may be short
        yield lambda size: bar.update(min(size, bar.total - bar.n))

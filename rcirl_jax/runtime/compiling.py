"""Compilation by XLA: options for long loops on a CPU, seconds, and the cache."""

import contextlib
import functools
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import jax
import tqdm

# XLA takes 256 bits by itself; a processor without wider vectors ignores it
WIDE = {"xla_cpu_prefer_vector_width": 512}
NOTE = "compiling first"
COMPILED = "/jax/core/compile/backend_compile_duration"


@functools.cache
def wide_vectors() -> dict[str, int] | None:
    """`compiler_options` of `jax.jit` for long loops over floats: the widest vectors.

    None where XLA does not know the option, which is none of its public ones, and on
    devices other than a CPU.
    """
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0.0, compiler_options=WIDE)()
    except (jax.errors.JaxRuntimeError, ValueError):  # "No such compile option"
        return None
    return WIDE


CACHE_BYTES = 2 * 2**30  # of compiled programs that are kept


def use_cache(most: int = CACHE_BYTES) -> Path | None:
    """Keeps compiled programs from process to process, in JAX's compilation cache.

    The folder is that of JAX_COMPILATION_CACHE_DIR, which is left alone, or rcirl-jax
    in the user's folder of caches. Of the latter the oldest programs are removed until
    the others take `most` bytes. Workers keep theirs in it too.

    Returns:
      The folder; None where it cannot be written: nothing is kept then.
    """
    if given := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "rcirl-jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = [(x.stat().st_mtime, x.stat().st_size, x) for x in folder.iterdir()]
        kept = 0
        for _, size, file in sorted(files, reverse=True):
            kept += size
            if kept > most:
                file.unlink(missing_ok=True)
        if not os.access(folder, os.W_OK):
            return None
    except (OSError, RuntimeError):  # no home
        return None
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)  # of workers
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return folder


@contextlib.contextmanager
def compiles(name: str | None = None) -> Iterator[list[float]]:
    """Yields the seconds of each compilation inside the block, in any thread.

    Args:
      name: of the one program that counts, as JAX has it: "jit(function)"; None: all.
    """
    found: list[float] = []
    lock = threading.Lock()

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == COMPILED and name in (None, kwargs.get("fun_name")):
            with lock:
                found.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


class CompilesFirst(tqdm.tqdm):
    """A tqdm bar with a note that it compiles, until the first update."""

    def __init__(self, **given) -> None:  # noqa: ANN003
        super().__init__(**given)
        self.set_postfix_str(NOTE)

    def update(self, n: float | None = 1) -> bool | None:
        """Counts, and removes the note."""
        if self.postfix == NOTE:
            self.set_postfix_str("", refresh=False)
        return super().update(n)

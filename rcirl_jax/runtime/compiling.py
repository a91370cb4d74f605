"""How XLA compiles long loops on a CPU, how long it takes, and a bar that says so."""

import contextlib
import functools
import threading
from collections.abc import Iterator

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

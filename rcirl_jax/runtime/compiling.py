"""How XLA compiles long loops on a CPU, and how long it takes."""

import contextlib
import functools
import threading
from collections.abc import Iterator

import jax

# XLA takes 256 bits by itself; a processor without wider vectors ignores it
WIDE = {"xla_cpu_prefer_vector_width": 512}
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
    """Seconds of each compilation inside the `with` block, in any thread.

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

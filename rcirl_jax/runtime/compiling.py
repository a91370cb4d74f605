"""How long JAX compiles, by its own measurements."""

import contextlib
import threading
from collections.abc import Iterator

import jax

COMPILED = "/jax/core/compile/backend_compile_duration"


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

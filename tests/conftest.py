"""Shared fixtures: eight CPU devices, hypothesis profiles, the recorded data.

Programs are compiled once for all workers and runs: most of the tests' time
would otherwise go into compiling the same ones again.
"""

import ctypes
import gc
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "compiled"),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import pytest
from hypothesis import HealthCheck, settings

jax.config.update("jax_num_cpu_devices", 8)

# Tracing makes millions of small objects that live on: looking through them at every
# seven hundredth is a twelfth of the time of the tests
gc.set_threshold(200_000, 50, 100)

settings.register_profile(
    "ci",
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("nightly", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

REPO = Path(__file__).resolve().parents[1]
# tests, or whole files of them, that `make test` leaves to `make test-all`: a line each
THOROUGH = frozenset((REPO / "tests" / "thorough.txt").read_text().split())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what takes long; the slow ones have a marker of their own."""
    for item in items:
        name = item.nodeid.partition("[")[0]
        if name in THOROUGH or name.partition("::")[0] in THOROUGH:
            item.add_marker(pytest.mark.thorough)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the recorded data, or a skip with the reason."""
    path = Path(os.environ.get("RCIRL_DATA", REPO.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"recorded data not found: set RCIRL_DATA (looked at {path})")
    return path


MAX_RESIDENT_BYTES = 3 * 2**30  # of one test process, between two files


def _resident_bytes() -> int:
    """Memory of this process; 0 where /proc does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module", autouse=True)
def bounded_memory():
    """Forget compiled programs when many have piled up; the cache on disk has them.

    glibc keeps what it is given back (3.4 GB stayed 3.4 GB, trimmed 0.9): untrimmed,
    the caches would be cleared after each file from then on.
    """
    yield
    if _resident_bytes() > MAX_RESIDENT_BYTES:
        jax.clear_caches()
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)

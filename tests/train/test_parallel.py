"""How a batch is shared where nothing is said: by all cores, in a fresh process."""

import os
import subprocess
import sys

import pytest

from rcirl_jax.runtime.provenance import processor

SHOW = (
    "from rcirl_jax.train.parallel import chosen, share_cores; import jax; "
    "{before}share_cores({batch}); print(jax.device_count(), chosen({batch}))"
)


def shown(batch: int, before: str = "", **env: str) -> list[str]:
    """Devices and way that a process takes for a batch."""
    theirs = ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")
    kept = {k: v for k, v in os.environ.items() if k not in theirs}
    done = subprocess.run(
        [sys.executable, "-c", SHOW.format(batch=batch, before=before)],
        env=kept | {"JAX_PLATFORMS": "cpu"} | env,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


def test_every_core_is_a_device_where_they_share_the_batch():
    cores = processor()["cores"]
    want = max(n for n in range(1, cores + 1) if 64 % n == 0 and 64 // n >= 8)
    assert shown(64) == [str(want), "shard_map" if want > 1 else "jit"]


@pytest.mark.parametrize(
    ("batch", "more", "want"),
    [
        (61, {}, ["1", "jit"]),  # they do not share it evenly
        # the user's word
        (64, {"JAX_NUM_CPU_DEVICES": "4"}, ["4", "shard_map"]),
        (64, {"before": "jax.devices();"}, ["1", "jit"]),  # JAX is in use
    ],
)
def test_otherwise_one_device_or_what_the_user_says(batch, more, want):
    assert shown(batch, **more) == want

"""A command of `experiments` on small data, in a process of its own.

    python -m benchmarks.reliability.small MODULE --flags

Shards hold few scenes, so that an import has some to resume from. With
RCIRL_BROKEN_RESUME set, a resumed training forgets where in the data it was: what
compares runs has to notice.
"""

import os
import runpy
import sys

from rcirl_jax.data import importing
from rcirl_jax.data.store import batches as pipeline

SHARD_SCENES = 60
BROKEN = "RCIRL_BROKEN_RESUME"


def main() -> None:
    """Run the module as if it had been called."""
    importing.SHARD_SCENES = SHARD_SCENES
    if os.environ.get(BROKEN):
        pipeline.BatchIterator.restore = lambda self, state: None
    sys.argv = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()

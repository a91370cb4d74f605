"""Where independent pieces of work run."""

from absl import flags

from rcirl_jax.runtime.executors import EXECUTORS, Executor, make_executor

_EXECUTOR = flags.DEFINE_enum(
    "executor", "local", EXECUTORS, "where independent pieces of work run"
)
_WORKERS = flags.DEFINE_integer(
    "workers", 1, "processes at once, 1 or more: as many as cores and memory allow"
)
_RAY = flags.DEFINE_string("ray_address", "auto", "cluster of --executor=ray")


def executor() -> Executor:
    """The executor that the flags name."""
    return make_executor(
        _EXECUTOR.value, workers=_WORKERS.value, ray_address=_RAY.value
    )

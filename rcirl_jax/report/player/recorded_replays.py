"""A few recorded drives, with the human beside the rows that plan."""

import itertools
from collections.abc import Sequence

from rcirl_jax.data.parts import Part, items, recordings_in
from rcirl_jax.errors import InputError
from rcirl_jax.report.player.replays import Replay, make_replays
from rcirl_jax.simulation.recorded.config import RecordedConfig
from rcirl_jax.simulation.rows import Row
from rcirl_jax.simulation.suite import recorded_set

INPUTS = 4  # first inputs that are looked at for a drive
# not more drives, each not longer, than one looks at
CONFIG = RecordedConfig(max_cases=2, max_duration_s=20.0)


def recorded_replays(
    rows: Sequence[Row], parts: Sequence[Part], plan_every: int
) -> list[Replay]:
    """The first recorded drives that can be driven again; none, if there are none.

    Args:
      rows: who drives beside the human.
      parts: the logs; of long ones only the first piece is read.
      plan_every: steps of 0.1 s between two plans.
    """
    for item in itertools.islice(items(parts[:INPUTS], 1), INPUTS):
        found = (recording for _, recording in recordings_in(item))
        try:
            cases = recorded_set(found, CONFIG)
        except InputError:
            continue  # no drive of it can be driven again
        return make_replays(rows, cases, cases.ids, plan_every)
    return []

"""Drive one case of the suite again, as a page that plays it.

    rcirl replay --weights=FILE --case=cut_in/017@0 --output=DIR
    rcirl replay --planner=costs.py:my_cost --case=cut_in/017@0 --output=DIR

`--row` names who drives: the learned reward or the planner (learned, the default),
search, dp, or a baseline. A planner is as in `rcirl simulate`. Writes DIR/case.html,
which begins at the worst moment of the drive; what made it is in it. Needs the extra
[report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.replays import make_replays
from rcirl_jax.simulation.rows import KNOWN_BASELINES
from rcirl_jax.simulation.suite import (
    FULL_S,
    case_duration,
    case_ref,
    catalogue_set,
)

USUAL = ("weights", "planner", "case", "output", "row", "duration")
_WEIGHTS = flags.DEFINE_string("weights", None, "weights file of the learned reward")
_PLANNER = flags.DEFINE_string("planner", None, f"instead: {shared.PLANNER}")
_CASE = flags.DEFINE_string(
    "case", None, "id in a report or cases.csv, as cut_in/017@0", required=True
)
_ROW = flags.DEFINE_enum(
    "row", "learned", ["learned", "search", "dp", *KNOWN_BASELINES], "who drives"
)
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of the drive, 1 to 120")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans", 1)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)


def main() -> None:
    """Flags -> case.html."""
    from rcirl_jax.report.player import write_replay_page

    weights = [_WEIGHTS.value] if _WEIGHTS.value else []
    planners = [("", _PLANNER.value)] if _PLANNER.value else []
    if len(weights) + len(planners) != 1:
        raise InputError("--weights, --planner: expected one of them")
    names = [_ROW.value] if _ROW.value in KNOWN_BASELINES else []
    searches, every = _ROW.value in ("search", "dp"), _EVERY.value
    rows = table_rows(weights, names, dp=searches, planners=planners)
    row = rows[{"learned": 0, "dp": 2}.get(_ROW.value, 1)]
    duration = case_duration("", _DURATION.value)
    cases = catalogue_set([case_ref(_CASE.value)], duration)
    (replay,) = make_replays([row], cases, cases.ids, every)
    facts = provenance(weights)
    page = write_replay_page(Path(_OUTPUT.value) / "case.html", replay, facts)
    (drive,) = replay.drives
    print(f"{replay.case} driven by {drive.row}: {drive.summary}\npage to open: {page}")

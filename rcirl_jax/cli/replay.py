"""Drive one case of the suite again, as a page that plays it.

    rcirl replay --weights=FILE --case=cut_in/017@0 --output=DIR

`--row` names who drives: learned (default), search, dp, or a baseline. Writes
DIR/case.html, which begins at the worst moment of the drive; what made it is in it.
Needs the extra [report].
"""

from pathlib import Path

from absl import flags

from rcirl_jax.cli.running import provenance
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.replays import make_replays
from rcirl_jax.simulation.rows import KNOWN_BASELINES, Row
from rcirl_jax.simulation.suite import (
    FULL_S,
    case_duration,
    case_ref,
    catalogue_set,
)

USUAL = ("weights", "case", "output", "row", "duration")
_WEIGHTS = flags.DEFINE_string(
    "weights", None, "weights file of the learned reward", required=True
)
_CASE = flags.DEFINE_string(
    "case", None, "id in a report or cases.csv, as cut_in/017@0", required=True
)
_ROW = flags.DEFINE_enum(
    "row", "learned", ["learned", "search", "dp", *KNOWN_BASELINES], "who drives"
)
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of the drive, 1 to 120")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans", 1)
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)


def _row() -> Row:
    names = [_ROW.value] if _ROW.value in KNOWN_BASELINES else []
    searches = _ROW.value in ("search", "dp")
    rows = table_rows([_WEIGHTS.value], names, dp=searches)
    at = {"learned": 0, "dp": 2}
    return rows[at.get(_ROW.value, 1)]


def main() -> None:
    """Flags -> case.html."""
    from rcirl_jax.report.player import write_replay_page

    duration = case_duration("", _DURATION.value)
    cases = catalogue_set([case_ref(_CASE.value)], duration)
    (replay,) = make_replays([_row()], cases, cases.ids, _EVERY.value)
    facts = provenance([_WEIGHTS.value])
    page = write_replay_page(Path(_OUTPUT.value) / "case.html", replay, facts)
    (drive,) = replay.drives
    print(f"{replay.case} driven by {drive.row}: {drive.summary}\npage to open: {page}")

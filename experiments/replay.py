"""Drive one case of the suite again and draw it: picture, animation, page.

    python -m experiments.replay --weights=FILE --case=cut_in/017@0 --output=DIR

`--row` names who drives: learned (default), dp, or a baseline. Looks at the
worst moment of the drive; open case.html. What made them is in it and in case.json.
"""

from pathlib import Path

import jax
import numpy as np
from absl import flags

from experiments.common import provenance, run
from rcirl_jax.errors import InputError
from rcirl_jax.export.closed_loop import table_rows
from rcirl_jax.report.case.page import write_case_page
from rcirl_jax.report.case.picture import animate_case, draw_case
from rcirl_jax.runtime.atomic_files import write_json
from rcirl_jax.simulation.rows import BASELINES, Row
from rcirl_jax.simulation.suite import (
    FULL_S,
    build,
    case_ref,
    drive_with_logs,
    rollout_config,
)

_WEIGHTS = flags.DEFINE_string("weights", None, "weights file", required=True)
_CASE = flags.DEFINE_string("case", None, "id, for example cut_in/017@0", required=True)
_ROW = flags.DEFINE_enum("row", "learned", ["learned", "dp", *BASELINES], "who drives")
_DURATION = flags.DEFINE_float("duration", FULL_S, "s of the drive")
_EVERY = flags.DEFINE_integer("plan_every", 1, "steps of 0.1 s between two plans")
_OUTPUT = flags.DEFINE_string("output", None, "folder to write", required=True)


def _row() -> Row:
    names = [_ROW.value] if _ROW.value in BASELINES else []
    wants_dp = _ROW.value == "dp"
    rows = table_rows([_WEIGHTS.value], names, _EVERY.value, dp=wants_dp)
    return rows[0] if _ROW.value == "learned" else rows[1]


def main() -> None:
    """Flags -> case.png, case.gif, case.html, case.json."""
    if not 1.0 <= _DURATION.value <= FULL_S:
        raise InputError(f"--duration: {_DURATION.value}: expected 1 to {FULL_S:g} s")
    ref, row, folder = case_ref(_CASE.value), _row(), Path(_OUTPUT.value)
    cases = build([ref], _DURATION.value)
    config = rollout_config(row, _DURATION.value, _EVERY.value)
    logs = drive_with_logs(row, cases, config)
    one = lambda x: np.asarray(x)[0]  # noqa: E731
    case, found, record, shot = (jax.tree.map(one, x) for x in (cases, *logs))
    title = f"{ref.id} driven by {row.name}"
    folder.mkdir(parents=True, exist_ok=True)
    picture = draw_case(case, record, shot, folder / "case.png", title)
    animation = animate_case(case, record, shot, folder / "case.gif", title)
    scalars = {k: float(v) for k, v in vars(found).items() if np.ndim(v) == 0}
    facts = provenance([_WEIGHTS.value])
    body = {"case": ref.id, "row": row.name, "metrics": scalars, "made_by": facts}
    write_json(folder / "case.json", body)
    page = write_case_page(
        folder / "case.html",
        title,
        f"{float(found.progress):.0f} m driven, {int(found.at_fault)} collisions of "
        f"own fault, closest {float(found.min_clearance):.2f} m.",
        picture=picture,
        animation=animation,
        metrics=scalars,
        facts=facts,
    )
    print(f"{title}: page to open: {page}")


if __name__ == "__main__":
    run(main)

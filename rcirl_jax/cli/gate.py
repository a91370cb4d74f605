"""May a candidate replace the incumbent? Exit status 0 only to ship.

    rcirl gate --candidate=FILE --incumbent=FILE --data=DATASET --output=verdict.json
    rcirl gate --candidate=FILE --incumbent=hand-set --output=verdict.json
    rcirl gate --candidate="planner:./my_planner --flag" --output=verdict.json
    rcirl gate --candidate=new.py:cost --incumbent=old.py:cost --output=verdict.json

Both drive the same closed-loop cases; no learned reward judges. Refused (3)
if the candidate has more cases with a fault than the incumbent, if rates or progress
are worse than the margins allow, if a family loses, if it is behind rewards that know
nothing or farther from the human, or if nothing is better. 2: could not judge: bad
input, too few cases, something not measured, or a part of the suite. docs/gate.md.
"""

import sys
from pathlib import Path

from absl import flags

from rcirl_jax.cli import flags as shared
from rcirl_jax.cli.running import provenance
from rcirl_jax.data.store.dataset import open_dataset
from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.gate.types import DRIVES
from rcirl_jax.evaluation.gate.verdict import write_verdict
from rcirl_jax.evaluation.gate.words import format_verdict
from rcirl_jax.export.closed_loop import (
    checked_planner,
    gate_baselines,
    gate_job,
    judged,
    read_tuned_idm,
)
from rcirl_jax.planner.own_cost import OwnCost, words
from rcirl_jax.planner.safety import TRACKS
from rcirl_jax.simulation.rows import KNOWN_BASELINES

USUAL = (
    *("candidate", "incumbent", "output", "data", "drives", "suite", "cases"),
    *("duration", "tuned_idm", "accept", "primary", "workers"),
)
_CANDIDATE = flags.DEFINE_string(
    "candidate",
    None,
    "what may replace it: a weights file, your own cost (FILE.py:FUNCTION or FILE.so), "
    "or planner:COMMAND, a program that plans",
    required=True,
)
_INCUMBENT = flags.DEFINE_string(
    "incumbent",
    "hand-set",
    "what drives today: a weights file, your own cost (FILE.py:FUNCTION or FILE.so), "
    "planner:COMMAND, a program that plans, or a baseline: "
    + ", ".join(KNOWN_BASELINES),
)
_OUTPUT = flags.DEFINE_string(
    "output", None, "JSON of the verdict to write", required=True
)
_DATA = flags.DEFINE_list(
    "data", [], "datasets whose held-out drives measure nearness to the human"
)
_DRIVES = flags.DEFINE_integer(
    "drives", DRIVES, "of them in all, 1 or more: the more, the narrower the interval"
)
_IDM = flags.DEFINE_string(
    "tuned_idm", None, "RUN/tuned_idm.json of autotune: a tuned IDM drives too"
)
_FILTER = flags.DEFINE_enum(
    "filter", "full", TRACKS, "full; collision: no verdict ships, the reward decides"
)
_EXECUTOR = shared.executor()
_SUITE = shared.suite()
_MARGINS = shared.margins()


def main() -> None:
    """Flags -> one verdict."""
    output = Path(_OUTPUT.value)
    if output.suffix != ".json":
        raise InputError(f"--output: {output}: expected a name that ends in .json")
    output.unlink(missing_ok=True)  # of another gate: not this verdict
    config = _MARGINS()
    job, incumbent = gate_job(
        _CANDIDATE.value,
        _INCUMBENT.value,
        **_SUITE.settings(),
        baselines=gate_baselines(_CANDIDATE.value, config),
        tuned_idm=read_tuned_idm(Path(_IDM.value)) if _IDM.value else None,
        track=_FILTER.value,
    )
    for _, place in job.planners:
        if isinstance(one := checked_planner(place), OwnCost):
            print(words(one))
    if said := shared.idm_left_out(_IDM.value):
        print(said)
    sources = [open_dataset(url) for url in _DATA.value]
    found = judged(job, incumbent, config, _EXECUTOR(), sources, _DRIVES.value)
    if found.likeness is not None:
        print(found.likeness.text())
    verdict = found.verdict
    files = {"candidate": _CANDIDATE.value, "incumbent": _INCUMBENT.value}
    facts = {"files": files, **found.facts, "made_by": provenance(job.weights)}
    if job.planners:
        facts["planners"] = job.planner_facts()
    write_verdict(output, verdict, config, facts)
    print(format_verdict(verdict))
    print(f"written: {output}; exit status {verdict.exit_code}")
    sys.exit(verdict.exit_code)

"""Safety of the gate: no more cases with a fault than another row, up to a margin.

Four offences, each its own check. A case in which the candidate commits more of one
than the other row is lost, one in which it commits fewer is gained; a case that a
person has accepted is neither. With c lost and b gained of n cases:

    pass    the exact paired test shows that (c - b) / n is below the margin
    fail    more lost than gained by McNemar's exact test, one-sided at 2.5 %
    open    neither: the cases at hand do not show it

Collisions count where they are preventable; those with pedestrians and cyclists, red
lights and stop signs count everywhere. Host numpy. `C` cases.
"""

from collections.abc import Mapping

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.evaluation.exact import ALPHA, no_more_faults
from rcirl_jax.evaluation.gate.stats import counted
from rcirl_jax.evaluation.gate.types import (
    Check,
    GateConfig,
    Kind,
    NewFault,
    Outcome,
    Pair,
    check_of,
    unmeasured,
)
from rcirl_jax.evaluation.gate.words import title_of
from rcirl_jax.simulation.metrics import CaseMetrics

NAMED = 10  # ids in an error


def offences(metrics: CaseMetrics, preventable: np.ndarray) -> dict[str, np.ndarray]:
    """[C] number of every offence, by the name of its check.

    Args:
      metrics: leaves [C].
      preventable: [C] bool.
    """
    at = lambda name: np.asarray(getattr(metrics, name))  # noqa: E731
    return {
        "collision": np.where(preventable, at("at_fault"), 0),
        "vulnerable": at("at_fault_vru"),
        "red_light": at("red_lights"),
        "stop_sign": at("stop_signs"),
    }


def new_faults(pair: Pair, accept: tuple[str, ...] = ()) -> tuple[NewFault, ...]:
    """Every case in which the candidate commits more of an offence, in their order.

    Collisions that no careful driver prevents are among them, and marked.

    Raises:
      InputError: an accepted id is no such case.
    """
    everywhere = np.ones(len(pair.ids), bool)
    mine = offences(pair.candidate, everywhere)
    theirs = offences(pair.incumbent, everywhere)
    more = {name: mine[name] > theirs[name] for name in mine}
    found = tuple(
        NewFault(
            case=pair.ids[i],
            faults=tuple(name for name in more if more[name][i]),
            preventable=bool(pair.preventable[i]),
            accepted=pair.ids[i] in accept,
        )
        for i in np.flatnonzero(np.any(list(more.values()), axis=0)).tolist()
    )
    cases = [fault.case for fault in found]
    for name in accept:
        if name not in cases:
            some = ", ".join(cases[:NAMED]) + (", ..." if len(cases) > NAMED else "")
            raise InputError(
                f"accept: {name}: no case with a new fault: expected "
                + (f"some of {some}" if cases else "none, for there is none")
            )
    return found


def safety(pair: Pair, config: GateConfig) -> list[Check]:
    """Candidate against incumbent, every offence."""
    return _against("safety", pair, pair.incumbent, config, "")


def trivial_safety(pair: Pair, config: GateConfig) -> list[Check]:
    """Compares each offence with each trivial baseline's; open where not driven."""
    found = []
    for name in config.trivial_baselines:
        if name in pair.trivial_baselines:
            found += _against(
                "trivial baselines", pair, pair.trivial_baselines[name], config, name
            )
        else:
            title = f"as safe as {name}"
            note = f"drive {name} on the same cases"
            found.append(
                unmeasured("trivial baselines", f"safety, {name}", title, note)
            )
    return found


def _against(
    kind: Kind, pair: Pair, other: CaseMetrics, config: GateConfig, trivial: str
) -> list[Check]:
    mine = offences(pair.candidate, pair.preventable)
    theirs = offences(other, pair.preventable)
    counts = np.isin(pair.ids, config.accept, invert=True)
    return [
        _check(
            kind,
            name,
            (
                int(np.sum(counts & (mine[name] < theirs[name]))),
                int(np.sum(counts & (mine[name] > theirs[name]))),
            ),
            len(pair.ids),
            config.margins,
            trivial,
        )
        for name in mine
    ]


def _check(
    kind: Kind,
    name: str,
    pairs: tuple[int, int],
    count: int,
    margins: Mapping[str, float],
    trivial: str,
) -> Check:
    """One offence with (gained, lost) of `count` cases."""
    margin, found = margins[name], counted(pairs, count)
    p = no_more_faults(*pairs, count, margin)
    outcome: Outcome = "pass" if p <= ALPHA else "open"
    if found.mean < 0.0 and found.p < 2.0 * ALPHA:
        outcome = "fail"
    note = ""
    if outcome == "open" and no_more_faults(0, 0, count, margin) > ALPHA:
        note = f"{count} cases can never prove a margin of {100 * margin:g} %"
    title = title_of(name)
    if trivial:
        name, title = f"{name}, {trivial}", f"as safe as {trivial}: {title}"
    return check_of(kind, name, title, outcome, found, margin, pairs, p, note)

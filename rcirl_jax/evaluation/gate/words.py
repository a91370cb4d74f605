"""The gate in words: titles of checks, the sentence, reasons, the terminal table."""

import textwrap
from collections.abc import Sequence

import numpy as np

from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.gate.types import INCUMBENT, Check, NewFault, Pair, Verdict
from rcirl_jax.simulation.families import family_title

WIDTH = 100  # columns of wrapped text
MAX_LINES = 3  # of the sentence, in these columns
# how many details it names, and whether drives that crawl are among them
DETAILS = ((3, True), (2, True), (2, False), (1, True), (1, False))
HALF = 0.5  # of the incumbent's progress: a drive that hardly moves on

FAULTS = {  # safety checks -> (one, several), as of cases
    "collision": (
        "preventable at-fault collision",
        "preventable at-fault collisions",
    ),
    "vulnerable": (
        "at-fault collision with a pedestrian or cyclist",
        "at-fault collisions with pedestrians or cyclists",
    ),
    "red_light": ("red light run", "red lights run"),
    "stop_sign": ("stop sign run", "stop signs run"),
}
HOLDS = {  # what a drive holds, as "keeps ... in n drives"
    "collision_free": "free of at-fault collisions",
    "speed_limit": "within the speed limit",
    "a_station": "|acceleration| below 4 m/s²",
    "a_lateral": "|lateral acceleration| below 4 m/s²",
    "j_station": "|jerk| below 6 m/s³",
    "j_lateral": "|lateral jerk| below 6 m/s³",
    "min_ttc": "more than 0.95 s to a collision",
    "on_road": "on the road",
}
# what to do where human-likeness was not measured
TO_MEASURE = "measure human-likeness on held-out recordings (docs/gate.md)"
AMOUNTS = {
    "progress": "progress",
    "nuplan": "nuPlan's score",
    "likeness": "nearness to the human",
}


def title_of(name: str) -> str:
    """What a check of all cases is about, in words."""
    if name in FAULTS:
        return FAULTS[name][1]
    if name in HOLDS:
        return f"drives that keep {HOLDS[name]}"
    return AMOUNTS[name]


def family_of(check: Check) -> str:
    """The family that a check is about; "" if it is about all cases."""
    return check.name.rpartition(", ")[0] if check.kind == "families" else ""


def sentence(pair: Pair, verdict: Verdict) -> str:
    """What was compared, what got better, what worse and where, what to do next.

    At most `MAX_LINES` lines of `WIDTH` columns: as many details as fit.

    Args:
      pair: the drives.
      verdict: all but its sentence.
    """
    checks = verdict.checks
    worse = sorted((c for c in checks if c.outcome == "fail"), key=_rank)
    better = [c for c in checks if c.kind == "gain" and c.outcome == "pass"]
    better.sort(key=lambda c: c.name != "likeness")  # what it is for comes first
    unclear = [c for c in checks if c.kind != "gain" and c.outcome == "open"]
    gains = [_better(c) for c in better]
    titles = [c.title for c in unclear]
    after = _next(verdict, worse, unclear)
    said = ""
    for details, crawling in DETAILS:
        losses = _listed([_worse(c, pair, crawling) for c in worse], details)
        parts = [_head(verdict, name_of(pair), losses)]
        if gains:
            words = "But better" if worse else "Better"
            parts.append(f"{words}: {_listed(gains, details)}")
        if titles and not worse:
            parts.append(f"Undecided: {_listed(titles, details)}")
        said = ". ".join([*parts, after]) + "."
        if len(textwrap.wrap(said, WIDTH)) <= MAX_LINES:
            return said
    return textwrap.shorten(said, (MAX_LINES - 1) * WIDTH, placeholder=" ...")


def reason(check: Check) -> str:
    """A check with its numbers, as a reason of the decision."""
    if not check.measured:
        return f"{check.kind}: {check.title}: {check.note}"
    pairs = ""
    if check.lost is not None:
        pairs = f", better in {check.gained} cases, worse in {check.lost}"
    return (
        f"{check.kind}: {check.title}: {100 * check.difference:+.2f} "
        f"[{100 * check.low:+.2f}, {100 * check.high:+.2f}] %{pairs}"
        + (f"; {check.note}" if check.note else "")
    )


def name_of(pair: Pair) -> str:
    """The incumbent's name in a sentence."""
    return "the incumbent" if pair.name == INCUMBENT else pair.name


def _head(verdict: Verdict, name: str, losses: str) -> str:
    """The decision, what was compared, and the losses."""
    cases = f"{verdict.cases:,} cases"
    if verdict.decision == "do not ship":
        return f"Do not ship: on {cases}, against {name}, the candidate {losses}"
    if verdict.decision == "ship":
        return f"Ship: on {cases} the candidate loses nothing against {name}"
    if verdict.decision == "no difference":
        return (
            f"No difference: on {cases} the candidate is neither worse nor better"
            f" than {name}"
        )
    return f"Could not judge: on {cases} nothing is worse for certain than with {name}"


def _rank(check: Check) -> tuple[int, float]:
    """Faults first, then where most is lost; trivial baselines last."""
    order = ("safety", "families", "no loss", "gain", "likeness", "trivial baselines")
    return order.index(check.kind), check.difference


def _listed(said: Sequence[str], count: int) -> str:
    """The first of them, and how many more."""
    more = len(said) - count
    return "; ".join(said[:count]) + (f"; and {more} more" if more > 0 else "")


def _worse(check: Check, pair: Pair, crawling: bool) -> str:
    """A failed check as what the candidate does."""
    family = family_of(check)
    if check.kind == "trivial baselines":
        return f"is not {check.title}"
    if check.kind == "safety":
        return (
            f"has {check.lost} new {FAULTS[check.name][check.lost != 1]}"
            f" ({check.gained} gone)"
        )
    if family and check.lost is not None:
        net = check.lost - (check.gained or 0)
        cases = int(np.sum(np.asarray(pair.families) == family))
        return f"has {net} fewer clean drives of {cases} in {_quoted(family)}"
    if family:
        crawls = _crawls(pair, family) if crawling else ""
        return f"{_less('progress', check)} in {_quoted(family)}{crawls}"
    if check.name in AMOUNTS:
        return _less(check.name, check)
    return f"keeps {HOLDS[check.name]} in {_net(check)} fewer drives"


def _quoted(family: str) -> str:
    """A family's title in a sentence."""
    title = family_title(family)
    return f'"{title[:1].lower()}{title[1:]}"'


def _less(name: str, check: Check) -> str:
    percent = f"{-100.0 * check.difference:.1f}"
    if name == "likeness":
        return f"is {percent} % farther from the human"
    if name == "nuplan":
        return f"has {percent} points less of nuPlan's score"
    return f"makes {percent} % less progress"


def _crawls(pair: Pair, family: str) -> str:
    """How many drives of a family hardly move on, if any."""
    at = np.asarray(pair.families) == family
    mine = np.asarray(pair.candidate.progress, np.float64)[at]
    theirs = np.asarray(pair.incumbent.progress, np.float64)[at]
    slow = int(np.sum(mine < HALF * theirs))
    return f" (less than half as far in {slow} of {at.sum()} drives)" if slow else ""


def _net(check: Check) -> str:
    return f"{abs((check.gained or 0) - (check.lost or 0)):,}"


def _better(check: Check) -> str:
    percent = f"{100.0 * check.difference:+.1f}"
    if check.name == "likeness":
        return f"{percent} % nearer to the human"
    if check.name == "nuplan":
        return f"nuPlan's score {percent} points"
    if check.name == "progress":
        return f"progress {percent} %"
    return f"{HOLDS[check.name]} in {_net(check)} more drives"


def _next(verdict: Verdict, worse: Sequence[Check], unclear: Sequence[Check]) -> str:
    """What to do now."""
    if worse and verdict.look_at:
        return f"Next: replay {verdict.look_at[0]}"
    if worse:
        return "Next: keep the incumbent"
    missing = next((c.note for c in unclear if not c.measured and c.note), "")
    if missing:
        return f"Next: {missing}"
    if verdict.decision == "ship":
        return "Next: look at the cases named below, then your own tests"
    if verdict.part:
        return "Next: drive the full suite"
    if any(c.kind in ("safety", "trivial baselines") for c in unclear) and new(verdict):
        return "Next: look at the new faults; --accept those that may stay"
    if unclear:
        return "Next: keep the incumbent, or drive more cases"
    return "Next: keep the incumbent"


def new(verdict: Verdict) -> list[NewFault]:
    """New faults that nobody has accepted."""
    return [fault for fault in verdict.new_faults if not fault.accepted]


def fault_words(fault: NewFault) -> str:
    """One new fault as a line."""
    said = []
    for name in fault.faults:
        words = FAULTS[name][0]
        if name == "collision" and not fault.preventable:
            words = "at-fault collision, not preventable"
        said.append(words)
    accepted = " (accepted)" if fault.accepted else ""
    return f"{fault.case}: {', '.join(said)}{accepted}"


# ---------------------------------------------------------------- the table

RANKS = {"fail": 0, "open": 1, "pass": 2}  # the order in which they are shown
OUTCOMES = {"pass": "ok", "fail": "FAIL", "open": "open"}
OF_GAINS = {"pass": "better", "fail": "FAIL", "open": "-"}
TITLES = {
    "safety": "Not more cases with a fault (p: of as many more as the margin)",
    "no loss": "No loss beyond the margin, over all cases",
    "families": "No loss beyond the margin in any family (p: Holm; the ten worst)",
    "trivial baselines": "Ahead of rewards that know nothing",
    "likeness": "Not farther from the human",
    "gain": "Better somewhere, worse nowhere (Holm over the primary metrics)",
}
WORST_FAMILIES = 10  # rows of the terminal table; the JSON has all


def format_verdict(verdict: Verdict) -> str:
    """The sentence and decision first, then every kind of check as a table."""
    lines = textwrap.wrap(verdict.sentence, WIDTH)
    lines += ["", f"verdict: {verdict.decision.upper()}"]
    lines += [line for said in verdict.reasons for line in _item(said)]
    lines += ["", f"{verdict.cases:,} cases of {verdict.families} families; % of cases"]
    if verdict.part:
        lines += textwrap.wrap(f"a part of the suite: {verdict.part}", WIDTH)
    header = ["", "", "difference", "95 %", "margin", "cases", "p"]
    for kind, title in TITLES.items():
        checks = [check for check in verdict.checks if check.kind == kind]
        if kind == "families":  # those that failed or lost most
            checks.sort(key=lambda c: (RANKS[c.outcome], c.difference))
            checks = checks[:WORST_FAMILIES]
        if checks:
            lines += ["", title, *text_table(header, [_cells(c) for c in checks])]
    if verdict.new_faults:
        lines += ["", "Cases with a new fault; --accept=ID,... of those that may stay"]
        for fault in verdict.new_faults:
            lines += _item(fault_words(fault))
    if verdict.look_at:
        named = ", ".join(verdict.look_at)
        lines += ["", *textwrap.wrap(f"look first at: {named}", WIDTH)]
    return "\n".join(lines) + "\n"


def _cells(check: Check) -> list[str]:
    """A line of the table."""
    outcome = (OF_GAINS if check.kind == "gain" else OUTCOMES)[check.outcome]
    if not check.measured:
        return [check.title, outcome, "", "not measured", "", "", ""]
    mean, low, high = (
        f"{100.0 * x:+.2f}" for x in (check.difference, check.low, check.high)
    )
    return [
        check.title,
        outcome,
        mean,
        f"[{low}, {high}]",
        "" if check.margin is None else f"-{100.0 * check.margin:g}",
        "" if check.lost is None else f"+{check.gained} -{check.lost}",
        "" if check.p is None else f"{check.p:.3f}",
    ]


def _item(said: str) -> list[str]:
    return textwrap.wrap(said, WIDTH, initial_indent="  - ", subsequent_indent="    ")

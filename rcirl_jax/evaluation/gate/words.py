"""The gate in words: titles of checks, the sentence, reasons, the terminal table."""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rcirl_jax.evaluation.closed_loop.summary import text_table
from rcirl_jax.evaluation.gate.types import (
    IMPACT_MPS,
    INCUMBENT,
    Check,
    NewFault,
    Pair,
    Verdict,
)
from rcirl_jax.simulation.families import family_title

WIDTH = 100  # columns of wrapped text
MAX_LINES = 3  # of the sentence, in these columns
# how many details it names, and whether drives that crawl are among them
DETAILS = ((3, True), (2, True), (2, False), (1, True), (1, False))
HALF = 0.5  # of the incumbent's progress: a drive that hardly moves on
KEEP = "keep the incumbent"
WORST_FAMILIES = 10  # rows of the terminal table; the JSON has all


class Words(NamedTuple):
    """The names of a check over all cases; the templates take `_numbers`."""

    title: str
    worse: str  # as what the candidate does
    better: str = ""
    one: str = ""  # a single fault


def _fault(one: str, several: str) -> Words:
    return Words(several, "has {lost} new {fault} ({gained} gone)", one=one)


def _holds(what: str) -> Words:
    worse, better = f"keeps {what} in {{net}} fewer", f"{what} in {{net}} more"
    return Words(f"drives that keep {what}", f"{worse} drives", f"{better} drives")


def _recorded(what: str, worse: str) -> Words:
    numbers = "{lost} vehicles more, {gained} fewer"
    return Words(f"recorded vehicles with {what}", f"{worse} ({numbers})")


WORDS = {
    "collision": _fault(
        "preventable at-fault collision", "preventable at-fault collisions"
    ),
    "vulnerable": _fault(
        "at-fault collision with a pedestrian or cyclist",
        "at-fault collisions with pedestrians or cyclists",
    ),
    "red_light": _fault("red light run", "red lights run"),
    "stop_sign": _fault("stop sign run", "stop signs run"),
    "collision_free": _holds("free of at-fault collisions"),
    "speed_limit": _holds("within the speed limit"),
    "a_station": _holds("|acceleration| below 4 m/s²"),
    "a_lateral": _holds("|lateral acceleration| below 4 m/s²"),
    "j_station": _holds("|jerk| below 6 m/s³"),
    "j_lateral": _holds("|lateral jerk| below 6 m/s³"),
    "min_ttc": _holds("more than 0.95 s to a collision"),
    "on_road": _holds("on the road"),
    "impact": Words(
        "speed of at-fault impacts",
        "hits harder at fault, by {harder} m/s in 1,000 cases",
    ),
    "recorded collision": _recorded(
        "an at-fault collision", "collides more often among recorded traffic"
    ),
    "recorded ttc": _recorded(
        "less than 0.95 s to a collision",
        "comes closer to collisions among recorded traffic",
    ),
    "recorded braking": _recorded(
        "somebody made to brake above 4 m/s²",
        "makes others brake hard more often among recorded traffic",
    ),
    "recorded headway": Words(
        "time with a headway below 1 s",
        "keeps short headways in {size} % more of the time among recorded traffic",
    ),
    "progress": Words("progress", "makes {less} % less progress", "progress {more} %"),
    "rms_a": Words(
        "RMS acceleration",
        "accelerates and brakes {size} % harder (RMS)",
        "RMS acceleration {size} % lower",
    ),
    "rms_j": Words("RMS jerk", "has {size} % more RMS jerk", "RMS jerk {size} % lower"),
    "nuplan": Words(
        "nuPlan's score",
        "has {less} points less of nuPlan's score",
        "nuPlan's score {more} points",
    ),
    "likeness": Words(
        "nearness to the human",
        "is {less} % farther from the human",
        "{size} % nearer to the human",
    ),
}
HEADS = {
    "do not ship": "Do not ship: on {cases}, against {name}, the candidate {losses}",
    "ship": "Ship: on {cases} the candidate loses nothing against {name}",
    "no difference": (
        "No difference: on {cases} the candidate is neither worse nor better than"
        " {name}"
    ),
    "could not judge": (
        "Could not judge: on {cases} nothing is shown to be worse than with {name}"
    ),
    "promising": "Promising: on {cases} nothing is shown to be worse than with {name}",
    "too early": (
        "Too early to tell: on {cases} nothing is shown to be worse than with {name}"
    ),
}
# what a reader asks after first: metrics of which a gain in one answers it
MAIN = {
    "nearness to people": {"likeness"},
    "comfort": {"rms_a", "rms_j", "a_station", "j_station"},
    "progress": {"progress"},
    "nuPlan's score": {"nuplan"},
}
# kinds in the order of the sentence's losses: faults first, trivial baselines last
ORDER = (
    "safety",
    "recorded traffic",
    "families",
    "no loss",
    "gain",
    "likeness",
    "trivial baselines",
)


def words_of(check: Check) -> Words:
    """Returns the words of a check over all cases, whatever gain was driven at."""
    return WORDS[check.name.partition(", ")[0]]


def family_of(check: Check) -> str:
    """Returns the family that a check is about; "" if it is about all cases."""
    return check.name.rpartition(", ")[0] if check.kind == "families" else ""


def name_of(pair: Pair, row: str = "") -> str:
    """Returns the name in a sentence of a row, by default the incumbent's."""
    row = row or pair.name
    return "the incumbent" if row == INCUMBENT else row


def sentence(pair: Pair, verdict: Verdict) -> str:
    """Says what was compared, what got better, what worse and where, what to do next.

    At most `MAX_LINES` lines of `WIDTH` columns: as many details as fit.

    Args:
      pair: the drives.
      verdict: all but its sentence.
    """
    checks = verdict.checks
    worse = [c for c in checks if c.outcome == "fail"]
    worse.sort(key=lambda c: (ORDER.index(c.kind), c.difference))
    better = [c for c in checks if c.kind == "gain" and c.outcome == "pass"]
    better.sort(key=lambda c: c.name != "likeness")  # what it is for comes first
    gains = [WORDS[c.name].better.format(**_numbers(c)) for c in better]
    unclear = [c for c in checks if c.kind != "gain" and c.outcome == "open"]
    cases, decision = f"{verdict.cases:,} cases", verdict.decision
    label, undecided, rest = "Undecided", [c.title for c in unclear], []
    if verdict.part and decision == "could not judge" and not worse:
        # most is open for want of cases: say what was shown, and of the main questions
        # which were not answered
        decision = "promising" if better else "too early"
        for n, check in enumerate(better):
            if check.lost is None:  # no count of drives
                _, low, high = _percents(check)
                gains[n] += f" [{low}, {high}]"
        names = {c.name for c in better}
        label = "Not told apart"
        undecided = [title for title, any_of in MAIN.items() if not names & any_of]
        rest = ["Nothing ships on a part"]
    accepted = ", ".join(x.case for x in verdict.new_faults if x.accepted)
    said = ""
    for details, crawling in DETAILS:
        losses = _listed([_worse(c, pair, crawling) for c in worse], details)
        head = HEADS[decision]
        parts = [head.format(cases=cases, name=name_of(pair), losses=losses)]
        if accepted and not worse:
            parts[0] += f", but for accepted faults in {accepted}"
        if gains:
            words = "But better" if worse else "Better"
            parts.append(f"{words}: {_listed(gains, details)}")
        if undecided and not worse:
            shown = len(MAIN) if rest else details
            parts.append(f"{label}: {_listed(undecided, shown)}")
        parts += rest
        said = ". ".join([*parts, f"Next: {_next(verdict, worse, unclear)}"]) + "."
        if len(textwrap.wrap(said, WIDTH)) <= MAX_LINES:
            return said
    return textwrap.shorten(said, (MAX_LINES - 1) * WIDTH, placeholder=" ...")


def reason(check: Check) -> str:
    """Returns a check with its numbers, as a reason of the decision."""
    head, note = f"{check.kind}: {check.title}: ", check.note
    if not check.measured:
        return head + note
    mean, low, high = _percents(check)
    pairs = ""
    if check.lost is not None:
        pairs = f", better in {check.gained} cases, worse in {check.lost}"
    return f"{head}{mean} [{low}, {high}] %{pairs}" + (f"; {note}" if note else "")


def _percents(check: Check) -> list[str]:
    """Returns the difference and the ends of its interval in percent."""
    return [f"{100.0 * x:+.2f}" for x in (check.difference, check.low, check.high)]


def _listed(said: Sequence[str], count: int) -> str:
    """Joins the first of them, and says how many more there are."""
    more = len(said) - count
    return "; ".join(said[:count]) + (f"; and {more} more" if more > 0 else "")


def _numbers(check: Check) -> dict[str, object]:
    """Returns what the templates of `WORDS` take."""
    words, percent = words_of(check), 100.0 * check.difference
    return {
        "lost": check.lost,
        "gained": check.gained,
        "net": f"{abs((check.gained or 0) - (check.lost or 0)):,}",
        "fault": words.one if check.lost == 1 else words.title,
        "less": f"{-percent:.1f}",
        "more": f"{percent:+.1f}",
        "size": f"{abs(percent):.1f}",
        "harder": f"{-1000.0 * IMPACT_MPS * check.difference:.0f}",
    }


def _worse(check: Check, pair: Pair, crawling: bool) -> str:
    """Returns a failed check as what the candidate does."""
    if check.kind == "trivial baselines":
        return f"is not {check.title}"
    family = family_of(check)
    if not family:
        return words_of(check).worse.format(**_numbers(check))
    title, at = family_title(family), np.asarray(pair.runs.groups) == family
    where = f'in "{title[:1].lower()}{title[1:]}"'
    if check.lost is not None:
        net = check.lost - (check.gained or 0)
        return f"has {net} fewer clean drives of {at.sum()} {where}"
    mine, theirs = (
        np.asarray(x.progress, np.float64)[at] for x in (pair.candidate, pair.incumbent)
    )
    slow = int(np.sum(mine < HALF * theirs)) if crawling else 0
    crawls = f" (less than half as far in {slow} of {at.sum()} drives)" if slow else ""
    return f"makes {-100.0 * check.difference:.1f} % less progress {where}{crawls}"


def _next(verdict: Verdict, worse: Sequence[Check], unclear: Sequence[Check]) -> str:
    """Returns what to do now."""
    if worse:
        return f"replay {verdict.look_at[0]}" if verdict.look_at else KEEP
    if missing := next((c.note for c in unclear if not c.measured and c.note), ""):
        return missing
    if verdict.decision == "ship":
        return "look at the cases named below, then your own tests"
    if verdict.part:
        return "drive what was left out"
    unsafe = any(c.kind in ("safety", "trivial baselines") for c in unclear)
    if unsafe and not all(fault.accepted for fault in verdict.new_faults):
        return "look at the new faults; --accept those that may stay"
    return f"{KEEP}, or drive more cases" if unclear else KEEP


def fault_words(fault: NewFault) -> str:
    """Returns one new fault as a line."""
    said = [WORDS[name].one for name in fault.faults]
    if not fault.preventable and "collision" in fault.faults:
        at = fault.faults.index("collision")
        said[at] = "at-fault collision, not preventable"
    accepted = " (accepted)" if fault.accepted else ""
    return f"{fault.case}: {', '.join(said)}{accepted}"


# ---------------------------------------------------------------- the table

RANKS = {"fail": 0, "open": 1, "pass": 2}  # the order in which they are shown
OUTCOMES = {"pass": "ok", "fail": "FAIL", "open": "open"}
OF_GAINS = {"pass": "better", "fail": "FAIL", "open": "-"}
TITLES = {
    "safety": "Not more cases with a fault (p: of as many more as the margin)",
    "recorded traffic": "Among recorded traffic, held-out drives (shares of vehicles)",
    "no loss": "No loss beyond the margin, over all cases",
    "families": "No loss beyond the margin in any family (p: Holm; the ten worst)",
    "trivial baselines": "Ahead of rewards that know nothing",
    "likeness": "Not farther from the human",
    "gain": "Better somewhere, worse nowhere (Holm over the primary metrics)",
}


def format_verdict(verdict: Verdict) -> str:
    """Returns the sentence and decision, then every kind of check as a table."""
    lines = textwrap.wrap(verdict.sentence, WIDTH)
    lines += ["", f"verdict: {verdict.decision.upper()}"]
    lines += [line for said in verdict.reasons for line in _item(said)]
    if verdict.against:
        lines += ["", "the best arguments against it"]
        lines += [line for said in verdict.against for line in _item(said)]
    lines += ["", f"{verdict.cases:,} cases of {verdict.families} families; % of cases"]
    if verdict.part:
        lines += textwrap.wrap(f"a part only: {verdict.part}", WIDTH)
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
    """Returns a line of the table."""
    outcome = (OF_GAINS if check.kind == "gain" else OUTCOMES)[check.outcome]
    if not check.measured:
        return [check.title, outcome, "", "not measured", "", "", ""]
    mean, low, high = _percents(check)
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

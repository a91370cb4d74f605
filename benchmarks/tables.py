"""Tables of some pages of docs, filled in from benchmarks/results.

    python -m benchmarks.tables      # `make results` ends with it

A page has `<!-- table: NAME -->` before a table and `<!-- end -->` behind it; what
stands between is written anew, and nothing else.
"""

import functools
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from benchmarks.remake import RESULTS
from rcirl_jax.cli.running import run
from rcirl_jax.runtime.atomic_files import write_whole

DOCS = Path(__file__).parents[1] / "docs"
PAGES = ("results.md", "simulators.md", "labels.md")
PLACE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
# as pages call the rows
TITLES = {"candidate": "learned, on hand-set", "IDM, tuned": "tuned IDM"}
DRIVERS = (
    "candidate",
    "hand-set",
    "+velocity",
    "constant V",
    "random weights",
    "IDM",
    "IDM, tuned",
)
COLUMNS = {
    "collision_free": "collision free",
    "speed_limit": "v < limit",
    "a_station": "|a station| < 4",
    "a_lateral": "|a lateral| < 4",
    "j_station": "|j station| < 6",
    "j_lateral": "|j lateral| < 6",
}
MINUTES = 2.0  # of a case of the full suite
WORST = 3  # families that are listed


def read(name: str) -> dict:
    """Returns a result's contents."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table; the first row is its head."""
    rule = "|" + "---|" * len(head)
    safe = ([cell.replace("|", r"\|") for cell in row] for row in (head, *rows))
    lines = [f"| {' | '.join(row)} |" for row in safe]
    return "\n".join([lines[0], rule, *lines[1:]]) + "\n"


def title(row: str) -> str:
    """Returns the name of a row on a page."""
    return TITLES.get(row, row)


def amount(x: Mapping, digits: int, scale: float = 1.0, key: str = "value") -> str:
    """Returns a number with its interval; differences, of other keys, are signed."""
    value, low, high = (scale * x[k] for k in (key, "low", "high"))
    sign = "" if key == "value" else "+"
    return f"{value:{sign}.{digits}f} [{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]"


def mean_of(distance: Mapping) -> str:
    """Returns a mean distance in metres with its interval."""
    return amount({"value": distance["mean"], **distance}, 2)


def nuplan(row: Mapping) -> str:
    """Returns a suite row's score in points with its interval."""
    keys = {"value": "nuplan", "low": "nuplan_low", "high": "nuplan_high"}
    return amount({key: row[of] for key, of in keys.items()}, 1, 100.0)


def sentence() -> str:
    """The verdict of the gate."""
    return f"> {read('chain_verdict')['sentence']}\n"


def against() -> str:
    """The best arguments against shipping."""
    said = read("chain_verdict")["against"]
    return "".join(f"* {one}.\n" for one in said)


def gains() -> str:
    """Learned minus the incumbent over the full suite, as the gate tells them apart."""
    checks = read("chain_verdict")["checks"]
    return markdown(
        ("measure", "better by, % or points", "after Holm's correction"),
        (
            (
                x["title"],
                amount(x, 1, 100.0, key="difference"),
                "shown" if x["outcome"] == "pass" else "not told apart",
            )
            for x in checks
            if x["kind"] == "gain" and x["measured"]
        ),
    )


def families() -> str:
    """The families that lose most progress."""
    checks = read("chain_verdict")["checks"]
    found = [
        x
        for x in checks
        if x["kind"] == "families" and x["name"].endswith(", progress")
    ]
    found.sort(key=lambda x: x["difference"])
    return markdown(
        ("family", "progress, % more than hand-set", "more than 10 % lost?"),
        (
            (
                x["title"].rpartition(": ")[0],
                amount(x, 1, 100.0, key="difference"),
                {"pass": "no", "fail": "yes", "open": "open"}[x["outcome"]],
            )
            for x in found[:WORST]
        ),
    )


def suite() -> str:
    """Faults, progress and score of the full suite."""
    rows = read("chain_suite")["report"]["rows"]
    head = ("row", "at-fault collisions", "red lights, stop signs run")
    return markdown(
        (*head, "progress, % of IDM's", "nuPlan score"),
        (
            (
                title(name),
                f"{x['at_fault']}",
                f"{x['red_lights']}, {x['stop_signs']}",
                f"{100.0 * x['progress_m'] / rows['IDM']['progress_m']:.1f}",
                nuplan(x),
            )
            for name, x in ((name, rows[name]) for name in DRIVERS)
        ),
    )


def comfort() -> str:
    """Comfort of the full suite, measured in four ways."""
    rows = read("chain_suite")["report"]["rows"]
    head = ("row", "RMS acceleration, m/s²", "RMS jerk, m/s³", "brake taps a minute")
    ways = ("raw |j| < 6 m/s³, % of cases", "filtered, % of cases")
    return markdown(
        (*head, *ways),
        (
            (
                title(name),
                f"{x['physical']['rms_a']:.2f}",
                f"{x['physical']['rms_j']:.2f}",
                f"{x['physical']['brake_taps'] / MINUTES:.2f}",
                f"{100.0 * x['per_case']['j_station']['rate']:.1f}",
                f"{100.0 * x['filtered_case']['j_station']['rate']:.1f}",
            )
            for name, x in ((name, rows[name]) for name in DRIVERS)
        ),
    )


def table_ii() -> str:
    """The paper's Table II of the full suite, % of cases."""
    rows = read("chain_suite")["report"]["rows"]
    return markdown(
        ("row", *COLUMNS.values()),
        (
            (
                title(name),
                *(f"{100.0 * rows[name]['per_case'][k]['rate']:.1f}" for k in COLUMNS),
            )
            for name in DRIVERS
        ),
    )


def drives() -> str:
    """Distances to the human on held-out drives, nearest first, in metres."""
    rows = read("chain_likeness")["rows"]
    minus = rows["candidate"]["minus"]
    named = [item for item in rows.items() if item[0] != "recorded human"]
    named.sort(key=lambda item: item[1]["distance_m"]["mean"])
    times = ("1", "3", "5", "8")
    return markdown(
        ("row", "mean", *(f"{t} s" for t in times), "learned minus this row"),
        (
            (
                title(name),
                mean_of(x["distance_m"]),
                *(f"{x['at_m'][t]:.2f}" for t in times),
                amount(minus[name], 2, key="mean") if name in minus else "",
            )
            for name, x in named
        ),
    )


def ranking() -> str:
    """Top-1 distance of held-out scenes, with predicted and with recorded futures."""
    known = [read(f"chain_ranking{end}")["rows"] for end in ("", "_recorded")]
    names = ("candidate", "IDM, tuned", "IDM", "constant speed", "random", "hand-set")
    return markdown(
        ("row", "predicted", "recorded"),
        (
            (
                title(name) + " (3 seeds)" * (name == "candidate"),
                *(amount(rows[name]["top1_fde"], 2) for rows in known),
            )
            for name in (*names, "hand-set DP", "oracle")
        ),
    )


def dial() -> str:
    """The learned part's gain turned from 0 to four times the run's."""
    ways = {"nuplan": 1, "progress": 1, "rms_acceleration": 2, "rms_jerk": 2}
    head = ("gain", "nuPlan", "progress, % of hand-set's", "RMS acceleration")
    ranked, driven = read("dial_ranking")["rows"], read("gains")["report"]["rows"]

    def of_dial(rows: Mapping, dial: float) -> Mapping:
        """The row of a dial, which is called after its file."""
        if not dial:
            return rows["hand-set"]
        file = "weights" if dial == 1.0 else f"{dial:g}"
        return next(x for name, x in rows.items() if name.endswith(f"({file}.msgpack)"))

    def at_stop_signs(dial: float) -> float:
        """Share of the way, on cases that nothing else is measured on."""
        return of_dial(driven, dial)["families"]["stop_sign"]["progress_ratio"]

    return markdown(
        (*head, "RMS jerk", "distance, m", "top-1, m", "stop signs, other cases, %"),
        (
            (
                f"{x['gain']:.3g}" if x["dial"] else "0: hand-set",
                *(f"{x['measures'][k]['value']:.{n}f}" for k, n in ways.items()),
                amount(x["measures"]["distance"], 2),
                amount(of_dial(ranked, x["dial"])["top1_fde"], 2),
                f"{100.0 * at_stop_signs(x['dial']) / at_stop_signs(0.0):.1f}",
            )
            for x in read("chain_dial")["settings"]
        ),
    )


def left_out_site() -> str:
    """Top-1 on a site of which the learners saw nothing, and with it."""
    sites = read("left_out_site")["sites"]
    rows = ("without the site", "all sites", "IDM, tuned, without the site", "hand-set")

    def cells(report: Mapping) -> list[str]:
        (apart,) = (
            x["difference"]
            for x in report["comparisons"]
            if (x["row"], x["reference"]) == rows[:2] and x["metric"] == "top1_fde"
        )
        known = [amount(report["rows"][name]["top1_fde"], 2) for name in rows]
        return [*known, amount(apart, 2, key="mean")]

    head = ("site", "learned without it", "learned with it")
    return markdown(
        (*head, "IDM tuned without it", "hand-set", "without minus with"),
        ([SITES[name], *cells(report)] for name, report in sites.items()),
    )


def own_terms() -> str:
    """Weights of own cost terms: published, learned, found by search."""
    ranked, driven, near = (
        read(f"own_terms_{name}") for name in ("ranking", "suite", "likeness")
    )
    titles = {
        "incumbent": "published weights",
        "candidate": "learned",
        "own terms, by search": "found by CMA-ES",
        "IDM, tuned": "tuned IDM",
    }
    others = ("hand-set", "+velocity", "constant V", "random weights", "oracle")

    def cells(name: str) -> tuple[str, ...]:
        order = ranked["rows"].get("random" if name == "random weights" else name)
        case = driven["report"]["rows"].get(name)
        drive = near["rows"].get(name)
        return (
            titles.get(name, name),
            amount(order["top1_fde_failure"], 2) if order else "",
            mean_of(drive["distance_m"]) if drive else "",
            *(
                (
                    nuplan(case),
                    f"{case['physical']['rms_j']:.2f}",
                    f"{case['progress_m']:.0f}",
                )
                if case
                else ("", "", "")
            ),
        )

    count, drives = ranked["counts"]["scenes"], near["drives"]
    cases = driven["report"]["cases"]
    head = ("row", f"top-1, {count:,} held-out scenes, failures at 10 m")
    head += (f"distance on {drives} held-out drives, m",)
    head += (f"nuPlan, {cases} cases of 60 s", "RMS jerk, m/s³", "progress, m")
    return markdown(head, (cells(name) for name in (*titles, *others)))


def labels() -> str:
    """Precision and recall of the labels, in %."""
    judged = read("label_scenes")["judged"]
    every, held_out = (
        {x["name"]: x for x in judged[key]} for key in ("all", "held_out")
    )

    def cell(x: Sequence[float] | None) -> str:
        if not x:
            return "-"
        return "{:.0f} [{:.0f}, {:.0f}]".format(*(100.0 * y for y in x))

    return markdown(
        (
            "label",
            "cases",
            "precision",
            "recall",
            "precision, held out",
            "recall, held out",
        ),
        (
            (
                name.replace("_", "-"),
                f"{every[name]['true']}",
                *(cell(x[name][k]) for x in (every, held_out) for k in RATES),
            )
            for name in ("overtake", "yield", "nudge", "cut_in", "follow", "ignore")
        ),
    )


SITES = {"us101": "US-101", "urban": "town", "i80": "I-80"}
RATES = ("precision", "recall")
# of other simulators: key -> head, digits, scale
MEASURES = {
    "at_fault": ("at-fault collision, %", 1, 100.0),
    "collisions": ("any collision, %", 1, 100.0),
    "red_lights": ("red light run, %", 1, 100.0),
    "j_station": ("|jerk| < 6 held, %", 1, 100.0),
    "nuplan_comfort": ("nuPlan comfort, %", 1, 100.0),
    "mean_speed": ("speed, m/s", 2, 1.0),
    "rms_j": ("rms jerk, m/s3", 2, 1.0),
}
LEFT_OUT = {
    "highway_env": ("red_lights",),
    "sumo": (),
    "commonroad": ("red_lights", "j_station"),
}


def elsewhere(simulator: str) -> str:
    """Drives in another simulator, and the learned row's paired differences."""
    found = read(f"elsewhere_{simulator}")["groups"]["all"]
    learned = next(iter(found["rows"]))
    keys = [key for key in MEASURES if key not in LEFT_OUT[simulator]]
    table = markdown(
        ("row", *(MEASURES[key][0] for key in keys)),
        (
            (
                "learned" if name == learned else name,
                *(amount(x[k], *MEASURES[k][1:]) for k in keys),
            )
            for name, x in found["rows"].items()
        ),
    )
    minus = {
        name.partition(" - ")[2]: x
        for name, x in found["differences"].items()
        if name.startswith(f"{learned} - ")
    }
    said = [
        f"Learned less {name}, the same episodes: speed "
        f"{amount(x['mean_speed'], 2, key='mean')} m/s, comfort "
        f"{amount(x['nuplan_comfort'], 1, 100.0, key='mean')} points, rms jerk "
        f"{amount(x['rms_j'], 2, key='mean')} m/s3.\n"
        for name, x in minus.items()
    ]
    return f"{found['episodes']} episodes, 95 % intervals.\n\n{table}\n{''.join(said)}"


TABLES: dict[str, Callable[[], str]] = {
    "sentence": sentence,
    "against": against,
    "gains": gains,
    "families": families,
    "suite": suite,
    "comfort": comfort,
    "table_ii": table_ii,
    "drives": drives,
    "ranking": ranking,
    "dial": dial,
    "left_out_site": left_out_site,
    "own_terms": own_terms,
    "labels": labels,
    **{name: functools.partial(elsewhere, name) for name in LEFT_OUT},
}


def filled(text: str) -> str:
    """Returns a page's text with its tables written anew."""
    return PLACE.sub(lambda m: f"{m[1]}\n{TABLES[m[2]]()}\n{m[3]}", text)


def main() -> None:
    """Fills the pages."""
    for name in PAGES:
        text = (DOCS / name).read_text()
        write_whole(DOCS / name, filled(text))


if __name__ == "__main__":
    run(main)

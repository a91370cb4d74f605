"""The player of replays, and the table of cases that starts it."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from markupsafe import Markup

from rcirl_jax.evaluation.closed_loop.summary import SuiteRuns
from rcirl_jax.report.pages import Table, facts_text, part, write_page
from rcirl_jax.report.replays import Replay, broken_bounds, goes_as
from rcirl_jax.report.style import CANDIDATE, CLASS_COLOURS, HUMAN_LOOK, LOOKS, Look
from rcirl_jax.simulation.families import family_title
from rcirl_jax.simulation.metrics import nuplan_score
from rcirl_jax.simulation.rows import RECORDED_HUMAN

SCRIPT = ("drawing.js", "player.js", "cases.js")
COLOURS = {  # of whoever is met, and of stop lines
    "vehicle": CLASS_COLOURS["other"],
    "cyclist": CLASS_COLOURS["nudge"],
    "pedestrian": CLASS_COLOURS["virtual"],
    "static": CANDIDATE,
    "stop": CLASS_COLOURS["stop"],
    "open": CLASS_COLOURS["overtake"],
}
MOST = 300  # cases of a page
BEHIND_M, AHEAD_M, BESIDE_M = 20.0, 60.0, 8.0  # m around the ego in a thumbnail


def looks(rows: Sequence[str]) -> dict[str, Look]:
    """Return how each row is drawn; the order of the learned rows decides."""
    driven = [name for name in rows if name != RECORDED_HUMAN]
    found = {name: LOOKS[i % len(LOOKS)] for i, name in enumerate(driven)}
    return {name: found.get(name, HUMAN_LOOK) for name in rows}


def player_data(replays: Sequence[Replay]) -> dict:
    """Return the variable `replays` of player.html."""
    met = {kind for one in replays for kind, _, _ in one.bodies.values()}
    cases = [dataclasses.asdict(one) for one in replays]
    for case in cases:
        how = looks([drive["row"] for drive in case["drives"]])
        for drive in case["drives"]:
            drive["look"] = dataclasses.asdict(how[drive["row"]])
    return {
        "cases": cases,
        "colours": COLOURS,
        "legend": [(kind, colour) for kind, colour in COLOURS.items() if kind in met],
    }


def write_replay_page(path: Path, replay: Replay, facts: dict[str, object]) -> Path:
    """Write one HTML file of a case's drives; it needs no other file.

    Args:
      path: HTML to write.
      replay: of `make_replays`.
      facts: what made the page: commit, versions, flags.
    """
    drivers = ", ".join(drive.row for drive in replay.drives)
    rows = [(drive.row, drive.summary, drive.end) for drive in replay.drives]
    return write_page(
        path,
        "replay.html",
        SCRIPT,
        title=f"{replay.case} driven by {drivers}",
        replays=player_data([replay]),
        drives=Table(caption="Drives", heads=("", "", ""), rows=rows),
        facts=facts_text(facts),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class CaseLine:
    """One row of the table of cases."""

    case: str
    family: str  # its title
    candidate: str  # what it breaks; "" if nothing
    incumbent: str
    progress: float  # m, candidate minus incumbent
    nuplan: float  # points of nuPlan's score, likewise
    fault: bool  # the candidate's, where the incumbent has none
    place: int | None  # among the cases that the page plays
    thumbnail: Markup  # its worst moment, if it is played
    otherwise: bool  # it is played, and breaks other bounds than in the suite


def case_lines(
    runs: SuiteRuns, incumbent: str, replays: Sequence[Replay]
) -> list[CaseLine]:
    """Return cases that are played, then those that differ most; the worst first.

    Args:
      runs: the suite; its first row is the candidate.
      incumbent: its row.
      replays: what the page plays; cases that the suite does not have are left out.
    """
    mine, theirs = next(iter(runs.rows.values())), runs.rows[incumbent]
    way = jnp.asarray(runs.way)
    scores = [100.0 * np.asarray(nuplan_score(x, way)[0]) for x in (mine, theirs)]
    nuplan = scores[0] - scores[1]
    progress = np.asarray(mine.progress, float) - np.asarray(theirs.progress, float)
    fault = np.asarray(mine.at_fault) > np.asarray(theirs.at_fault)
    played = {replay.case: place for place, replay in enumerate(replays)}
    is_played = np.array([name in played for name in runs.ids])
    first = np.lexsort((progress, nuplan, ~fault, ~is_played))[:MOST]
    lines = []
    for at in first.tolist():
        drives = [
            jax.tree.map(lambda x, at=at: np.asarray(x)[at], driven)
            for driven in (mine, theirs)
        ]
        words = [", ".join(broken_bounds(drive)) for drive in drives]
        place = played.get(runs.ids[at])
        lines.append(
            CaseLine(
                case=runs.ids[at],
                family=family_title(runs.groups[at]),
                candidate=words[0],
                incumbent=words[1],
                progress=float(progress[at]),
                nuplan=float(nuplan[at]),
                fault=bool(fault[at]),
                place=place,
                thumbnail=Markup("") if place is None else thumbnail(replays[place]),
                otherwise=place is not None
                and not all(map(goes_as, replays[place].drives, drives)),
            )
        )
    return lines


def thumbnail(replay: Replay) -> Markup:
    """Draw the candidate's moment to look at from above, as a small SVG."""
    drive = replay.drives[0]
    frame = int(np.argmin(np.abs(np.asarray(drive.t) - drive.start)))
    here = drive.s[frame]
    boxes = []
    flat = drive.agents[frame]
    for slot, s, l, heading in zip(*(flat[i::4] for i in range(4)), strict=True):
        kind, length, width = replay.bodies[int(slot)]
        boxes.append(_box(s - here, l, heading, length, width, COLOURS[kind]))
    how = looks([one.row for one in replay.drives])
    for one in reversed(replay.drives):
        at = min(
            int(np.argmin(np.abs(np.asarray(one.t) - drive.start))), len(one.s) - 1
        )
        pose = (one.s[at] - here, one.l[at], one.heading[at])
        boxes.append(_box(*pose, *replay.ego, how[one.row].colour))
    edges = [-edge for edge in replay.edges]
    words = f"{replay.case} from above at {drive.start:g} s"
    return part("thumbnail", boxes, edges, (BEHIND_M, AHEAD_M, BESIDE_M), words)


def _box(
    s: float, l: float, heading: float, length: float, width: float, colour: str
) -> dict:
    """Return a body as the template draws it; y points to the right of the road."""
    return {
        "x": round(s, 1),
        "y": round(-l, 1),
        "turn": round(-np.degrees(heading), 1),
        "length": length,
        "width": width,
        "colour": colour,
    }

"""The player of replays: what its template and its script are given."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rcirl_jax.report.charts import HUMAN_LOOK, LOOKS, Look
from rcirl_jax.report.pages import Table, facts_text, write_page
from rcirl_jax.report.player.replays import Replay
from rcirl_jax.report.style import CANDIDATE, CLASS_COLOURS
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


def looks(rows: Sequence[str]) -> dict[str, Look]:
    """Row -> how it is drawn; the order of the learned rows decides."""
    driven = [name for name in rows if name != RECORDED_HUMAN]
    found = {name: LOOKS[i % len(LOOKS)] for i, name in enumerate(driven)}
    return {name: found.get(name, HUMAN_LOOK) for name in rows}


def player_data(replays: Sequence[Replay]) -> dict:
    """The variable `replays` of player.html."""
    met = {kind for one in replays for kind, _, _ in one.bodies.values()}
    return {
        "cases": [_case(one) for one in replays],
        "colours": COLOURS,
        "legend": [(kind, colour) for kind, colour in COLOURS.items() if kind in met],
    }


def _case(replay: Replay) -> dict:
    how = looks([drive.row for drive in replay.drives])
    body = dataclasses.asdict(replay)
    for drive in body["drives"]:
        drive["look"] = dataclasses.asdict(how[drive["row"]])
    return body


def write_replay_page(path: Path, replay: Replay, facts: dict[str, object]) -> Path:
    """One HTML file of a case's drives; it needs no other file.

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

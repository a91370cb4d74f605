"""Drives of one case as a page: the player, each drive's numbers, what made them."""

from collections.abc import Mapping
from pathlib import Path

from rcirl_jax.report import html
from rcirl_jax.report.markup import preformatted, section, table
from rcirl_jax.report.player.player import head, player, script
from rcirl_jax.report.player.replays import Replay


def write_replay_page(path: Path, replay: Replay, facts: Mapping[str, object]) -> Path:
    """One HTML file of a case's drives; it needs no other file.

    Args:
      path: HTML to write.
      replay: of `make_replays`.
      facts: what made the page: commit, versions, flags.
    """
    drivers = ", ".join(drive.row for drive in replay.drives)
    drives = [(drive.row, drive.summary, drive.end) for drive in replay.drives]
    made_by = preformatted(html.facts_text(facts), "made by")
    return html.write_page(
        path,
        f"{replay.case} driven by {drivers}",
        "One drive of the closed-loop suite, first at the moment to look at.",
        [
            section("drive", "Drive", player([replay])),
            table("Drives", ("", "", ""), drives),
            section("made_by", "Made by", made_by),
            script(),
        ],
        head=head(),
    )

"""The player of replays in a page: its controls, its data, its script."""

import dataclasses
import hashlib
import html
import importlib.resources
import json
from base64 import b64encode
from collections.abc import Sequence

from rcirl_jax.report.charts import HUMAN_LOOK, LOOKS, Look
from rcirl_jax.report.markup import text
from rcirl_jax.report.player.replays import Replay
from rcirl_jax.report.style import CANDIDATE, CLASS_COLOURS
from rcirl_jax.simulation.rows import RECORDED_HUMAN

COLOURS = {  # of whoever is met, and of stop lines
    "vehicle": CLASS_COLOURS["other"],
    "cyclist": CLASS_COLOURS["nudge"],
    "pedestrian": CLASS_COLOURS["virtual"],
    "static": CANDIDATE,
    "stop": CLASS_COLOURS["stop"],
    "open": CLASS_COLOURS["overtake"],
}
CONTROLS = """
<div id="player" class="player" tabindex="0" role="group"
 aria-label="Player of simulated drives" aria-describedby="player-help">
<p class="controls">
<label>Case <select id="case">{options}</select></label>
<button type="button" id="play" aria-pressed="false">Play</button>
<button type="button" id="back" aria-label="One frame back">◂ Step</button>
<button type="button" id="forward" aria-label="One frame on">Step ▸</button>
<label>Speed <select id="speed"><option value="0.25">¼×</option>
<option value="0.5">½×</option><option value="1" selected>1×</option>
<option value="2">2×</option><option value="4">4×</option></select></label>
</p>
<input type="range" id="scrub" min="0" max="1" value="0" aria-label="Time of the drive">
<p><output id="clock"></output></p>
<div id="events" role="group" aria-label="Moments to look at"></div>
<div id="drives"></div>
<ul class="legend" aria-label="Legend">{legend}
<li>thick outline: the ego</li><li>dotted lane line: the path given to it</li>
<li>red bar across: a line that demands a stop</li>
<li>graph: bands are bodies in the ego's path; thick: this drive; thin: the other
drives; fine dots: the plan in force; upright line: now</li></ul>
<details><summary>The case's random parameters</summary>
<p class="note" id="parameters"></p></details>
<p class="note" id="player-help">Keys: space plays and pauses, left and right step one
frame, home and end go to the ends. The graph's stations are metres ahead of the ego
now.</p>
</div>
<noscript><p>The player needs JavaScript; everything else does not.</p></noscript>
"""


def asset(name: str) -> str:
    """A file of rcirl_jax/report/assets."""
    folder = importlib.resources.files("rcirl_jax.report") / "assets"
    return (folder / name).read_text(encoding="utf-8")


def looks(rows: Sequence[str]) -> dict[str, Look]:
    """Row -> how it is drawn; the order of the learned rows decides."""
    driven = [name for name in rows if name != RECORDED_HUMAN]
    found = {name: LOOKS[i % len(LOOKS)] for i, name in enumerate(driven)}
    return {name: found.get(name, HUMAN_LOOK) for name in rows}


def player(replays: Sequence[Replay]) -> str:
    """Controls and data; `script` makes them work. A sentence without replays."""
    if not replays:
        return "<p>No case was driven again for this page.</p>"
    options = "".join(
        f'<option value="{i}">{text(one.case)}</option>'
        for i, one in enumerate(replays)
    )
    met = {kind for one in replays for kind, _, _ in one.bodies.values()}
    legend = "".join(
        f'<li><i style="background:{colour}"></i>{kind}</li>'
        for kind, colour in COLOURS.items()
        if kind in met
    )
    data = {"cases": [_case(one) for one in replays], "colours": COLOURS}
    return CONTROLS.format(options=options, legend=legend) + json_block("replays", data)


def _case(replay: Replay) -> dict:
    how = looks([drive.row for drive in replay.drives])
    body = dataclasses.asdict(replay)
    for drive in body["drives"]:
        drive["look"] = dataclasses.asdict(how[drive["row"]])
    return body


def json_block(name: str, data: object) -> str:
    """Data for scripts; nothing in it can end the element or start another."""
    body = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for sign in "<>&":
        body = body.replace(sign, f"\\u{ord(sign):04x}")
    return f'<script type="application/json" id="{html.escape(name)}">{body}</script>'


def _code() -> str:
    """Drawing and player as one function, so that they share no name with others."""
    return f'"use strict";(() => {{\n{asset("drawing.js")}{asset("player.js")}}})();'


def script() -> str:
    """The player's script as an element."""
    return f"<script>{_code()}</script>"


def head() -> str:
    """Style, and a policy by which the page loads nothing and runs one script only."""
    digest = b64encode(hashlib.sha256(_code().encode()).digest()).decode()
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    )
    return (
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f"<style>\n{asset('tuning.css')}</style>"
    )

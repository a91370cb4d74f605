"""Pages as one HTML file: Jinja2 templates, in which every text is escaped.

A page loads nothing from elsewhere and runs one script, which its policy names by hash.
`TERMS` explains the words of all pages: the one place where they are.
"""

import base64
import dataclasses
import functools
import hashlib
import importlib.resources
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from rcirl_jax.runtime.atomic_files import plain, write_whole

BROAD_PIXELS = 1000  # wider pictures are not shrunk to a phone's width
TERMS = {
    "at-fault": "caused by the ego: it runs into somebody, or moves into their way",
    "preventable": "one of two models of a careful driver avoids it",
    "clean drives": "no at-fault collision, red light or stop sign run, always more "
    "than 0.95 s to a collision, within the limit and on the road",
    "time to collision": "time until two bodies meet if both keep their speed",
    "nuPlan": "score of the nuPlan benchmark, 0 to 100 points: nothing with an own "
    "fault or off the road, else progress, time to collision, speed and comfort",
    "progress": "way along the road in the time of a case",
    "jerk": "change of acceleration in a second; much of it feels rough",
    "RMS acceleration": "root of the mean square over a drive: how hard and how long "
    "one is pushed; discomfort grows with acceleration (de Winkel et al. 2023)",
    "brake taps": "turns from driving to braking by more than 1 m/s² within 2 s",
    "nearer to the human": "less distance along the road from what the recorded human "
    "did, over held-out drives from the same start",
    "baseline": "a driver or a score that learned nothing from these recordings",
    "trivial baseline": "a score that knows nothing: any other should beat it",
    "prior cost": "the planner's own cost, to which the learned value is added",
    "dial": "one number that multiplies the gain of the learned value: at 0 the own "
    "cost drives alone, at 1 the candidate",
    "simulated demonstrations": "drives of the own cost in the simulator, which the "
    "training uses beside the recordings",
    "hand-set": "the cost with weights set by hand that planners drive with today",
    "constant V": "trivial baseline: a planner that likes all its plans alike",
    "+velocity": "trivial baseline: a planner that likes nothing but speed",
    "IDM": "Intelligent Driver Model: follows the car ahead by a formula",
    "random": "candidates in random order, or weights that have learned nothing",
    "oracle": "chooses the candidate nearest to the human: the best one can do",
    "human rank": "share of the candidates that the human's own curve is ranked above",
    "top-1 FDE": "distance of the candidate ranked first from the human at the end",
    "top-3 FDE": "the least such distance among the three candidates ranked first",
    "MRR": "mean of 1 / rank of the candidate nearest to the human; 1 is best",
    "miss": "share of scenes whose first candidate ends far from the human",
    "Holm": "p values made larger because several things are tested at once",
    "margin": "largest loss that counts as none, declared before anything was driven",
    "rule of three": "what never happened in n cases happens in at most 3 / n of them",
    "gamma": "how much each time of a plan counts",
    "p": "how often chance alone would make a difference as large",
}
# whole words, the longer of two that begin alike
_WORDS = re.compile(
    "|".join(
        rf"(?<![\w+|-]){re.escape(term)}(?![\w-])"
        for term in sorted(TERMS, key=len, reverse=True)
    ),
    re.IGNORECASE,
)
_MEANINGS = {term.lower(): meaning for term, meaning in TERMS.items()}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """A table for parts.html; every cell that is no `Markup` is escaped."""

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[object]]  # the first cell of a row is its heading
    kind: str = ""  # its class
    marked: Sequence[str] = ()  # headings of rows that stand out


def number(value: float, digits: int, signed: bool = False) -> str:
    """Format with fixed digits and a true minus; "none" for what is not finite."""
    if not math.isfinite(value):
        return "none"
    value = round(value, digits) + 0.0  # no minus before a zero
    words = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return words.replace("-", "−")


def interval(
    found: tuple[float, float, float],
    digits: int,
    scale: float = 1.0,
    signed: bool = False,
) -> str:
    """Format (value, low, high), each times `scale`, as value [low, high]."""
    middle, *ends = (number(scale * x, digits, signed) for x in found)
    return f"{middle} [{ends[0]}, {ends[1]}]"


def explained(text: object) -> Markup:
    """Mark the terms of a text as `<abbr>`; leave `Markup` as it is."""
    if isinstance(text, Markup):
        return text
    words, found, at = str(text), Markup(""), 0
    for term in _WORDS.finditer(words):
        found += escape(words[at : term.start()])
        found += Markup('<abbr title="{}">{}</abbr>').format(
            _MEANINGS[term[0].lower()], term[0]
        )
        at = term.end()
    return found + escape(words[at:])


def picture(path: Path, caption: str) -> dict:
    """Return a PNG as the data of the template's `picture`."""
    png = path.read_bytes()
    return {
        "data": base64.b64encode(png).decode(),
        "caption": caption,
        "broad": int.from_bytes(png[16:20], "big") > BROAD_PIXELS,
    }


def facts_text(facts: Mapping[str, object]) -> str:
    """Return what made a page, as JSON."""
    return json.dumps(plain(facts), indent=2, default=str, ensure_ascii=False)


@functools.cache
def _environment() -> jinja2.Environment:
    made = jinja2.Environment(
        loader=jinja2.PackageLoader("rcirl_jax.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"number": number, "interval": interval, "explained": explained}
    made.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return made


def part(name: str, *values: object) -> Markup:
    """Render a macro of parts.html."""
    return getattr(_environment().get_template("parts.html").module, name)(*values)


def source(name: str) -> str:
    """Return a file of the templates as it is."""
    folder = importlib.resources.files("rcirl_jax.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")


def write_page(
    path: Path, template: str, script: tuple[str, ...] = (), **found: object
) -> Path:
    """Render a template and write the page atomically.

    Args:
      path: HTML to write.
      template: a file of `templates`, which extends page.html.
      script: files of `templates` that are its script, as one function.
      **found: the template's variables; `title` among them.
    """
    code = ""
    if script:
        code = f'"use strict";(() => {{\n{"".join(map(source, script))}}})();'
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    )
    page = (
        _environment()
        .get_template(template)
        .render(
            **found, policy=policy, code=Markup(code), css=Markup(source("page.css"))
        )
    )
    write_whole(path, page)
    return path

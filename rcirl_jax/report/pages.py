"""Pages as one HTML file: Jinja2 templates, in which every text is escaped.

A page loads nothing from elsewhere and runs one script, which its policy names by hash.
"""

import base64
import dataclasses
import functools
import hashlib
import importlib.resources
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
from markupsafe import Markup

from rcirl_jax.report.glossary import explained
from rcirl_jax.runtime.atomic_files import plain, write_whole

BROAD_PIXELS = 1000  # wider pictures are not shrunk to a phone's width


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """What parts.html makes a table of; every cell that is no `Markup` is escaped."""

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[object]]  # the first cell of a row is its heading
    kind: str = ""  # its class
    marked: Sequence[str] = ()  # headings of rows that stand out


def number(value: float, digits: int, signed: bool = False) -> str:
    """Fixed digits with a true minus; "none" for what is not finite."""
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
    """(value, low, high), each times `scale`, as value [low, high]."""
    middle, *ends = (number(scale * x, digits, signed) for x in found)
    return f"{middle} [{ends[0]}, {ends[1]}]"


def picture(path: Path, caption: str) -> dict:
    """A PNG as the data of the template's `picture`."""
    png = path.read_bytes()
    return {
        "data": base64.b64encode(png).decode(),
        "caption": caption,
        "broad": int.from_bytes(png[16:20], "big") > BROAD_PIXELS,
    }


def facts_text(facts: Mapping[str, object]) -> str:
    """What made a page, as JSON."""
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
    """A macro of parts.html, rendered."""
    return getattr(_environment().get_template("parts.html").module, name)(*values)


def source(name: str) -> str:
    """A file of the templates as it is."""
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

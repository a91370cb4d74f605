"""Pieces of an HTML page. Every text is escaped here, where it becomes HTML."""

import base64
import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

BROAD_PIXELS = 1000  # wider pictures are not shrunk to a phone's width


def text(value: object) -> str:
    """Anything as text that is safe inside an element or an attribute."""
    return html.escape(str(value))


def paragraph(words: object) -> str:
    """One escaped paragraph."""
    return f"<p>{text(words)}</p>"


def section(anchor: str, heading: str, *parts: str) -> str:
    """A section that `contents` can point to; parts are HTML."""
    body = "\n".join(part for part in parts if part)
    return (
        f'<section id="{anchor}" aria-labelledby="{anchor}-heading">\n'
        f'<h2 id="{anchor}-heading">{text(heading)}</h2>\n{body}\n</section>'
    )


def contents(entries: Iterable[tuple[str, str]]) -> str:
    """Links to sections, (anchor, heading)."""
    links = "".join(f'<li><a href="#{a}">{text(h)}</a></li>' for a, h in entries)
    return f'<nav class="contents" aria-label="Contents"><ol>{links}</ol></nav>'


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    kind: str = "",
    marked: Sequence[str] = (),
) -> str:
    """A table in a box of its own that scrolls; text is escaped.

    Args:
      caption: above the table.
      head: column names.
      rows: cells; the first of a row is its heading. `Markup` is taken as it is.
      kind: class of the table.
      marked: headings of rows that stand out.
    """
    top = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    body = []
    for first, *others in rows:
        mark = ' class="marked"' if first in marked else ""
        cells = "".join(f"<td>{_cell(cell)}</td>" for cell in others)
        body.append(f'<tr{mark}><th scope="row">{_cell(first)}</th>{cells}</tr>')
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{text(caption)}">'
        f'<table class="{kind}"><caption>{text(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead>\n<tbody>{chr(10).join(body)}</tbody>"
        "</table></div>"
    )


class Markup(str):
    """Text that is HTML already."""


def _cell(value: object) -> str:
    return value if isinstance(value, Markup) else text(value)


def preformatted(words: str, name: str) -> str:
    """Text in columns, in a box that scrolls."""
    return (
        f'<pre class="wide" role="region" tabindex="0" aria-label="{text(name)}">'
        f"{text(words)}</pre>"
    )


def folded(summary: str, body: str) -> str:
    """HTML behind a heading that opens."""
    return f"<details><summary>{text(summary)}</summary>{body}</details>"


def picture(path: Path, caption: str) -> str:
    """A PNG inside the page; wide ones scroll in their box on a phone."""
    png = path.read_bytes()
    data, words = base64.b64encode(png).decode(), text(caption)
    kind = "wide broad" if int.from_bytes(png[16:20], "big") > BROAD_PIXELS else "wide"
    return (
        f'<figure><div class="{kind}" role="region" tabindex="0" '
        f'aria-label="{words}"><img alt="{words}" '
        f'src="data:image/png;base64,{data}"></div>'
        f"<figcaption>{words}</figcaption></figure>"
    )


def number(value: float, digits: int, *, signed: bool = False) -> str:
    """Fixed digits with a true minus; "none" for what is not finite."""
    if not math.isfinite(value):
        return "none"
    words = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return words.replace("-", "−")


def interval(
    found: tuple[float, float, float],
    digits: int,
    *,
    scale: float = 1.0,
    signed: bool = False,
) -> str:
    """(value, low, high), each times `scale`, as value [low, high]."""
    middle, *ends = (number(scale * x, digits, signed=signed) for x in found)
    return f"{middle} [{ends[0]}, {ends[1]}]"

"""One HTML file of a drive: its pictures and numbers."""

import base64
import html as escape
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rcirl_jax.errors import InputError
from rcirl_jax.report.html import facts_text, table_section, write_page


def write_case_page(
    path: Path,
    title: str,
    lead: str,
    *,
    picture: Path,
    animation: Path | None,
    metrics: Mapping[str, Any],
    facts: Mapping[str, object],
) -> Path:
    """One HTML file of a drive: GIF, PNG and metrics; it needs no other file.

    Args:
      path: HTML to write.
      title: heading.
      lead: one sentence below it.
      picture: PNG of `draw_case`.
      animation: GIF of `animate_case`, if there is one.
      metrics: name -> value (a number or text), in the order to be shown.
      facts: what made the page: commit, versions, flags.
    """
    sections = []
    for heading, file in (("drive", animation), ("picture", picture)):
        if file is not None:
            sections.append(_embedded(heading, file))
    wide = max((len(name) for name in metrics), default=0)
    rows = [f"{name:<{wide}}  {_value(value)}" for name, value in metrics.items()]
    sections.append(table_section("metrics", "\n".join(rows)))
    sections.append(table_section("made by", facts_text(facts)))
    return write_page(path, title, lead, sections)


def _embedded(heading: str, file: Path) -> str:
    """A section with one picture as a data URI."""
    if not file.is_file():
        raise InputError(f"{file}: picture: missing: expected a PNG or GIF")
    kind = file.suffix.lstrip(".").lower()
    data = base64.b64encode(file.read_bytes()).decode()
    words = escape.escape(heading)
    return (
        f'<h2>{words}</h2>\n<figure><img alt="{words}" '
        f'src="data:image/{kind};base64,{data}"></figure>'
    )


def _value(value: Any) -> str:  # noqa: ANN401
    """A metric as text; numbers with four digits."""
    if isinstance(value, str) or np.ndim(value):
        return str(value)
    if np.asarray(value).dtype.kind in "bui":
        return str(value)
    return f"{float(value):.4g}"

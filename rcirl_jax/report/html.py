"""One self-contained HTML page of an evaluation: tables, pictures, provenance."""

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcirl_jax.runtime.atomic_files import plain, write_whole

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 76rem;
       padding: 1rem; color: #111; background: #fff; }}
h1 {{ font-size: 1.5rem; }} h2 {{ font-size: 1.15rem; margin-top: 2rem; }}
pre {{ overflow-x: auto; font-size: .8rem; background: #f6f6f6; padding: .8rem; }}
img {{ max-width: 100%; height: auto; }}
figure {{ margin: 1rem 0; }} figcaption {{ color: #444; font-size: .9rem; }}
</style>{head}</head><body>
<h1>{title}</h1>
<p>{lead}</p>
{body}
</body></html>
"""


def table_section(heading: str, text: str) -> str:
    """A section with preformatted text."""
    return f"<h2>{html.escape(heading)}</h2>\n<pre>{html.escape(text)}</pre>"


def facts_text(facts: Mapping[str, object]) -> str:
    """What made a page, as JSON."""
    return json.dumps(plain(facts), indent=2, default=str, ensure_ascii=False)


def write_page(
    path: Path, title: str, lead: str, sections: Sequence[str], head: str = ""
) -> Path:
    """Write the page atomically; nothing in it refers to another file.

    Args:
      path: HTML to write.
      title: heading, escaped here.
      lead: first paragraph, escaped here.
      sections: HTML of the body.
      head: HTML that is added to the head: style, policies.
    """
    page = PAGE.format(
        title=html.escape(title),
        lead=html.escape(lead),
        body="\n".join(sections),
        head=head,
    )
    write_whole(path, page)
    return path

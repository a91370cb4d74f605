"""Markdown pages of the repository and what they hold: links, spans, fences."""

import re
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
DOCS = REPO / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
TOP = (
    "README.md",
    "BUILD.md",
    "ROADMAP.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "onboard/README.md",
)
ALL = [*PAGES, *(REPO / name for name in TOP)]

FENCE = re.compile(r"^```(\w*)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.M | re.S)
SPAN = re.compile(r"`([^`]+)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def name_of(page):
    return str(page.relative_to(REPO))


def fences(text):
    """(language, title or None, content) of every fenced block, in order."""
    return [(m[1], m[2] or None, m[3]) for m in FENCE.finditer(text)]


def code(text):
    """Fenced and indented blocks and inline spans, continued lines joined."""
    found = [content for _, _, content in fences(text)]
    prose = FENCE.sub("", text)
    found.append("\n".join(re.findall(r"^ {4,}(.*)$", prose, re.M)))
    spans = [" ".join(span.split()) for span in SPAN.findall(prose)]
    return [re.sub(r"\\\n\s*", " ", block) for block in found] + spans


def spans(text):
    """Inline code outside of blocks."""
    prose = re.sub(r"^ {4,}.*$", "", FENCE.sub("", text), flags=re.M)
    return [" ".join(span.split()) for span in SPAN.findall(prose)]


def links(text):
    """Targets of links outside of code."""
    prose = re.sub(r"^ {4,}.*$", "", FENCE.sub("", text), flags=re.M)
    return LINK.findall(SPAN.sub("", prose))


def anchors(text):
    """Ids that mkdocs gives to the headings of a page."""
    found = set()
    for heading in re.findall(r"^#+ +(.*)$", FENCE.sub("", text), re.M):
        plain = re.sub(r"[^\w\s-]", "", heading).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


def section(text, heading):
    """What stands below a heading line, up to the next of its level."""
    level = heading.split(" ")[0]
    _, _, rest = text.partition(f"\n{heading}\n")
    assert rest, f"no heading {heading}"
    return re.split(rf"^#{{1,{len(level)}}} ", rest, maxsplit=1, flags=re.M)[0]


def table(text):
    """Rows of the first table: cells without the head, back-ticks removed."""
    block = re.search(r"(?:^\|.*\n)+", text, re.M)
    assert block, "no table"
    rows = [line.strip("|").split(" | ") for line in block[0].strip().splitlines()]
    return [[cell.strip().strip("`") for cell in row] for row in rows[2:]]

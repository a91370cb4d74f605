"""What an import made of the logs, as one page: counts, drops, labels, scenes.

The page is a single file that refers to no other and needs no script: the scenes
are filtered by radio buttons and style sheets alone.
"""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import tqdm

from rcirl_jax.data.scenes.filters import REASONS
from rcirl_jax.data.store.dataset import Dataset
from rcirl_jax.errors import InputError
from rcirl_jax.report.data.scene_picture import draw_scene
from rcirl_jax.report.data.scene_view import describe_scene, spoken, tag_names
from rcirl_jax.report.html import facts_text, table_section, write_page
from rcirl_jax.types import Tag

TAG_NAMES = tuple(tag.name.lower() for tag in Tag)
STYLE = """<style>
table { border-collapse: collapse; margin: .5rem 0; }
td, th { padding: .15rem .7rem .15rem 0; text-align: left; vertical-align: top; }
td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.bar { width: 12rem; } td.bar i { display: block; height: .8em; margin-top: .35em;
  background: #0072B2; }
.wide { overflow-x: auto; }
.filter label { display: inline-block; border: 1px solid #666; border-radius: .3rem;
  padding: .1rem .6rem; margin: .15rem .3rem .15rem 0; cursor: pointer; }
.filter input { margin-right: .4rem; }
.gallery { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 26rem), 1fr)); }
.gallery figure { margin: 0; border-top: 1px solid #ccc; break-inside: avoid; }
.gallery figcaption { overflow-wrap: anywhere; }
li { overflow-wrap: anywhere; }
@media print { .filter { display: none; } }
"""


def choose_rows(tags: np.ndarray, count: int, wanted: Sequence[str] = ()) -> list[int]:
    """Rows worth looking at: every tag in turn, spread over the dataset.

    Args:
      tags: [n, len(Tag)] bool, of all rows.
      count: rows to choose at most.
      wanted: names of tags; only rows with one of them are chosen. All if empty.

    Returns:
      Row numbers in ascending order; the same ones each time.

    Raises:
      InputError: an unknown tag, or no row has a wanted one.
    """
    for name in wanted:
        if name not in TAG_NAMES:
            raise InputError(f"--tags: {name}: expected {', '.join(TAG_NAMES)}")
    names = tuple(wanted) or TAG_NAMES
    queues = [_spread(np.flatnonzero(tags[:, TAG_NAMES.index(n)])) for n in names]
    if not wanted:
        queues.append(_spread(np.flatnonzero(~tags.any(axis=1))))
    chosen: dict[int, None] = {}
    while len(chosen) < count and any(queues):
        for queue in queues:
            while queue and queue[0] in chosen:
                queue.pop(0)
            if queue and len(chosen) < count:
                chosen[queue.pop(0)] = None
    if not chosen:
        raise InputError(f"--tags: {','.join(wanted)}: no such scene in the dataset")
    return sorted(chosen)


def _spread(rows: np.ndarray) -> list[int]:
    """The rows so that each prefix is spread over all of them (bit reversal)."""
    bits = max(int(rows.size - 1).bit_length(), 1)
    order = [int(f"{number:0{bits}b}"[::-1], 2) for number in range(2**bits)]
    return [int(rows[at]) for at in order if at < rows.size]


def write_data_page(
    output: Path,
    dataset: Dataset,
    rows: Sequence[int],
    title: str,
    facts: Mapping[str, object],
) -> Path:
    """Draw the scenes into `scenes` beside the page, and write the page.

    Args:
      output: HTML file.
      dataset: what is shown.
      rows: scenes that are drawn.
      title: heading, e.g. the dataset's name.
      facts: what made the page: commit, versions, flags.

    Raises:
      InputError: a row the dataset does not have, or one that cannot be drawn.
    """
    missing = [row for row in rows if not 0 <= row < dataset.count]
    if missing:
        raise InputError(f"--rows: {missing[0]}: expected 0 to {dataset.count - 1}")
    manifest, loaded = dataset.manifest, dataset.read(np.asarray(rows, np.int64))
    figures = []
    for place, row in enumerate(tqdm.tqdm(rows, desc="draw", unit=" scenes")):
        scene = jax.tree.map(lambda x, at=place: x[at], loaded)
        path = draw_scene(output.parent / "scenes" / f"scene{row:07d}.png", scene, row)
        where = (
            f"recording {manifest.recordings[int(scene.recording)]}, "
            f"vehicle {manifest.vehicles[int(scene.vehicle)]}, frame {int(scene.frame)}"
        )
        figures.append((path, tag_names(scene), where, describe_scene(scene, row)))
    quality = manifest.quality
    lead = (
        f"{dataset.count:,} scenes of {quality['tracks']:,} road users in "
        f"{quality['recordings']:,} recordings. Each scene is a moment of a human "
        "driver with what the human then did; labels say what was decided about "
        "each road user."
    )
    sections = [
        _style(),
        _facts(dataset),
        _drops(quality),
        _counts("Tags", "Scenes with each tag; a scene may have several.",
                quality["tags"], dataset.count),
        _counts("Decisions", "Labels of all road users near the driver's path.",
                quality["decisions"], sum(quality["decisions"].values())),
        _headways(quality),
        _gallery(figures),
        _notes(quality),
        _provenance(dataset),
        table_section("Page made by", facts_text(facts)),
    ]  # fmt: skip
    return write_page(output, title, lead, sections)


def _style() -> str:
    """The sheet; one rule per tag hides what does not have it."""
    hide = "\n".join(
        f'body:has(#only-{name}:checked) .gallery figure:not([data-tags~="{name}"])'
        " { display: none; }"
        for name in TAG_NAMES
    )
    return f"{STYLE}{hide}\n</style>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already."""
    top = "".join(f'<th scope="col">{name}</th>' for name in head)
    body = "\n".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f'<div class="wide"><table><tr>{top}</tr>\n{body}</table></div>'


def _text(value: object) -> str:
    return f"<td>{html.escape(str(value))}</td>"


def _number(value: object) -> str:
    return f'<td class="n">{html.escape(str(value))}</td>'


def _bar(share: float) -> str:
    width = 100.0 * min(max(share, 0.0), 1.0)
    return f'<td class="bar"><i style="width:{width:.1f}%"></i></td>'


def _facts(dataset: Dataset) -> str:
    manifest, quality = dataset.manifest, dataset.manifest.quality
    rates = ", ".join(f"{rate:g}" for rate in manifest.rate_hz)
    limit = f"|a| &gt; {quality['harsh_threshold_mps2']:g} m/s²"
    rows = [
        [_text("sampling rate"), _text(f"{rates} Hz")],
        [_text("states"), _text(f"{quality['states']:,}")],
        [
            f"<td>{limit}</td>",
            _text(
                f"{quality['harsh_share_raw']:.1%} as recorded, "
                f"{quality['harsh_share_smoothed']:.1%} smoothed"
            ),
        ],
    ]
    for key, name, unit in (
        ("speed_mps", "speed at the planning frame", "m/s"),
        ("headway_s", "headway behind the followed", "s"),
        ("future_s", "recorded future", "s"),
    ):
        found = quality[key]
        if found is not None:
            words = f"{found['p50']:.1f} {unit} ({found['p05']:.1f} to "
            rows.append([_text(name), _text(f"{words}{found['p95']:.1f} in 90 %)")])
    if quality.get("shortened"):
        words = (
            f"{quality['shortened']:,} scenes, {quality['shortened_share']:.1%} of the "
            "recorded futures: someone whom the driver reacts to leaves the record"
        )
        rows.append([_text("end before the driver's record"), _text(words)])
    for split, groups in manifest.splits.items():
        count = dataset.indices(split).size
        words = f"{count:,} scenes in {len(groups):,} groups that share no vehicle"
        rows.append([_text(f"split {split}"), _text(words)])
    if "split_by" in manifest.import_flags:
        rows.append([_text("split by"), _text(manifest.import_flags["split_by"])])
    for source in manifest.sources:
        words = f"{source.get('source', '')}; licence: {source.get('licence', '')}"
        rows.append([_text("source"), _text(words)])
    return f"<h2>What was recorded</h2>\n{_table(('', ''), rows)}"


def _drops(quality: Mapping) -> str:
    dropped = quality["dropped"]
    total = sum(dropped.values()) + quality["scenes"]
    rows = [
        [
            _text(spoken(name)),
            _number(f"{count:,}"),
            _bar(count / max(total, 1)),
            _text(REASONS.get(name, "")),
        ]
        for name, count in sorted(dropped.items(), key=lambda item: -item[1])
    ]
    kept = quality["scenes"]
    rows.append(
        [_text("kept"), _number(f"{kept:,}"), _bar(kept / max(total, 1)), _text("")]
    )
    return "<h2>Why scenes were dropped</h2>\n" + _table(
        ("reason", "count", "", "meaning"), rows
    )


def _counts(heading: str, lead: str, counts: Mapping[str, int], total: int) -> str:
    rows = [
        [
            _text(spoken(name)),
            _number(f"{count:,}"),
            _number(f"{count / max(total, 1):.1%}"),
            _bar(count / max(total, 1)),
        ]
        for name, count in sorted(counts.items(), key=lambda item: -item[1])
    ]
    return f"<h2>{heading}</h2>\n<p>{lead}</p>\n" + _table(
        ("", "count", "share", ""), rows
    )


def _headways(quality: Mapping) -> str:
    found = quality["headway_histogram"]
    if not sum(found.values()):
        return "<h2>Headways</h2>\n<p>Nobody is followed in these scenes.</p>"
    lead = "Seconds to the followed road user at the planning frame, above 2 m/s."
    most = max(found.values())
    rows = [
        [
            _text(name.replace("-inf", " and more")),
            _number(f"{count:,}"),
            _bar(count / most),
        ]
        for name, count in found.items()
    ]
    return f"<h2>Headways</h2>\n<p>{lead}</p>\n" + _table(("", "scenes", ""), rows)


def _gallery(figures: Sequence[tuple[Path, list[str], str, str]]) -> str:
    """The drawn scenes, with buttons for the tags that occur."""
    present = [name for name in TAG_NAMES if any(name in f[1] for f in figures)]
    buttons = ['<label><input type="radio" name="only" checked>all</label>']
    for name in present:
        many = sum(name in tags for _, tags, _, _ in figures)
        buttons.append(
            f'<label><input type="radio" name="only" id="only-{name}">'
            f"{spoken(name)} ({many})</label>"
        )
    items = []
    for path, tags, where, words in figures:
        data = base64.b64encode(path.read_bytes()).decode()
        items.append(
            f'<figure data-tags="{" ".join(tags)}">'
            f'<img loading="lazy" alt="{html.escape(words)}" '
            f'src="data:image/png;base64,{data}">'
            f"<figcaption>{html.escape(where)}</figcaption></figure>"
        )
    return (
        f"<h2>{len(figures)} scenes</h2>\n"
        '<fieldset class="filter"><legend>Show scenes with the tag</legend>'
        f"{''.join(buttons)}</fieldset>\n"
        f'<div class="gallery">{"".join(items)}</div>'
    )


def _notes(quality: Mapping) -> str:
    if not quality["num_notes"]:
        return "<h2>Notes</h2>\n<p>None: nothing in the logs was odd.</p>"
    more = quality["num_notes"] - len(quality["notes"])
    items = "".join(f"<li>{html.escape(note)}</li>" for note in quality["notes"])
    rest = f"<p>{more:,} more are not shown.</p>" if more > 0 else ""
    return (
        f"<h2>Notes</h2>\n<details><summary>{quality['num_notes']:,} notes of the "
        f"import</summary><ul>{items}</ul>{rest}</details>"
    )


def _provenance(dataset: Dataset) -> str:
    flags = dataset.manifest.import_flags
    lines = [f"dataset sha256: {dataset.hash}"]
    lines += [f"{name}: {value}" for name, value in sorted(flags.items())]
    made_by = dataset.facts().get("made_by")
    made_by = made_by if isinstance(made_by, dict) else {}
    lines += [
        f"{name}: {made_by.get(name) or 'not said'}"
        for name in ("git_commit", "code_sha256", "versions")
    ]
    words = html.escape("\n".join(lines))
    return f"<h2>Made by</h2>\n<pre>{words}</pre>"
